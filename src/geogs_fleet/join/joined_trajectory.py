"""The frames of all parts in the joint world and in one time."""

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from geogs.geometry.lie import sim3_scale, so3_exp, so3_log
from geogs.io.sources.frame_source import PAUSE, RecordingSpan
from geogs.types import Trajectory
from geogs_fleet.join.part import PartViews
from geogs_fleet.join.part_graph import Placement


def spans_of(names: list[str], times: list[Float64[np.ndarray, "n"]]) -> list[RecordingSpan]:
    """Spans of the parts one after the other, like those of several videos in ``geogs run``."""
    spans: list[RecordingSpan] = []
    frames, end = 0, 0.0
    for name, own in zip(names, times, strict=True):
        first = end + PAUSE if spans else float(own[0])
        spans.append(RecordingSpan(name, frames, first, float(own[0])))
        frames, end = frames + len(own), float(own[-1]) + first - float(own[0])
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
