"""Scene axes and viewing geometry from the camera poses."""

import numpy as np
from jaxtyping import Float


def level_axes(
    T_wc: Float[np.ndarray, "n 4 4"], up: Float[np.ndarray, "3"] | None = None
) -> Float[np.ndarray, "3 3"]:
    """Rows right, forward, up of the world, estimated from the camera poses.

    Up, where it is not given, is opposite to the mean of the image's down axis (cameras are mostly
    held upright); right is the direction of most motion perpendicular to it.
    """
    up = -T_wc[:, :3, 1].mean(0) if up is None else up
    norm = np.linalg.norm(up)
    up = up / norm if norm > 1e-3 else np.array([0.0, 0.0, 1.0])
    offset = T_wc[:, :3, 3] - T_wc[:, :3, 3].mean(0)
    flat = offset - np.outer(offset @ up, up)
    right = np.linalg.svd(flat, full_matrices=False)[2][0]
    right = right - (right @ up) * up
    if np.linalg.norm(right) < 1e-6:
        right = np.cross(np.roll(np.eye(3)[np.abs(up).argmax()], 1), up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(up, right), up])


def look_at_one_place(T_wc: Float[np.ndarray, "k 4 4"]) -> bool:
    """Whether the optical axes of all cameras pass near one point in front of them.

    The point nearest to all axes must be in front of every camera and, on average, at most a
    tenth of its distance off the axis; and the cameras must be apart by at least a tenth of it.
    """
    axes = T_wc[:, :3, 2]
    centres = T_wc[:, :3, 3]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    offset = (across @ centres[..., None])[..., 0].sum(0)
    focus = np.linalg.lstsq(across.sum(0), offset, rcond=None)[0]
    along = ((focus - centres) * axes).sum(1)
    if not (along > 0).all():
        return False
    beside = np.linalg.norm(focus - centres - along[:, None] * axes, axis=1)
    spread = np.linalg.norm(centres - centres.mean(0), axis=1).max()
    return bool(beside.mean() < 0.1 * along.mean() and spread > 0.1 * along.mean())
