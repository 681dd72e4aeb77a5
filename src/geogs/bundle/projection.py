"""Projection of source cells into target frames, and its derivatives.

A cell with ray X and inverse depth d lies at y = R X + d t in the target, in units of its depth in
the source, for T_ji = (R, t). Functions of y alone are shared by all cameras: the tracker's, which
is here too, the lens with unknowns (:mod:`geogs.bundle.lens`) and the batch of cameras of the
training. Each of them multiplies the same derivatives of a point by those of its own image, in its
own order: one order for all would change the last bits of results.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_inverse

MIN_Z = 0.05
"""Least depth of a point in the target, over that in the source; nearer points are ignored."""
INVERSE_DEPTHS = 1e-3, 1e2
"""Least and largest inverse depth of a cell after an adjustment, per map unit."""


@dataclass(frozen=True)
class CellProjection:
    """Positions of the sources' cells in the targets."""

    pixels: Float[Tensor, "*b e p 2"]
    valid: Bool[Tensor, "*b e p"]
    """Whether a cell is in front of the target."""
    z: Float[Tensor, "*b e p"]
    """Depth in the target over depth in the source, at least ``MIN_Z``."""


@dataclass(frozen=True)
class LinearProjection(CellProjection):
    """A projection with its first derivatives."""

    pose_jacobian: Float[Tensor, "e 6 2 p"]
    """d pixel / d xi of the target pose (left perturbation), laid out for the products below."""
    depth_jacobian: Float[Tensor, "e p 2"]
    """d pixel / d inverse depth of the source."""


def relative_motion(
    T_cw: Float[Tensor, "*b n 4 4"], source: Int[Tensor, "e"], target: Int[Tensor, "e"]
) -> Float[Tensor, "*b e 4 4"]:
    """Return T_ji = T_j T_i^-1 of every edge i -> j."""
    return T_cw[..., target, :, :] @ se3_inverse(T_cw[..., source, :, :])


def seen_from_targets(
    rays: Float[Tensor, "*c p 3"],
    T_ji: Float[Tensor, "*b e 4 4"],
    inverse_depth: Float[Tensor, "*b e p"],
) -> tuple[Float[Tensor, "*b e p 3"], Bool[Tensor, "*b e p"], Float[Tensor, "*b e p"]]:
    """Return y = R ray + d t of every cell, whether it is in front of the target, and its z.

    Points with a z below ``MIN_Z`` are flagged, and their z is clamped to it. In memory each
    coordinate of a target's cells is a row: many products of matrices with three columns take ten
    times as long as one with a column per cell.
    """
    R = T_ji[..., :3, :3].to(inverse_depth)
    t = T_ji[..., :3, 3:].to(inverse_depth)
    if rays.dim() == 2:
        turned = (R.reshape(-1, 3) @ rays.mT).reshape(*R.shape[:-1], len(rays))
    else:
        turned = R @ rays.mT
    y = torch.addcmul(turned, t, inverse_depth[..., None, :]).mT
    return y, y[..., 2] > MIN_Z, y[..., 2].clamp(min=MIN_Z)


def motion_rows(
    x: Float[Tensor, "*b p"], y: Float[Tensor, "*b p"], dq: Float[Tensor, "*b p"]
) -> tuple[Float[Tensor, "*b 6 p"], Float[Tensor, "*b 6 p"]]:
    """Return d x / d xi and d y / d xi of points at (x, y, 1) / q, xi a left perturbation of T_ji.

    ``dq`` is the inverse depth over z. Source: DROID-SLAM's reprojection layer.
    """
    o = torch.zeros_like(dq)
    return (
        torch.stack([dq, o, -x * dq, -x * y, 1 + x * x, -y], -2),
        torch.stack([o, dq, -y * dq, -1 - y * y, x * y, x], -2),
    )


def project(
    camera: Camera,
    rays: Float[Tensor, "*c p 3"],
    T_ji: Float[Tensor, "e 4 4"],
    inverse_depth: Float[Tensor, "e p"],
) -> CellProjection:
    """Project the cells of source frames: pixels of y from :func:`seen_from_targets`.

    Cells so far off the axis that the lens folds them over are not valid.
    """
    y, valid, z = seen_from_targets(rays, T_ji, inverse_depth)
    if not camera.is_pinhole:
        plane = y[..., :2] / z[..., None]
        return CellProjection(camera.pixels(plane), valid & camera.shows(plane), z)
    pixels = torch.stack(
        [camera.fx * y[..., 0] / z + camera.cx, camera.fy * y[..., 1] / z + camera.cy], -1
    )
    return CellProjection(pixels, valid, z)


def linearise(
    camera: Camera,
    rays: Float[Tensor, "p 3"],
    T_ji: Float[Tensor, "e 4 4"],
    inverse_depth: Float[Tensor, "e p"],
) -> LinearProjection:
    """Do :func:`project` with the Jacobians in a left perturbation of T_ji and in d."""
    p = project(camera, rays, T_ji, inverse_depth)
    t = T_ji[:, :3, 3].to(inverse_depth)
    q = 1 / p.z
    plane = camera.plane(p.pixels)
    x, y = plane.unbind(-1)
    row_x, row_y = motion_rows(x, y, inverse_depth * q)
    tx, ty, tz = t[:, None].unbind(-1)
    depth_x, depth_y = tx - tz * x, ty - tz * y
    if not camera.is_pinhole:
        xx, xy, yy = camera.bend_jacobian(plane)
        depth_x, depth_y = xx * depth_x + xy * depth_y, xy * depth_x + yy * depth_y
        xx, xy, yy = (each[:, None] for each in (xx, xy, yy))
        row_x, row_y = xx * row_x + xy * row_y, xy * row_x + yy * row_y
    pose = torch.stack([row_x * camera.fx, row_y * camera.fy], -2)
    depth = torch.stack([camera.fx * depth_x * q, camera.fy * depth_y * q], -1)
    return LinearProjection(p.pixels, p.valid, p.z, pose, depth)


def carried_over(
    camera: Camera,
    rays: Float[Tensor, "p 3"],
    T_ji: Float[Tensor, "e 4 4"],
    at: CellProjection,
    step: Float[Tensor, "*b e p 2"],
) -> Float[Tensor, "*b e p 2"]:
    """Propagate small steps of source cells to pixels of the targets, at constant depth.

    To first order; ``at`` is the projection of the cells by T_ji.
    """
    focal = at.pixels.new_tensor([camera.fx, camera.fy])
    plane = camera.plane(at.pixels)
    step = camera.unbent_step(rays[:, :2], step / focal)
    moved = (T_ji[:, :3, :2].to(step) @ step.mT).mT  # as in :func:`seen_from_targets`
    off = moved[..., :2] - plane * moved[..., 2:]
    return focal * camera.bent_step(plane, off) / at.z[..., None]
