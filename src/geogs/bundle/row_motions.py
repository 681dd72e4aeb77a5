"""A rolling shutter in an adjustment: motion of the camera while it reads each frame.

Each row of a frame is seen from another position. To first order in the readout r, a point that a
pinhole with the pose of the middle row would show at p is seen at p + r t v: t is the time of its
row, in readouts from the middle one, and v the velocity of the point in the image, which follows
from the twist of the camera and the depth. Twists are fitted to the image motion from the frame to
its neighbours in the video (:func:`fitted_twists`), so that the readout is one unknown, in which
the residuals are linear.
Source: differential rolling-shutter geometry (Zhuang, Cheong, Lee 2017), in the adjustment.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.bundle.projection import carried_over, linearise
from geogs.geometry.camera import Camera
from geogs.geometry.robust import geman_mcclure_weight

ROUNDS = 8
"""Reweighted steps of the fit of a twist."""
OFF = 0.15
"""Scale of the robust weights as a fraction of the mean image motion; at least one pixel / s."""


@dataclass(frozen=True)
class RowTimes:
    """Times of pixels, in readouts from the middle of the image: linear in either axis."""

    per_column: float
    per_row: float
    first: float
    """Time of the pixel (0, 0)."""

    def of(self, pixels: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b"]:
        """Return the times of pixels."""
        return self.per_column * pixels[..., 0] + self.per_row * pixels[..., 1] + self.first


@dataclass(frozen=True)
class RowMotions:
    """Twists of frames while their rows are read."""

    twist: Float[Tensor, "n 6"]
    """Twist per second: a left perturbation of each frame's pose."""
    times: RowTimes

    def slopes(
        self,
        camera: Camera,
        rays: Float[Tensor, "p 3"],
        T_ji: Float[Tensor, "e 4 4"],
        inverse_depth: Float[Tensor, "n p"],
        source: Int[Tensor, "e"],
        target: Int[Tensor, "e"],
    ) -> Float[Tensor, "e p 2"]:
        """Return derivatives of the source cells' positions in targets by the readout in seconds.

        The shift by the target's row, less that by the source's row, propagated at the cell's
        depth.
        """
        at = linearise(camera, rays, T_ji, inverse_depth[source])
        there = torch.einsum("ek,ekcp->epc", self.twist[target], at.pose_jacobian)
        there = there * self.times.of(at.pixels)[..., None]
        here = torch.einsum("nk,nkcp->npc", self.twist, _motions(camera, rays, inverse_depth))
        here = here * self.times.of(camera.pixels(rays[:, :2]))[:, None]
        return there - carried_over(camera, rays, T_ji, at, here[source])


def fitted_twists(
    camera: Camera,
    rays: Float[Tensor, "p 3"],
    inverse_depth: Float[Tensor, "n p"],
    velocity: Float[Tensor, "n p 2"],
    known: Bool[Tensor, "n p"],
) -> Float[Tensor, "n 6"]:
    """Fit twists of cameras, per second, to the velocities of each frame's cells.

    By iteratively reweighted least squares. Zero where nothing is known.

    Args:
        camera: of the frames.
        rays: of the cells.
        inverse_depth: of the cells of each frame.
        velocity: of the cells, pixels per second.
        known: whether velocity and depth of each cell are known.
    """
    J = _motions(camera, rays, inverse_depth).double().flatten(2)
    v = velocity.double().mT.flatten(1)
    weight = known.double()
    speed = (velocity.norm(dim=-1) * known).sum(1) / known.sum(1).clamp(min=1)
    limit = (OFF * speed).clamp(min=1.0).double()[:, None]
    eye = torch.eye(6, dtype=torch.float64)
    for _ in range(ROUNDS):
        wJ = J * weight.repeat(1, 2)[:, None]
        H = wJ @ J.mT
        damping = 1e-6 * H.diagonal(dim1=1, dim2=2).amax(1)[:, None, None] + 1e-9
        twist = torch.linalg.solve(H + damping * eye, wJ @ v[..., None])[..., 0]
        off = (v - (twist[:, None] @ J)[:, 0]).unflatten(1, (2, -1)).norm(dim=1) / limit
        weight = known * geman_mcclure_weight(off.square())
    return twist.to(velocity)


def _motions(
    camera: Camera, rays: Float[Tensor, "p 3"], inverse_depth: Float[Tensor, "n p"]
) -> Float[Tensor, "n 6 2 p"]:
    """Return derivatives of the cells' pixels by the twist of their camera."""
    still = torch.eye(4, dtype=torch.float64).expand(len(inverse_depth), 4, 4)
    return linearise(camera, rays, still, inverse_depth).pose_jacobian
