"""Where a photograph was taken: its pose in the map of a result."""

import json
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64

from geogs.application.result_settings import LocateSettings
from geogs.application.results.output_folder import claimed
from geogs.application.results.result_page import result_lengths
from geogs.application.results.saved_result import SavedResult, load_result
from geogs.application.run import opened_in
from geogs.application.slam_in_python import go_on_in, new_slam
from geogs.config import Config, InputConfig
from geogs.errors import InputError
from geogs.evaluation.pages.run_pictures import draw_keyframes
from geogs.geometry.lie import matrix_to_quaternion
from geogs.gpu.installation import require_device
from geogs.guard.atomic import write_text
from geogs.guard.replacement import replaced
from geogs.io.sources.sniff import open_picture
from geogs.pose_estimate import PoseEstimate
from geogs.threads import on_one_torch_thread
from geogs.types import Frame


@dataclass(frozen=True)
class NearKeyframe:
    """A keyframe of the map, as seen from the photograph."""

    number: int
    """Index among the keyframes of the result."""
    timestamp: float
    """Seconds."""
    distance: float
    """Between the cameras, map units."""
    angle_deg: float
    """Between their orientations."""


@dataclass(frozen=True)
class Located:
    """Pose of a photograph in a map."""

    pose: PoseEstimate
    """With a pose."""
    nearest: tuple[NearKeyframe, ...]
    """Those that see most nearly the same."""
    picture: Path
    """The photograph beside the map from its pose, and the nearest keyframe."""
    unit: str
    """Name of the unit of length of the map."""

    def lines(self) -> list[str]:
        """Sentences for a terminal."""
        pose = self.pose
        T_wc = np.linalg.inv(np.eye(4) if pose.T_cw is None else pose.T_cw)
        w, x, y, z = matrix_to_quaternion(torch.from_numpy(T_wc[:3, :3])).tolist()
        row = " ".join(f"{n:.6g}" for n in (*T_wc[:3, 3].tolist(), x, y, z, w))
        lines = [f"Camera to world, x y z qx qy qz qw: {row}"]
        if pose.sigma_position < np.inf:
            turned = np.degrees(pose.sigma_rotation)
            lines.append(
                f"Standard deviation: {pose.sigma_position:.2g} {self.unit}, {turned:.2g} degrees"
            )
        lines += [
            f"Near keyframe {k.number + 1} ({k.timestamp:.2f} s): {k.distance:.3g} {self.unit} "
            f"away, turned by {k.angle_deg:.1f} degrees"
            for k in self.nearest
        ]
        return [*lines, f"Picture: {self.picture}"]

    def as_dict(self) -> dict[str, object]:
        """Values for JSON."""
        pose = self.pose
        known = pose.sigma_position < np.inf
        return {
            "T_wc": None if pose.T_wc is None else pose.T_wc.tolist(),
            "sigma_position": pose.sigma_position if known else None,
            "sigma_rotation_deg": float(np.degrees(pose.sigma_rotation)) if known else None,
            "nearest": [vars(keyframe) for keyframe in self.nearest],
        }


@on_one_torch_thread
def locate(settings: LocateSettings) -> Located:
    """Locate a photograph in the map of a result; writes a picture and the pose as JSON.

    Raises:
        InputError: photograph or result cannot be read, or it was not found in the map.
        OutputError: a file cannot be written.
        DeviceError: the device cannot be used.
    """
    device = require_device(settings.device)
    base = load_result(settings.map, device)
    base.require_images()
    given = InputConfig(intrinsics=settings.intrinsics)
    source = opened_in(base, given, partial(open_picture, settings.photo))
    slam = new_slam(source, Config(input=given), device)
    go_on_in(slam, base)
    frame = next(iter(source))
    pose = slam.process(frame)
    if pose.T_cw is None:
        raise InputError(
            f"{settings.photo} was not found in {base.folder}: it shows too little of what the map "
            "shows; take one nearer to a keyframe, of the same camera."
        )
    nearest = near_keyframes(pose.T_cw, base)
    name = f"{settings.photo.stem}.png"
    located = Located(pose, nearest, settings.output / name, result_lengths(base).name)
    with claimed(settings.output) as output, replaced(output, "beside") as new:
        _draw(new / name, frame, pose.T_cw, base, nearest[0].number)
        document = json.dumps(located.as_dict(), indent=2) + "\n"
        write_text((new / name).with_suffix(".json"), document)
    return located


def near_keyframes(
    T_cw: Float64[np.ndarray, "4 4"], result: SavedResult
) -> tuple[NearKeyframe, ...]:
    """The three keyframes nearest to a pose, by distance over the depths and by orientation."""
    T_wc = np.linalg.inv(result.views.T_cw)
    distance = np.linalg.norm(T_wc[:, :3, 3] - np.linalg.inv(T_cw)[:3, 3], axis=1)
    cosine = (np.einsum("kij,ij->k", result.views.T_cw[:, :3, :3], T_cw[:3, :3]) - 1) / 2
    angle = np.arccos(cosine.clip(-1, 1))
    order = np.argsort(distance / _depth(result) + angle, kind="stable")[:3]
    return tuple(
        NearKeyframe(
            int(k), float(result.views.timestamp[k]), float(distance[k]),
            float(np.degrees(angle[k])),
        )
        for k in order
    )  # fmt: skip


def _depth(result: SavedResult) -> float:
    """Median distance of the disks from the middle of the keyframes."""
    centres = np.linalg.inv(result.views.T_cw)[:, :3, 3]
    offset = result.disks.position.cpu().numpy() - np.median(centres, axis=0)
    return max(float(np.median(np.linalg.norm(offset, axis=1))), 1e-12)


def _draw(
    path: Path, frame: Frame, T_cw: Float64[np.ndarray, "4 4"], result: SavedResult, number: int
) -> None:
    """Draw the photograph and the nearest keyframe, each beside the map from its pose."""
    views = [result.render(T_cw), result.render(result.views.T_cw[number])]
    keyframe = result.image(number)
    assert keyframe is not None, "results without images are refused"
    images = [frame.image, keyframe]
    depths = [view.depth for view in views]
    normals = [view.normal for view in views]
    draw_keyframes(path, images, depths, normals, result_lengths(result).name)
