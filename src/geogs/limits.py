"""Limits on the numbers of stored records, given by the types of their fields.

``Annotated`` gives a number or an array a :class:`~geogs.config.setting.Range`, or marks it as
:data:`UNBOUNDED`, a pose (:data:`RIGID`), or a :class:`Reference` to a row of a table. Floats
without a mark are finite.
"""

import math
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from geogs.config.setting import Range

FARTHEST = 1e12
"""Largest length of a map, in its unit, and largest scale; the inverse is the smallest."""
MOST_IDS = 1 << 22
"""Largest id: tables have a row for each id up to it. At two keyframes a second, 24 days."""
MOST_COUNTED = 1 << 53
"""Largest count: floats represent all whole numbers up to it."""


class _Unbounded:
    """Mark of numbers that may be infinite, but not NaN."""


@dataclass(frozen=True)
class Transform:
    """Rotation matrices, with a translation if 4 x 4, times one scale if ``is_scaled``."""

    is_scaled: bool = False


@dataclass(frozen=True)
class Reference:
    """Mark of numbers that are rows of a table."""

    table: str


UNBOUNDED = _Unbounded()
RIGID, SIMILARITY = Transform(), Transform(is_scaled=True)
AT_LEAST_0 = Range(0, FARTHEST)
POSITIVE = Range(1 / FARTHEST, FARTHEST)

Id = Annotated[int, Range(0, MOST_IDS)]
"""Unique number of an object among its kind, such as a frame."""
KeyframeId = Annotated[int, Range(0, MOST_IDS), Reference("keyframes")]
"""Id of a keyframe that exists."""
Number = Annotated[int, Range(0, MOST_COUNTED)]
"""A count."""
Positive = Annotated[float, POSITIVE]
AtLeast0 = Annotated[float, AT_LEAST_0]
Pose = Annotated[Float64[Tensor, "4 4"], RIGID]


def holds(marks: tuple[object, ...], value: Any) -> bool:
    """Whether a number or an array satisfies its marks; other values always do."""
    if isinstance(value, np.ndarray):
        value = torch.from_numpy(value)
    if isinstance(value, Tensor):
        return _array_holds(marks, value.detach())
    if isinstance(value, bool) or not isinstance(value, int | float):
        return True
    return _is_allowed(marks, value, value)


def _array_holds(marks: tuple[object, ...], array: Tensor) -> bool:
    if not array.numel():
        return True
    least, most = (float(x) for x in array.aminmax())
    return _is_allowed(marks, least, most) and all(
        _is_transform(array, mark.is_scaled) for mark in marks if isinstance(mark, Transform)
    )


def _is_allowed(marks: tuple[object, ...], least: float | int, most: float | int) -> bool:
    """Whether numbers from the least to the most are allowed; one of these is NaN if any is."""
    if math.isnan(least) or math.isnan(most):
        return False
    ends = (least, most)
    is_finite = UNBOUNDED in marks or all(map(math.isfinite, ends))
    ranges = (mark for mark in marks if isinstance(mark, Range))
    return is_finite and all(r.holds(x) for r in ranges for x in ends)


def _is_transform(T: Tensor, is_scaled: bool) -> bool:
    T = T.double()
    R = T[..., :3, :3]
    square = R @ R.mT
    scale = square[..., :1, :1] if is_scaled else square.new_ones(())
    error = (square / scale - torch.eye(3, dtype=R.dtype, device=R.device)).abs().max()
    # Largest error of an element of R R^T.
    is_rotation = bool(error < 1e-4) and bool((torch.linalg.det(R) > 0).all())
    if T.shape[-1] == 3:
        return is_rotation
    last = T.new_tensor([0.0, 0.0, 0.0, 1.0])
    is_near = bool(T[..., :3, 3].abs().max() < FARTHEST)
    return is_rotation and is_near and bool((T[..., 3, :] == last).all())
