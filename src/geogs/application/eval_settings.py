"""What an evaluation is told: the same record for a command and a script."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from geogs.config import Seed
from geogs.config.setting import Count, Positional, Positive, Range, Settings


@dataclass(frozen=True)
class EvalSettings(Settings):
    """All that an evaluation is told."""

    output: Annotated[Path, Positional()]
    """Folder of a result, as ``geogs run`` writes it."""
    gt: Path
    """True poses: a TUM file, a traj.txt of 4x4 rows (row k is at k / 30 s), or the folder of a
    Replica, TUM, 7-Scenes or synthetic sequence, or of images with known poses (COLMAP, DTU...);
    the true surface is then found, too."""
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
    """Of the sampling."""
    plots: bool = True
    """Draw the pictures of the report."""
