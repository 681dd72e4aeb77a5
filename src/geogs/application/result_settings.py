"""Settings of the commands that take a result, for a command and a script.

This module imports only the settings, so that a command line can be read at once.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

from geogs.config import MeshConfig, Seed
from geogs.config.setting import Basic, Count, Port, Positional, Positive, Range, Settings

Format = Literal[
    "colmap", "nerfstudio", "gsplat", "cloud", "depth", "normals", "kitti", "euroc", "tum", "glb",
    "obj", "splats", "stl", "usdz", "plan", "section",
]  # fmt: skip

HERE = "127.0.0.1"
"""Address that only this machine can reach."""


@dataclass(frozen=True)
class ExportSettings(Settings):
    """Write a result in the format of another program; docs/formats.md says how each is laid out.

    Image sets: colmap, nerfstudio, depth, normals. Paths of the camera: kitti, euroc, tum.
    Surfaces: glb, usdz (phones), obj, stl, cloud (PLY, LAS). Drawings: plan, section (SVG, PDF,
    DXF). Splats: splats (3DGS and 2DGS), gsplat (start values).
    """

    result: Annotated[Path, Positional()]
    """Folder of a result, as geogs run and geogs reconstruct write it."""
    to: Format
    """What to write; docs/formats.md says how each format is laid out."""
    output: Annotated[Path | None, Basic("-o")] = None
    """Folder or file; export/FORMAT in the folder of the result if none is given. A cloud that ends
    in .las becomes LAS, else PLY; a drawing that ends in .svg, .pdf or .dxf is written as that
    alone."""
    as_tracked: bool = False
    """Keep the axes of the run, or of the poses that were given, instead of standing upright."""
    text: bool = False
    """Write a COLMAP model as text, which is binary otherwise."""
    points: Annotated[int, Range(100, 10_000_000)] = 50_000
    """Points with tracks to look for in colmap and nerfstudio."""
    images: tuple[str, ...] = ()
    """For colmap and nerfstudio: the video or folder that the run read, whose images are exported
    at full size, undistorted; by default those that the run kept. Several as the run read them."""
    crop: str = ""
    """Part of a surface, a drawing or of splats: x0,y0,z0,x1,y1,z1 (a box: right, forward, up), or
    near:DISTANCE (from the camera's path)."""
    cut: float | None = None
    """Where a drawing is cut: a plan's height over the floor, by default 1.2 m, or a third of the
    height where metres are not known; a section's distance in front of the middle of the path."""
    textured: bool = True
    """Give a glb or usdz an image of its surface, put together from the keyframes' images, if they
    were kept, instead of vertex colours."""
    texture_size: Annotated[int, Range(64, 16384)] = 4096
    """Longest side of that image, pixels; it is no larger than the keyframes' images call for."""
    sh_degree: Annotated[int, Range(0, 4)] = 3
    """Degree of the spherical harmonics in splats; all but the constant one are zero, and some
    viewers insist on them."""
    device: str = "auto"
    """Where to render: auto (a GPU where there is one), cpu, cuda or cuda:1."""

    def scaled(self, factor: float) -> "ExportSettings":
        """The same export of a result whose lengths were multiplied."""
        word, colon, numbers = self.crop.rpartition(":")
        cropped = ",".join(f"{factor * float(n):.9g}" for n in numbers.split(",") if n)
        cut = None if self.cut is None else factor * self.cut
        return replace(self, crop=word + colon + cropped, cut=cut)


@dataclass(frozen=True)
class RemeshSettings(Settings):
    """Make the mesh of a result again, with other settings.

    The keyframes' depth maps are rendered from the disks as the run rendered them; nothing is
    tracked or trained.
    """

    result: Annotated[Path, Positional()]
    """Folder of a result, as geogs run and geogs reconstruct write it."""
    mesh: MeshConfig = field(default_factory=MeshConfig)
    """How the surface is made; what is not given is as the result was made with."""
    output: Annotated[Path | None, Basic("-o")] = None
    """File of the mesh, PLY; mesh.ply in the folder of the result if none is given."""
    device: str = "auto"
    """Where to compute: auto (a GPU where there is one), cpu, cuda or cuda:1."""


@dataclass(frozen=True)
class RescaleSettings(Settings):
    """Bring a result to metres by something whose length is known.

    Trajectories, map, splats, meshes, summary, page and exports in its folder are made anew, in
    metres; an evaluation is deleted.
    """

    result: Annotated[Path, Positional()]
    """Folder of a result, as geogs run writes it."""
    scale_from: Annotated[str, Basic("--from")] = ""
    """What is known in metres: FRAME:u1,v1,u2,v2=1.25m (pixels of an image as it came; several with
    semicolons), aruco:DICT_5X5_50:0.12 (tags whose side is so long), or height:1.6 (of the camera
    over the ground)."""
    device: str = "auto"
    """Where to compute: auto (a GPU where there is one), cpu, cuda or cuda:1."""


@dataclass(frozen=True)
class LocateSettings(Settings):
    """Find where a photograph was taken, in the map of a result of the same camera.

    Prints its pose, the standard deviation and the nearest keyframes; a picture shows it beside the
    map from there.
    """

    photo: Annotated[Path, Positional()]
    """The photograph."""
    map: Annotated[Path, Basic()]
    """Folder of a result, as geogs run and geogs reconstruct write it."""
    intrinsics: Annotated[str, Basic()] = "auto"
    """Lens of the photograph, as geogs run takes it; auto is that of the result."""
    output: Annotated[Path, Basic("-o")] = Path("located")
    """Folder for the picture and the pose as JSON."""
    device: str = "auto"
    """Where to compute: auto (a GPU where there is one), cpu, cuda or cuda:1."""


@dataclass(frozen=True)
class ViewSettings(Settings):
    """Look at a result in the browser: mesh, disks, path, keyframes with depth and normals.

    Needs pip install 'geogs[viewer]'; without it, open report/index.html of the result. Over ssh:
    ssh -L 8080:localhost:8080 MACHINE, then the address it prints on your own machine.
    """

    result: Annotated[Path, Positional()]
    """Folder of a result, as geogs run and geogs reconstruct write it."""
    port: Annotated[Port, Basic("-p")] = 8080
    """Where the page is served; if it is taken, the next that is free."""
    host: str = HERE
    """Address at which it is served; 0.0.0.0 lets other machines look, too."""


@dataclass(frozen=True)
class EvalSettings(Settings):
    """Compare a result with the truth: trajectory, and surface where a true one is found.

    Writes eval.json and report/ into the result's folder and prints the table.
    """

    output: Annotated[Path, Positional()]
    """Folder of a result, as ``geogs run`` writes it."""
    gt: Path
    """True poses: a TUM file, a traj.txt of 4x4 rows (row k is at k / 30 s), the file of a data set
    (KITTI, EuRoC, TUM-VI, TartanAir, ARKitScenes, ICL-NUIM), or the folder of a sequence, or of
    images with known poses (COLMAP, DTU...); the true surface is then found, too."""
    protocol: Literal["area", "samples", "vertex", "object", "dtu"] = "area"
    """How surfaces are compared: by area with exact distances, area-weighted from samples to
    samples (NICE-SLAM), vertex-weighted (Splat-SLAM, HI-SLAM2), a single object inside its masks
    in mm, or DTU's in mm."""
    gt_mesh: Path | None = None
    """True surface as PLY in metres, in the frame of the true poses."""
    gt_points: Path | None = None
    """Points of the true surface that the camera saw, PLY; completeness is then measured on
    them."""
    surface: bool = True
    """Compare the surface too."""
    cull: bool = False
    """Count only what the true cameras saw of the surfaces (frustum and occlusion)."""
    cull_rule: Literal["frustum", "occlusion"] = "frustum"
    """How the samples and vertex protocols cull meshes: NICE-SLAM's rule or Neural RGB-D's."""
    cull_every: Count = 10
    """Use every so many true poses for culling."""
    icp: bool = False
    """Refine the alignment of the surface by ICP (0.1 m), as Replica's usual scripts do; the
    samples and vertex protocols always do."""
    max_diff: Positive = 0.02
    """Largest time between poses that are compared, seconds."""
    alignment: Literal["auto", "sim3", "se3", "none"] = "auto"
    """Auto takes Sim(3), as the scale of monocular results is arbitrary, but leaves what was made
    with known poses as it is."""
    threshold: Positive | None = None
    """Distance that counts as reached, metres; 0.05, for objects 0.001."""
    samples: Annotated[int | None, Range(1, 1_000_000_000)] = None
    """Points on each surface; 200 000, for objects 4 000 000."""
    dtu_data: Path | None = None
    """Folder of the official DTU evaluation, with ObsMask and Points/stl."""
    dtu_scan: Annotated[int | None, Range(1, 1000)] = None
    """Number of the scan; by the name of the folder of the poses if none is given."""
    photo: bool = False
    """Measure how well the images beside the true poses agree on the surface (no truth needed)."""
    photo_every: Count = 8
    """In every so many images, which the result should not have used."""
    seed: Seed = 0
    """Seed of the sampling."""
    plots: bool = True
    """Draw the pictures of the report."""
