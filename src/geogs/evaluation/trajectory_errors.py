"""Errors of an estimated trajectory against the true one, and warnings where they may mislead."""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float, Int

from geogs.errors import GeogsError, InputError
from geogs.evaluation.rotation_errors import (
    best_rotation,
    relative_rotation_error,
    rotation_angle,
    stretches,
)
from geogs.geometry.umeyama import umeyama
from geogs.threads import on_one_torch_thread
from geogs.types import Trajectory

Alignment = Literal["sim3", "se3", "none"]

STRETCH = 0.1
"""Length of the stretches for relative rotation errors, relative to the whole path."""
MAX_ROLL = 5.0
"""Largest uncertainty of the aligned rotation, in degrees, for absolute rotation errors."""
FEWEST_MATCHED = 0.5
"""Least fraction of the shorter trajectory whose poses match in time."""
FEWEST_OF_ESTIMATE = 0.2
"""Least compared fraction of the estimate, where the truth has fewer poses."""
FEWEST_PAIRS = 8
"""Least number of poses; a similarity fits nearly any fewer."""
MAX_ERROR = 0.5
"""Largest error relative to the extent of the true path."""
MAX_SPEED = 150.0
"""Largest plausible speed of a camera, m/s."""
MAX_FACTOR = 1.5
"""Largest ratio of the sizes of two paths that are both given in metres."""


@dataclass(frozen=True)
class TrajectoryErrors:
    """Absolute trajectory error after alignment, with its data.

    Lengths in cm where the name ends so, else in metres (the unit of the reference).
    """

    ate_rmse_cm: float
    ate_mean_cm: float
    ate_median_cm: float
    ate_max_cm: float
    ate_std_cm: float
    rotation_rmse_deg: float
    """Angle between aligned and true orientation, root mean square."""
    relative_rotation_rmse_deg: float | None
    """Relative rotation error over stretches of the path, independent of the alignment; none where
    the reference does not move."""
    stretch_m: float
    """Length of these stretches."""
    roll_deg: float
    """Approximate uncertainty of the alignment's rotation about the line that fits the path best:
    the angle of the position error at the path's distance from it; 0 where the alignment is not by
    positions."""
    scale: float
    """Length in the reference per length in the estimate."""
    alignment: Alignment
    pairs: int
    """Number of compared poses."""
    estimated: int
    """Number of poses in the estimate."""
    reference: int
    """Number of poses in the reference."""
    path_length_m: float
    """Length of the compared part of the reference."""
    T_ref_est: Float[np.ndarray, "4 4"]
    """Similarity that moves the estimate into the reference frame."""
    timestamps: Float[np.ndarray, "n"]
    position_error: Float[np.ndarray, "n"]
    """Metres, per pair."""
    rotation_error: Float[np.ndarray, "n"]
    """Degrees, per pair."""
    relative_rotation_error: Float[np.ndarray, "n"]
    """Degrees, over the stretch that begins with each pair; NaN where none does."""
    aligned: Float[np.ndarray, "n 4 4"]
    """Estimated camera-to-world poses in the reference frame."""
    truth: Float[np.ndarray, "n 4 4"]

    @property
    def rotations(self) -> tuple[str, Float[np.ndarray, "n"], float]:
        """The kind of rotation errors to report, the errors, and their root mean square.

        It is "absolute" where the alignment is determined well enough, else "relative".
        """
        if self.roll_deg <= MAX_ROLL or self.relative_rotation_rmse_deg is None:
            return "absolute", self.rotation_error, self.rotation_rmse_deg
        return "relative", self.relative_rotation_error, self.relative_rotation_rmse_deg

    def as_dict(self) -> dict[str, Any]:
        """The numbers without the per-pose arrays, for JSON."""
        values = {k: getattr(self, k) for k in self.__dataclass_fields__}
        items = {k: v for k, v in values.items() if not isinstance(v, np.ndarray)}
        return items | {"T_ref_est": self.T_ref_est.tolist(), "rotations": self.rotations[0]}


def associate(
    reference: Float[np.ndarray, "n"], estimate: Float[np.ndarray, "m"], max_difference: float
) -> tuple[Int[np.ndarray, "k"], Int[np.ndarray, "k"]]:
    """Indices of poses that are each other's nearest in time, at most ``max_difference`` s apart.

    Both time series may be unsorted; no pose is used twice.
    """
    if not len(reference) or not len(estimate):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    to_estimate = _nearest(reference, estimate)
    to_reference = _nearest(estimate, reference)
    index = np.arange(len(reference))
    mutual = to_reference[to_estimate] == index
    near = np.abs(estimate[to_estimate] - reference) <= max_difference
    chosen = index[mutual & near]
    return chosen, to_estimate[chosen]


