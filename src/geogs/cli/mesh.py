"""``geogs mesh OUT``: the mesh of a result anew, without running again."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from geogs.application.result_settings import RemeshSettings
from geogs.cli.options import Given, parse_options


@dataclass(frozen=True)
class MeshOptions(RemeshSettings):
    """Make the mesh of a result again, with other settings.

    The keyframes' depth maps are rendered from the disks as the run rendered them; nothing is
    tracked or trained.
    """


def main(argv: Sequence[str]) -> int:
    """Run the command; returns the exit code."""
    options = parse_options(MeshOptions, argv, "mesh", _defaults)

    from geogs.application.results.remesh import remesh
    from geogs.application.terminal import TerminalProgress

    with TerminalProgress() as progress:
        path = remesh(options, progress)
    print(f"The mesh is {path}")
    return 0


def _defaults(given: Given) -> MeshOptions:
    """The settings that the result was made with."""
    from geogs.application.results.remesh import mesh_settings

    folder = Path(given["result"])
    return MeshOptions(folder, mesh_settings(folder))
