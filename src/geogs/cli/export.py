"""``geogs export OUT --to FORMAT``: a result in the formats of other programs."""

from collections.abc import Sequence

from geogs.application.result_settings import ExportSettings
from geogs.cli.options import parse_options
from geogs.terminal_text import say


def main(argv: Sequence[str]) -> int:
    """Run the command; returns the exit code."""
    options = parse_options(ExportSettings, argv, "export")

    from geogs.application.export.export import export

    say(f"Written: {export(options)}")
    return 0
