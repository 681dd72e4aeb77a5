"""``geogs locate PHOTO --map OUT``: where a photograph was taken."""

from collections.abc import Sequence

from geogs.application.result_settings import LocateSettings
from geogs.cli.options import parse_options


def main(argv: Sequence[str]) -> int:
    """Run the command; returns the exit code."""
    options = parse_options(LocateSettings, argv, "locate")

    from geogs.application.locate import locate

    for line in locate(options).lines():
        print(line)
    return 0
