"""``geogs scale OUT --from …``: convert a result to metres, without another run."""

from collections.abc import Sequence

from geogs.application.result_settings import RescaleSettings
from geogs.cli.options import parse_options
from geogs.terminal_text import say


def main(argv: Sequence[str]) -> int:
    """Run the command; returns the exit code."""
    options = parse_options(RescaleSettings, argv, "scale")

    from geogs.application.results.revise import rescale
    from geogs.application.scale.measurable_scene import scale_sentence

    say(scale_sentence(rescale(options)))
    return 0
