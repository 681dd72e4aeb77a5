"""A similarity for every disk, smooth over each surface: the blended map update.

A correction gives each keyframe a similarity by which its surface moves. A disk moves with all
keyframes on whose depth it lies: they trained it, not only the one that made it. Where a drifting
loop has doubled a surface, each layer lies on the depths of its own visit and moves with these.
Then the similarities are smoothed between neighbours, but not across layers that have to part.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.geometry.camera import Camera
from geogs.geometry.lie import sim3_exp, sim3_inverse, sim3_log
from geogs.geometry.neighbors import nearest_neighbors
from geogs.gpu.transfer import to_device

_AGREEMENT = 0.03
"""Relative standard deviation of disks around the depth of a keyframe whose surface they are on."""
_OWN = 0.1
"""Weight of the keyframe that made a disk; another's is at most one."""
_BORDER = 8.0
"""Pixels over which a keyframe's weight fades towards the border of its image."""
_NEIGHBOURS = 32
_ROUNDS = 4
_SPREAD = 1.5
"""Width of the smoothing, in units of the median distance to the neighbours."""
_PARTING = 0.2
"""Difference of the displacements of neighbours of different layers, in that width."""


@dataclass(frozen=True, eq=False)
class CovisibleKeyframe:
    """Depth of a keyframe before the correction, on the device of the map."""

    keyframe_id: int
    camera: Camera
    """Camera of the depth map."""
    T_cw: Float[Tensor, "4 4"]
    """World to camera, before the correction."""
    depth: Float[Tensor, "h w"]
    """z in map units, before the correction."""
    confidence: Float[Tensor, "h w"]
    """Confidence of the depth, in [0, 1]."""


def blended_similarities(
    x: Float[Tensor, "n 3"],
    own: Float[Tensor, "n 4 4"],
    reference: Float[Tensor, "4 4"],
    similarities: Float[Tensor, "k 4 4"],
    covisible: Iterable[tuple[CovisibleKeyframe, int]],
) -> Float[Tensor, "n 4 4"]:
    """World similarities of disks at ``x``, float64.

    ``own`` is the correction of the keyframe that made each disk. Every covisible keyframe comes
    with the index of its correction in ``similarities``. Blends are means in the Lie algebra of
    Sim(3) of the corrections relative to ``reference``, which should be near all of them; they do
    not depend on the origin of the world.
    """
    back = sim3_inverse(reference)
    total = _OWN * sim3_log(own @ back)
    weight = torch.full_like(x[:, 0], _OWN)
    corrections = to_device(sim3_log(similarities.cpu() @ back.cpu()), x.device)
    for keyframe, k in covisible:
        confidence = agreement(x, keyframe)
        total += confidence[:, None] * corrections[k]
        weight += confidence
    moved = x @ reference[:3, :3].T + reference[:3, 3]
    return sim3_exp(smoothed(x, moved, total / weight[:, None])) @ reference


def agreement(x: Float[Tensor, "n 3"], keyframe: CovisibleKeyframe) -> Float[Tensor, "n"]:
    """The keyframe's confidence, in [0, 1], that there is a surface at each point."""
    camera = keyframe.camera
    T = keyframe.T_cw.to(x)
    y = x @ T[:3, :3].T + T[:3, 3]
    z = y[:, 2].clamp(min=1e-9)
    u, v = camera.fx * y[:, 0] / z + camera.cx, camera.fy * y[:, 1] / z + camera.cy
    inwards = torch.stack([u, camera.width - 1 - u, v, camera.height - 1 - v]).amin(0)
    seen = (y[:, 2] > 0) & (inwards > 0)
    column = torch.where(seen, u, 0.0).round().long()
    row = torch.where(seen, v, 0.0).round().long()
    deviation = (z / keyframe.depth[row, column].to(x) - 1) / _AGREEMENT
    confidence = (inwards / _BORDER).clamp(max=1.0) * keyframe.confidence[row, column].to(x)
    return torch.where(seen, confidence * torch.exp(-0.5 * deviation.square()), 0.0)


def smoothed(
    x: Float[Tensor, "n 3"], moved: Float[Tensor, "n 3"], tangent: Float[Tensor, "n 7"]
) -> Float[Tensor, "n 7"]:
    """Smooth tangents at points ``x``: each is a mean over near points that move alike.

    A bilateral filter: its weights fall with the distance, and with the distance between where both
    tangents take the point ``moved`` (to first order), so layers that have to part do.
    """
    distance, index = nearest_neighbors(x, x, _NEIGHBOURS)
    width = _SPREAD * distance[:, distance.shape[1] // 2].clamp(min=1e-12)
    near = torch.exp(-0.5 * (distance / width[:, None]).square())
    for _ in range(_ROUNDS):
        total, weight = torch.zeros_like(tangent), torch.zeros_like(width)
        for k in range(index.shape[1]):
            other = tangent[index[:, k]]
            way = _displacement(other - tangent, moved).norm(dim=1) / (_PARTING * width)
            w = near[:, k] * torch.exp(-0.5 * way.square())
            total += w[:, None] * other
            weight += w
        tangent = total / weight[:, None]
    return tangent


def _displacement(xi: Float[Tensor, "n 7"], x: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Displacement of points by small tangents, to first order."""
    return xi[:, :3] + torch.linalg.cross(xi[:, 3:6], x) + xi[:, 6:] * x