@on_one_torch_thread
def evaluate_trajectory(
    estimate: Trajectory,
    reference: Trajectory,
    max_difference: float = 0.02,
    alignment: Alignment = "sim3",
) -> TrajectoryErrors:
    """ATE of the camera positions, as computed by ``evo_ape tum -a(s)``.

    Poses are paired by time (:func:`associate`), the estimate is aligned (Sim(3) for monocular
    runs, whose scale is free) and compared. Poses that are not finite are left out. An estimate
    with orientations only, all at one position, is aligned by these, at scale 1.

    Raises InputError if fewer than three poses match in time or the motion does not determine an
    alignment.
    """
    estimate = finite_poses(estimate)
    reference = finite_poses(reference)
    i, j = associate(reference.timestamps, estimate.timestamps, max_difference)
    if len(i) < 3:
        raise InputError(_no_match(reference, estimate, len(i), max_difference))
    truth = reference.T_wc[i]
    guess = estimate.T_wc[j]
    by_positions = alignment != "none" and not (guess[:, :3, 3] == guess[0, :3, 3]).all()
    T = np.eye(4)
    scale = 1.0
    if by_positions:
        T, scale = _similarity(guess[:, :3, 3], truth[:, :3, 3], alignment == "sim3")
    elif alignment != "none":
        T[:3, :3] = best_rotation(guess[:, :3, :3], truth[:, :3, :3])
        T[:3, 3] = truth[:, :3, 3].mean(0) - T[:3, :3] @ guess[:, :3, 3].mean(0)
    aligned = np.tile(np.eye(4), (len(guess), 1, 1))
    aligned[:, :3, 3] = guess[:, :3, 3] @ T[:3, :3].T + T[:3, 3]
    aligned[:, :3, :3] = T[:3, :3] / scale @ guess[:, :3, :3]
    error = np.linalg.norm(aligned[:, :3, 3] - truth[:, :3, 3], axis=1)
    angle = rotation_angle(aligned[:, :3, :3], truth[:, :3, :3])
    order = np.argsort(reference.timestamps[i])
    steps = np.linalg.norm(np.diff(truth[order, :3, 3], axis=0), axis=1)
    path = float(steps.sum())
    relative = np.full(len(i), np.nan)
    if path > 0:
        first, last = (order[k] for k in stretches(np.r_[0, steps.cumsum()], STRETCH * path))
        relative[first] = relative_rotation_error(guess[:, :3, :3], truth[:, :3, :3], first, last)
    return TrajectoryErrors(
        ate_rmse_cm=100 * float(np.sqrt((error**2).mean())),
        ate_mean_cm=100 * float(error.mean()),
        ate_median_cm=100 * float(np.median(error)),
        ate_max_cm=100 * float(error.max()),
        ate_std_cm=100 * float(error.std()),
        rotation_rmse_deg=float(np.sqrt((angle**2).mean())),
        relative_rotation_rmse_deg=float(np.sqrt(np.nanmean(relative**2))) if path > 0 else None,
        stretch_m=STRETCH * path,
        roll_deg=_roll(truth[:, :3, 3], error) if by_positions else 0.0,
        scale=scale,
        alignment=alignment,
        pairs=len(i),
        estimated=len(estimate.timestamps),
        reference=len(reference.timestamps),
        path_length_m=path,
        T_ref_est=T,
        timestamps=reference.timestamps[i],
        position_error=error,
        rotation_error=angle,
        relative_rotation_error=relative,
        aligned=aligned,
        truth=truth,
    )


def _similarity(
    estimate: Float[np.ndarray, "n 3"], reference: Float[np.ndarray, "n 3"], with_scale: bool
) -> tuple[Float[np.ndarray, "4 4"], float]:
    """Least-squares similarity or rigid motion of ``estimate`` onto ``reference``; its scale."""
    x, y = (torch.from_numpy(np.ascontiguousarray(p, np.float64)) for p in (estimate, reference))
    try:
        scale, R, t = umeyama(x, y, with_scale)
    except GeogsError as reason:
        raise InputError(f"The trajectories cannot be aligned: {reason}") from None
    T = np.eye(4)
    T[:3, :3] = (scale * R).numpy()
    T[:3, 3] = t.numpy()
    return T, float(scale)


def _roll(positions: Float[np.ndarray, "n 3"], error: Float[np.ndarray, "n"]) -> float:
    """Angle in degrees of the error at the distance of a path from its best-fitting line."""
    across = np.linalg.svd(positions - positions.mean(0), compute_uv=False)[1:]
    return float(np.degrees(np.arctan2(np.linalg.norm(error), np.linalg.norm(across))))


def finite_poses(trajectory: Trajectory) -> Trajectory:
    """The trajectory without poses or times that are not finite."""
    good = np.isfinite(trajectory.T_wc).all((1, 2)) & np.isfinite(trajectory.timestamps)
    return Trajectory(trajectory.timestamps[good], trajectory.T_wc[good], trajectory.tracked[good])


