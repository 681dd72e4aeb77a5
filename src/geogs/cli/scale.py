"""``geogs scale OUT --from …``: convert a result to metres, without another run."""

from collections.abc import Sequence
from dataclasses import asdict

from geogs.application.result_settings import RescaleSettings
from geogs.cli.answer import Answer
from geogs.cli.options import parse_options


def main(argv: Sequence[str]) -> Answer:
    """Run the command; returns its answer."""
    options = parse_options(RescaleSettings, argv, "scale")

    from geogs.application.rescale import rescale
    from geogs.application.scale.measurable_scene import scale_sentence

    found = rescale(options)
    return Answer(scale_sentence(found), {"folder": options.result, "scale": asdict(found)})
