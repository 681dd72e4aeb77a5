"""nerfstudio's ``transforms.json``: https://docs.nerf.studio/quickstart/data_conventions.html.

Camera to world in OpenGL axes (x right, y up, z backward); the first pixel has its centre at
(0.5, 0.5). Depth images are z along the optical axis in steps of ``depth_unit_scale_factor``.
"""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from geogs.geometry.camera import Camera
from geogs.guard.atomic import write_text
from geogs.io.pose_files import OPENCV_FROM_OPENGL
from geogs.io.writers.exports.exported import ExportedImage

DEPTH_UNIT = 1e-3
"""Map units per step of a depth image, nerfstudio's default."""


def write_transforms(
    path: Path,
    camera: Camera,
    images: Sequence[ExportedImage],
    masked: Sequence[bool],
    depth_unit: float,
) -> None:
    """Write the file beside ``images/``, ``depth/``, ``normals/`` and ``masks/``.

    Args:
        path: the file.
        camera: camera of all images.
        images: names as they are in ``images/``; depth, normals and masks are PNG of that stem.
        masked: whether each image has a mask.
        depth_unit: map units per step of a depth image.
    """
    frames = []
    for image, has_mask in zip(images, masked, strict=True):
        stem = Path(image.name).stem
        frame = {
            "file_path": f"images/{image.name}",
            "transform_matrix": (np.linalg.inv(image.T_cw) @ OPENCV_FROM_OPENGL).tolist(),
            "depth_file_path": f"depth/{stem}.png",
            "normal_file_path": f"normals/{stem}.png",
        }
        frames.append({**frame, "mask_path": f"masks/{stem}.png"} if has_mask else frame)
    document = {
        "camera_model": "OPENCV",
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx + 0.5,
        "cy": camera.cy + 0.5,
        "k1": 0.0,
        "k2": 0.0,
        "p1": 0.0,
        "p2": 0.0,
        "depth_unit_scale_factor": depth_unit,
        "ply_file_path": "points.ply",
        "frames": frames,
    }
    write_text(path, json.dumps(document, indent=1) + "\n")
