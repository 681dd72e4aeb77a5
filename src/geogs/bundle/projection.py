"""Where the cells of source frames fall in their targets, and how that changes.

A cell with ray X and inverse depth d lies at y = R X + d t in the target, in units of its depth in
the source, for T_ji = (R, t). What follows from y alone is here for every camera: the tracker's,
which is here too, the lens with unknowns (:mod:`geogs.bundle.lens`) and the batch of cameras of the
training. Each of them multiplies the same derivatives of a point by those of its own image, in an
order of its own: one order for all would change the last bits of results.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.geometry.camera import LEAST_SLOPE, Camera
from geogs.geometry.lie import se3_inverse

MIN_Z = 0.05
"""Points nearer than this fraction of the source's unit depth behind the target are ignored."""
INVERSE_DEPTHS = 1e-3, 1e2
"""Least and largest inverse depth that an adjustment gives to a cell, per map unit."""


@dataclass(frozen=True)
class CellProjection:
    """Where the cells of the sources fall in the targets."""

    pixels: Float[Tensor, "*b e p 2"]
    valid: Bool[Tensor, "*b e p"]
    """Whether a cell lies in front of the target."""
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
    """T_ji = T_j T_i^-1 of every edge i -> j."""
    return T_cw[..., target, :, :] @ se3_inverse(T_cw[..., source, :, :])


def seen_from_targets(
    rays: Float[Tensor, "*c p 3"],
    T_ji: Float[Tensor, "*b e 4 4"],
    inverse_depth: Float[Tensor, "*b e p"],
) -> tuple[Float[Tensor, "*b e p 3"], Bool[Tensor, "*b e p"], Float[Tensor, "*b e p"]]:
    """y = R ray + d t of every cell, whether it lies before the target, and its z.

    Points with a z below ``MIN_Z`` are flagged, and their z is set to that. In memory each
    coordinate of a target's cells is a row: many products of matrices with three columns take ten
    times as long as one with as many as there are cells.
    """
    R, t = T_ji[..., :3, :3].to(inverse_depth), T_ji[..., :3, 3:].to(inverse_depth)
    if rays.dim() == 2:
        turned = (R.reshape(-1, 3) @ rays.mT).reshape(*R.shape[:-1], len(rays))
    else:
        turned = R @ rays.mT
    y = torch.addcmul(turned, t, inverse_depth[..., None, :]).mT
    return y, y[..., 2] > MIN_Z, y[..., 2].clamp(min=MIN_Z)


def motion_rows(
    x: Float[Tensor, "*b p"], y: Float[Tensor, "*b p"], dq: Float[Tensor, "*b p"]
) -> tuple[Float[Tensor, "*b 6 p"], Float[Tensor, "*b 6 p"]]:
    """d x / d xi and d y / d xi of points at (x, y, 1) / q, xi a left perturbation of T_ji.

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
    """Project the cells of source frames: where the camera shows y, of :func:`seen_from_targets`.

    What lies so far off the axis that radial terms fold it over is not valid.
    """
    y, valid, z = seen_from_targets(rays, T_ji, inverse_depth)
    if not camera.is_pinhole:
        plane = y[..., :2] / z[..., None]
        is_shown = camera.steepness(plane.square().sum(-1)) > LEAST_SLOPE
        return CellProjection(camera.pixels(plane), valid & is_shown, z)
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
    """:func:`project` with the Jacobians in a left perturbation of T_ji and in d."""
    p = project(camera, rays, T_ji, inverse_depth)
    t, q = T_ji[:, :3, 3].to(inverse_depth), 1 / p.z
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
    """Small steps of the cells of source frames, in pixels of the targets, at constant depth.

    To first order; ``at`` is where the cells fall by T_ji.
    """
    focal, plane = at.pixels.new_tensor([camera.fx, camera.fy]), camera.plane(at.pixels)
    step = step / focal
    if not camera.is_pinhole:
        xx, xy, yy = camera.bend_jacobian(rays[:, :2])
        x, y = step.unbind(-1)
        step = torch.stack([yy * x - xy * y, xx * y - xy * x], -1) / (xx * yy - xy * xy)[:, None]
    moved = (T_ji[:, :3, :2].to(step) @ step.mT).mT  # as :func:`seen_from_targets` does
    off = moved[..., :2] - plane * moved[..., 2:]
    if not camera.is_pinhole:
        xx, xy, yy = camera.bend_jacobian(plane)
        x, y = off.unbind(-1)
        off = torch.stack([xx * x + xy * y, xy * x + yy * y], -1)
    return focal * off / at.z[..., None]
