"""What an export is told: the same record for a command and a script."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from geogs.config.setting import Basic, Positional, Range, Settings

Format = Literal[
    "colmap", "nerfstudio", "gsplat", "cloud", "depth", "normals", "kitti", "euroc", "tum", "glb",
    "obj", "splats",
]  # fmt: skip


@dataclass(frozen=True)
class ExportSettings(Settings):
    """All that an export is told."""

    result: Annotated[Path, Positional()]
    """Folder of a result, as geogs run and geogs reconstruct write it."""
    to: Format
    """What to write; docs/formats.md says how each format is laid out."""
    output: Annotated[Path | None, Basic("-o")] = None
    """Folder or file; export/FORMAT in the folder of the result if none is given. A cloud that ends
    in .las becomes LAS, else PLY."""
    text: bool = False
    """Write a COLMAP model as text, which is binary otherwise."""
    points: Annotated[int, Range(100, 10_000_000)] = 50_000
    """Points with tracks to look for in colmap and nerfstudio."""
    textured: bool = False
    """Give a glb an image of its surface, put together from the keyframes' images, instead of
    vertex colours."""
    texture_size: Annotated[int, Range(64, 16384)] = 4096
    """Longest side of that image, pixels; it is no larger than the keyframes' images call for."""
    sh_degree: Annotated[int, Range(0, 4)] = 3
    """Degree of the spherical harmonics in splats; all but the constant one are zero, and some
    viewers insist on them."""
    device: str = "auto"
    """Where to render: auto (a GPU where there is one), cpu, cuda or cuda:1."""