def _nearest(times: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Index of the nearest of ``others`` for each time."""
    order = np.argsort(others, kind="stable")
    ordered = others[order]
    right = np.searchsorted(ordered, times).clip(0, len(others) - 1)
    left = (right - 1).clip(0)
    nearer = np.abs(ordered[left] - times) <= np.abs(ordered[right] - times)
    return order[np.where(nearer, left, right)]


def _no_match(reference: Trajectory, estimate: Trajectory, pairs: int, maximum: float) -> str:
    spans = [
        f"{t.timestamps.min():.3f} to {t.timestamps.max():.3f} s" if len(t.timestamps) else "empty"
        for t in (estimate, reference)
    ]
    return (
        f"Only {pairs} poses match within {maximum:g} s (estimate {spans[0]}, reference "
        f"{spans[1]}); check that both use the same clock, or raise --max-diff."
    )


def extent_of(T_wc: Float[np.ndarray, "n 4 4"]) -> float:
    """Root mean square distance of the positions from their mean; 0 where there are none."""
    places = T_wc[:, :3, 3]
    if not len(places):
        return 0.0
    return float(np.sqrt(np.square(places - places.mean(0)).sum(1).mean()))


def doubts(
    errors: TrajectoryErrors,
    estimate: Trajectory,
    reference: Trajectory,
    max_difference: float,
    is_metric: bool,
) -> list[str]:
    """Reasons why the errors may be misleading; empty if there are none.

    Args:
        errors: errors of the following two trajectories.
        estimate: estimated poses, in any unit.
        reference: true poses, in metres.
        max_difference: largest time difference of compared poses, seconds.
        is_metric: whether the estimate claims to be in metres.
    """
    sentences = (
        _of_times(errors, estimate, reference, max_difference),
        "" if errors.alignment == "none" else _of_alignment(errors),
        _of_size(errors, is_metric or errors.alignment == "se3"),
        _of_speed(errors),
    )
    return [sentence for sentence in sentences if sentence]


def _of_times(
    errors: TrajectoryErrors, estimate: Trajectory, reference: Trajectory, max_difference: float
) -> str:
    fewer = min(errors.estimated, errors.reference)
    if errors.pairs >= FEWEST_MATCHED * fewer:
        if errors.pairs >= FEWEST_OF_ESTIMATE * errors.estimated:
            return ""
        return (
            f"Only {errors.pairs} of {errors.estimated} estimated poses are compared, since the "
            f"truth has no more than {errors.reference}, from {_span(reference)}; the estimate is "
            f"from {_span(estimate)}. Of the other poses the errors say nothing."
        )
    return (
        f"Only {errors.pairs} of {fewer} poses match in time, and nothing else is compared: the "
        f"estimate is from {_span(estimate)}, the truth from {_span(reference)}. Give true poses "
        f"by the same clock (files without times count 30 a second), or --max-diff above "
        f"{max_difference:g}."
    )


def _of_alignment(errors: TrajectoryErrors) -> str:
    if errors.pairs < FEWEST_PAIRS:
        return f"{errors.pairs} poses are so few that a similarity fits them whatever they are."
    extent = extent_of(errors.truth)
    if 0.01 * errors.ate_rmse_cm > MAX_ERROR * extent:
        return (
            f"The error is {errors.ate_rmse_cm / max(extent, 1e-9):.0f} % of the true path's "
            "extent: they have hardly anything in common, or the camera hardly moved. The "
            "alignment means nothing then, nor does what follows from it."
        )
    if errors.roll_deg > MAX_ROLL:
        return (
            "The true path is so straight that the alignment leaves the rotation about it open by "
            f"some {errors.roll_deg:.0f} degrees: rotations are compared from pose to pose, and a "
            "surface may lie turned about the path."
        )
    return ""


def _of_size(errors: TrajectoryErrors, is_metric: bool) -> str:
    ratio = max(extent_of(errors.truth), 1e-9) / max(extent_of(errors.aligned), 1e-9)
    factor = errors.scale if errors.alignment == "sim3" else ratio
    if not is_metric or 1 / MAX_FACTOR < factor < MAX_FACTOR:
        return ""
    return (
        f"The true path is {factor:.3g} times as large as the estimated one, though both should be "
        "in metres."
    )


def _of_speed(errors: TrajectoryErrors) -> str:
    seconds = float(np.ptp(errors.timestamps))
    if errors.path_length_m <= MAX_SPEED * seconds:
        return ""
    return (
        f"The true camera moves {errors.path_length_m / max(seconds, 1e-9):.0f} metres a second: "
        "true poses should be in metres, and their times in seconds."
    )


def _span(trajectory: Trajectory) -> str:
    times = trajectory.timestamps
    return f"{times.min():.6g} to {times.max():.6g} s"
