"""``geogs mesh OUT``: extract the mesh of a result again, without another run."""

from collections.abc import Sequence
from pathlib import Path

from geogs.application.result_settings import RemeshSettings
from geogs.cli.answer import Answer
from geogs.cli.options import Given, parse_options
from geogs.guard.terminal_text import printable


def main(argv: Sequence[str]) -> Answer:
    """Run the command; returns its answer."""
    options = parse_options(RemeshSettings, argv, "mesh", _defaults)

    from geogs.application.progress.terminal_progress import TerminalProgress
    from geogs.application.results.revise import remesh

    with TerminalProgress() as progress:
        path = remesh(options, progress)
    return Answer(f"The mesh is {printable(path)}", {"path": path})


def _defaults(given: Given) -> RemeshSettings:
    """The settings of the result."""
    from geogs.application.results.revise import mesh_settings

    folder = Path(given["result"])
    return RemeshSettings(folder, mesh_settings(folder))
