"""``geogs export OUT --to FORMAT``: a result in the formats of other programs."""

from collections.abc import Sequence
from dataclasses import dataclass

from geogs.application.result_settings import ExportSettings
from geogs.cli.options import parse_options


@dataclass(frozen=True)
class ExportOptions(ExportSettings):
    """Write a result in the format of another program; docs/formats.md says how each is laid out.

    Image sets: colmap, nerfstudio, depth, normals. Paths of the camera: kitti, euroc, tum.
    Surfaces: glb, obj, cloud (PLY, LAS). Splats: splats (3DGS and 2DGS), gsplat (start values).
    """


def main(argv: Sequence[str]) -> int:
    """Run the command; returns the exit code."""
    options = parse_options(ExportOptions, argv, "export")

    from geogs.application.export.export import export

    print(f"Written: {export(options)}")
    return 0
