"""``geogs locate PHOTO --map OUT``: where a photograph was taken."""

from collections.abc import Sequence

from geogs.application.result_settings import LocateSettings
from geogs.cli.answer import Answer
from geogs.cli.options import parse_options
from geogs.guard.terminal_text import printable


def main(argv: Sequence[str]) -> Answer:
    """Run the command; returns its answer."""
    options = parse_options(LocateSettings, argv, "locate")

    from geogs.application.locate import locate

    found = locate(options)
    return Answer(
        "\n".join(map(printable, found.lines())), {**found.as_dict(), "picture": found.picture}
    )
