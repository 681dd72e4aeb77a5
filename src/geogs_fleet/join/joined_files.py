"""Files of a joint result, the same as those of a run."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from geogs.application.results.saved_result import SavedResult
from geogs.application.results.write import write_config
from geogs.config import Config
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_inverse, sim3_scale, so3_exp, so3_log
from geogs.guard.atomic import atomic_file, write_text
from geogs.guard.documents import read_bytes
from geogs.io.sources.frame_source import PAUSE, RecordingSpan
from geogs.io.writers.intrinsics_file import write_intrinsics
from geogs.io.writers.keyframe_folder import image_path, rows_path, write_image, write_rows
from geogs.io.writers.map_file import MapViews, save_map_with_views
from geogs.io.writers.trajectories import write_trajectories
from geogs.io.writers.uncertainty import HEADER, moved_rows
from geogs.mapping.map_frame import WORLD
from geogs.types import MapSnapshot, SeenRows, Trajectory
from geogs_fleet.join.part import PartViews, image_of
from geogs_fleet.join.part_graph import Placement


def spans_of(names: list[str], times: list[Float64[np.ndarray, "n"]]) -> list[RecordingSpan]:
    """Spans of the parts one after the other, like those of several videos in ``geogs run``."""
    spans: list[RecordingSpan] = []
    frames = 0
    end = 0.0
    for name, own in zip(names, times, strict=True):
        first = end + PAUSE if spans else float(own[0])
        spans.append(RecordingSpan(name, frames, first, float(own[0])))
        frames = frames + len(own)
        end = float(own[-1]) + first - float(own[0])
    return spans


def moved_trajectory(trajectory: Trajectory, views: PartViews, placement: Placement) -> Trajectory:
    """Poses of a part's frames in the joint world, interpolated in time between keyframes."""
    S = placement.similarities(views.T_cw)
    times = views.timestamp
    at = trajectory.timestamps.clip(times[0], times[-1])
    after = np.searchsorted(times, at).clip(min(1, len(times) - 1), len(times) - 1)
    before = (after - 1).clip(min=0)
    length = np.maximum(times[after] - times[before], 1e-12)
    fraction = torch.from_numpy(((at - times[before]) / length).clip(0, 1))
    T_wc = torch.from_numpy(trajectory.T_wc)
    first, second = (_moved(S[torch.from_numpy(n)], T_wc) for n in (before, after))
    moved = first.clone()
    rotation = so3_log(second[:, :3, :3] @ first[:, :3, :3].mT)
    moved[:, :3, :3] = so3_exp(fraction[:, None] * rotation) @ first[:, :3, :3]
    moved[:, :3, 3] += fraction[:, None] * (second[:, :3, 3] - first[:, :3, 3])
    return Trajectory(trajectory.timestamps, moved.numpy(), trajectory.tracked, trajectory.oriented)


def _moved(S: Float[Tensor, "n 4 4"], T_wc: Float[Tensor, "n 4 4"]) -> Float[Tensor, "n 4 4"]:
    """Camera-to-world poses by world similarities."""
    moved = S @ T_wc
    moved[:, :3, :3] /= sim3_scale(S)[:, None, None]
    return moved


def joined_trajectory(parts: list[Trajectory], spans: list[RecordingSpan]) -> Trajectory:
    """The trajectories one after the other, in the joint time."""
    times = [t.timestamps + span.shift for t, span in zip(parts, spans, strict=True)]
    return Trajectory(
        np.concatenate(times),
        np.concatenate([t.T_wc for t in parts]),
        np.concatenate([t.tracked for t in parts]),
    )


@dataclass(frozen=True)
class JoinedPart:
    """A part with its poses in the joint world."""

    result: SavedResult
    views: PartViews
    placement: Placement
    span: RecordingSpan


def write_poses(output: Path, parts: Sequence[JoinedPart]) -> Trajectory:
    """Write ``trajectory.tum``, ``keyframes.tum`` and the table of the frames' uncertainty.

    Returns the trajectory. Raises OutputError if a file cannot be written.
    """
    moved = [moved_trajectory(p.result.trajectory, p.views, p.placement) for p in parts]
    trajectory = joined_trajectory(moved, [part.span for part in parts])
    keyframes = Trajectory(
        _times(parts),
        np.concatenate([se3_inverse(part.placement.T_cw).numpy() for part in parts]),
        np.ones(sum(len(part.views.timestamp) for part in parts), bool),
    )
    write_trajectories(output, trajectory, keyframes)
    rows = [row for part in parts for row in _uncertainty_rows(part)]
    if rows:
        write_text(output / "trajectory_uncertainty.csv", "\n".join([HEADER, *rows, ""]))
    return trajectory


def write_map(
    output: Path, parts: Sequence[JoinedPart], disks: MapSnapshot, camera: Camera, config: Config
) -> None:
    """Write the disks, the keyframes of all parts, their images, the camera and the settings.

    Raises:
        InputError: an image of a part cannot be read.
        OutputError: a file cannot be written.
    """
    first = parts[0].result.views
    count = 0
    rows = dict[int, SeenRows]()
    for part in parts:
        own = part.result.rows() if part.result.camera == camera else {}
        for n, id in enumerate(part.result.views.keyframe_id.tolist()):
            target = image_path(output, count)
            if part.result.camera == camera:
                part.result.image(n)  # fails unless it is an image, also behind a link
                with atomic_file(target) as stream:
                    stream.write(read_bytes(image_path(part.result.folder, id)))
            else:
                write_image(target, image_of(part.result, n, camera))
            if n in own:
                rows[count] = own[n]
            count += 1
    if rows:
        write_rows(rows_path(output), rows)
    T_cw = np.concatenate([part.placement.T_cw.numpy() for part in parts])
    long_edge = max(first.render_camera.width, first.render_camera.height)
    views = MapViews(
        camera=camera,
        render_camera=camera.with_long_edge(long_edge),
        min_alpha=first.min_alpha,
        max_spread=first.max_spread,
        plane_reach=first.plane_reach,
        origin=WORLD.origin,
        unit=WORLD.unit,
        disks=disks,
        keyframe_id=np.arange(count),
        timestamp=_times(parts),
        T_cw=T_cw,
        has_mask=np.zeros(count, bool),
        has_images=True,
    )
    metadata = {"source": " + ".join(part.span.name for part in parts), "seed": config.seed}
    save_map_with_views(output / "map.safetensors", views, metadata)
    write_intrinsics(output / "intrinsics.json", camera)
    write_config(output / "config.yaml", config)


def fingerprint(parts: Sequence[SavedResult]) -> str:
    """Fingerprint of a joint result, from those of its parts."""
    words = [str(part.summary.get("fingerprint", part.folder)) for part in parts]
    return hashlib.sha256("\n".join(words).encode()).hexdigest()[:16]


def _times(parts: Sequence[JoinedPart]) -> Float64[np.ndarray, "n"]:
    return np.concatenate([part.views.timestamp + part.span.shift for part in parts])


def _uncertainty_rows(part: JoinedPart) -> list[str]:
    """Rows of a part's table in the joint time and unit; standard deviations are the part's."""
    path = part.result.folder / "trajectory_uncertainty.csv"
    return moved_rows(path, 1 / float(part.placement.scale.median()), part.span.shift)
