"""``geogs export OUT --to FORMAT``: a result in the formats of other programs."""

from collections.abc import Sequence

from geogs.application.result_settings import ExportSettings
from geogs.cli.answer import Answer
from geogs.cli.options import parse_options
from geogs.guard.terminal_text import printable


def main(argv: Sequence[str]) -> Answer:
    """Run the command; returns its answer."""
    options = parse_options(ExportSettings, argv, "export")

    from geogs.application.export.export import export

    path = export(options)
    return Answer(f"Written: {printable(path)}", {"format": options.to, "path": path})
