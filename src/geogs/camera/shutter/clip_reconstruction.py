"""Poses of a few images and the points that they see, and how the one follows from the other."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from geogs.camera.shutter.angular_motion import rotated

_NEAREST = 1e-3
"""Depth, in the unit of the points, below which a point is taken to be there."""


@dataclass(frozen=True)
class ClipReconstruction:
    """A rigid scene and the way of the camera through it, up to scale."""

    R: Float[np.ndarray, "k 3 3"]
    """A point ``(x, y, 1)/d`` of the middle image is at ``(R (x, y, 1) + d t)/d`` in another."""
    t: Float[np.ndarray, "k 3"]
    points: Float[np.ndarray, "n 3"]
    """x/z, y/z and the inverse depth d in the middle image."""

    @property
    def is_finite(self) -> bool:
        """Whether it has not diverged."""
        parts = (self.R, self.t, self.points)
        return all(bool(np.isfinite(part).all()) for part in parts)

    def in_cameras(self) -> Float[np.ndarray, "k n 3"]:
        """Points times their inverse depth in the middle image, in axes of each camera."""
        return self._turned() + self.points[:, 2:] * self.t[:, None]

    def projected(self) -> Float[np.ndarray, "k n 2"]:
        """x/z and y/z of all points in all images."""
        at = self.in_cameras()
        return at[..., :2] / _depth(at)

    def derivatives(
        self,
    ) -> tuple[Float[np.ndarray, "k n 2 6"], Float[np.ndarray, "k n 2 3"]]:
        """Derivatives of :meth:`projected` by the steps of an image's own pose and of a point."""
        turned, inverse = self._turned(), self.points[:, 2]
        at = turned + inverse[:, None] * self.t[:, None]
        depth = _depth(at)[..., 0]
        once, across, down = 1 / depth, -at[..., 0] / depth**2, -at[..., 1] / depth**2
        by_camera = np.zeros((*depth.shape, 2, 3))  # by points in axes of the camera
        by_camera[..., 0, 0] = by_camera[..., 1, 1] = once
        by_camera[..., 0, 2], by_camera[..., 1, 2] = across, down
        by_pose = np.empty((*depth.shape, 2, 6))
        # Of row g of the above, g . (phi x turned) = phi . (turned x g).
        x, y, z = turned[..., 0], turned[..., 1], turned[..., 2]
        by_pose[..., 0, 0], by_pose[..., 1, 0] = y * across, y * down - z * once
        by_pose[..., 0, 1], by_pose[..., 1, 1] = z * once - x * across, -x * down
        by_pose[..., 0, 2], by_pose[..., 1, 2] = -y * once, x * once
        np.multiply(by_camera, inverse[:, None, None], out=by_pose[..., 3:])
        by_point = np.concatenate([self.R[..., :2], self.t[..., None]], axis=-1)
        lines = by_camera.reshape(len(by_point), -1, 3) @ by_point
        return by_pose, lines.reshape(by_camera.shape)

    def stepped(
        self, poses: Float[np.ndarray, "k 6"], points: Float[np.ndarray, "n 3"]
    ) -> "ClipReconstruction":
        """The reconstruction after rotations on the left and moves of poses, and of points.

        The median inverse depth is one again afterwards.
        """
        columns = np.swapaxes(self.R, 1, 2)
        turned = rotated(columns.reshape(-1, 3), np.repeat(poses[:, :3], 3, axis=0))
        R = np.swapaxes(turned.reshape(columns.shape), 1, 2)
        t, moved = self.t + poses[:, 3:], self.points + points
        scale = max(float(np.median(np.abs(moved[:, 2]))), 1e-9)
        return ClipReconstruction(R, t * scale, moved / [1, 1, scale])

    def _turned(self) -> Float[np.ndarray, "k n 3"]:
        rays = np.concatenate([self.points[:, :2], np.ones((len(self.points), 1))], axis=1)
        turned: Float[np.ndarray, "k n 3"] = rays @ np.swapaxes(self.R, 1, 2)
        return turned


def _depth(at: Float[np.ndarray, "k n 3"]) -> Float[np.ndarray, "k n 1"]:
    return np.maximum(at[..., 2:], _NEAREST)
