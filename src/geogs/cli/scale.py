"""``geogs scale OUT --from …``: a result in metres, without running again."""

from collections.abc import Sequence
from dataclasses import dataclass

from geogs.application.result_settings import RescaleSettings
from geogs.cli.options import parse_options


@dataclass(frozen=True)
class ScaleOptions(RescaleSettings):
    """Bring a result to metres by something whose length is known.

    Trajectories, map, splats, meshes and summary are written in metres; exports are made anew by
    geogs export.
    """


def main(argv: Sequence[str]) -> int:
    """Run the command; returns the exit code."""
    options = parse_options(ScaleOptions, argv, "scale")

    from geogs.application.results.rescale import rescale
    from geogs.application.scale.scene import said

    print(said(rescale(options)))
    return 0
