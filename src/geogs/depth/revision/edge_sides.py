"""Which side of an edge the pixels of a depth map show, by images and other depths together.

What is grown by a window, or rendered from disks that overhang an edge, stands some pixels too far
on the farther surface. Of the images alone one learns that little by little
(:mod:`geogs.depth.revision.far_side`); once the other keyframes have depths, too, these see through
what is not there, or stop at it.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from geogs.depth.depth_engine import DepthEngine
from geogs.depth.depth_view import DenseDepth, DepthView, PosedDepth
from geogs.depth.revision.far_side import APART, PASSES, REACH
from geogs.geometry.camera import Camera

AGREES = 0.03
"""Difference of the logarithms up to which another depth is of the same surface."""
SEES_THROUGH = 0.95
"""Part of another depth before which a point stands in the free space of that view."""
PHOTO, SUPPORT = 9.0, 0.4
"""Logit of the chance that the farther side is right: times how much less it costs by
``photo_costs``, and how much more support it has. A logistic regression on every third keyframe of
two dining rooms and a room; the constant came out as 0."""
MOVED_CONFIDENCE = 0.6
"""Confidence of a depth that was moved: what both say is right more often than not."""


def on_their_sides(
    engine: DepthEngine,
    view: DepthView,
    found: DenseDepth,
    others: Sequence[tuple[DepthView, PosedDepth]],
    camera: Camera,
) -> DenseDepth:
    """A view's depth with the farther surface where that is likelier; nothing moves in the sky.

    As in ``FarSideSearch`` the plane of a farther surface goes on to the pixels beside it.

    Args:
        engine: whose images of the views are asked.
        view: the depth is of it.
        found: its depth.
        others: what it is compared with, and their depths.
        camera: of all depths.
    """
    if not others:
        return found
    views, depths = [other for other, _ in others], [posed for _, posed in others]
    depth, moved = found.depth, torch.zeros_like(found.depth, dtype=torch.bool)
    reach = round(REACH * max(depth.shape))
    for _ in range(PASSES):
        beyond = engine.farther_surface(depth, reach, APART)
        there = beyond > 0 if found.sky is None else (beyond > 0) & ~found.sky
        both = torch.stack([depth, torch.where(there, beyond, depth)])
        here, other = engine.photo_costs(view, views, both, ~there, there)
        gain = torch.zeros_like(depth)
        near, far = (
            support(camera.back_project(z)[there], view.T_cw, depths, camera) for z in both
        )
        gain[there] = far - near
        moves = there & (PHOTO * (here - other) + SUPPORT * gain > 0)
        depth = torch.where(moves, beyond, depth)
        moved |= moves
    confidence = torch.where(moved, MOVED_CONFIDENCE, found.confidence)
    # The normal that came with the depth is that of the nearer surface.
    normal = None if found.normal is None else torch.where(moved[..., None], 0.0, found.normal)
    return replace(found, depth=depth, confidence=confidence, normal=normal)


def support(
    points: Float[Tensor, "p 3"],
    T_cw: Float[np.ndarray, "4 4"],
    others: Sequence[PosedDepth],
    camera: Camera,
) -> Float[Tensor, "p"]:
    """Sum of the confidences of the others' depths that agree with each point, less those of the
    depths that see through it.

    Depths and confidences of the others are interpolated; where a point is outside another view, or
    hidden from it, that says nothing. ``points`` are in the frame of a camera at ``T_cw``.
    """
    poses = np.stack([other.T_cw for other in others]) @ np.linalg.inv(T_cw)
    T = torch.from_numpy(poses).to(points)
    pixel, z = camera.project(points @ T[:, :3, :3].mT + T[:, None, :3, 3])
    last = pixel.new_tensor([camera.width - 1, camera.height - 1])
    inside = (z > 0) & ((pixel >= 0) & (pixel <= last)).all(-1)
    maps = torch.stack([torch.stack([o.depth.depth, o.depth.confidence]) for o in others])
    place = (2 * pixel / last - 1)[:, None]
    found = F.grid_sample(maps, place, align_corners=True, padding_mode="border")
    there, confidence = found[:, :, 0].unbind(1)
    ratio = z / there
    agrees, through = (ratio.log().abs() < AGREES), ratio < SEES_THROUGH
    said = torch.where(agrees, confidence, 0.0) - torch.where(through, confidence, 0.0)
    return torch.where(inside, said, 0.0).sum(0)
