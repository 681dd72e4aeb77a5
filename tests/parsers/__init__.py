"""Every parser of files from outside: a small good example of each, and what reads it."""

from parsers.base import Parser


def parsers() -> dict[str, Parser]:
    """All of them by name. Who asks for none imports none of what they need."""
    from parsers.calibrations import calibrations
    from parsers.depths import depths
    from parsers.fleets import fleets
    from parsers.layouts import layouts
    from parsers.networks import networks
    from parsers.photographs import photographs
    from parsers.pose_priors import pose_priors
    from parsers.posed import posed
    from parsers.recordings import recordings
    from parsers.results import results
    from parsers.states import states
    from parsers.surfaces import surfaces

    groups = (
        calibrations, recordings, depths, pose_priors, photographs, posed, results, surfaces,
        states, fleets, networks, layouts,
    )  # fmt: skip
    return {name: parser for group in groups for name, parser in group().items()}
