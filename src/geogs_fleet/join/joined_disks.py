"""Disks of a part, moved to the joint world and without those that another part already has."""

from collections.abc import Iterator, Sequence
from dataclasses import fields
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.geometry.lie import quaternion_to_matrix, se3_inverse
from geogs.geometry.neighbors import nearest_neighbors
from geogs.geometry.umeyama import umeyama
from geogs.io.writers.map_file import load_map_file, save_map
from geogs.mapping.map_update import CovisibleKeyframe, blended_similarities
from geogs.threads import on_one_torch_thread
from geogs.types import MapSnapshot
from geogs.world.disks import DiskParameters, GaussianMap
from geogs_fleet.join.part import Part, PartViews, opened
from geogs_fleet.join.part_graph import Placement
from geogs_fleet.join.records import read_record

_COLUMNS = [field.name for field in fields(MapSnapshot)]
_NEAREST = 8
_WITHIN = 2.0
"""Standard deviations of a disk, in its plane, within which it covers another."""
_AWAY = 1.0
"""Multiple of their mean within which it does so along its normal."""
_ALIKE = 0.8
"""Least cosine between the normals of two disks of one surface."""


@on_one_torch_thread
def move_disks(
    part: Part, views_file: Path, placement: Placement, after: Path, device: str = "cpu"
) -> None:
    """Move every disk of a part with the keyframes that see it; write the file ``after``.

    This is the update of a map after a correction, see :mod:`geogs.mapping.map_update`.
    """
    result = opened(part, device)
    views = read_record(PartViews, views_file)
    similarities = placement.similarities(views.T_cw)
    x = result.disks.position.double()
    whole = overall(views, similarities).to(x)

    def covisible() -> Iterator[tuple[CovisibleKeyframe, int]]:
        for n, T_cw in enumerate(torch.from_numpy(views.T_cw)):
            maps = result.renderer.surface(T_cw)
            keyframe = CovisibleKeyframe(n, result.depth_camera, T_cw, maps.depth, maps.weight)
            yield keyframe, n

    S = whole.expand(len(x), 4, 4)
    if len(x) > 1:
        S = blended_similarities(x, S, whole, similarities, covisible())
    save_map(after, transformed(result.disks, S), {})


def overall(views: PartViews, similarities: Float[Tensor, "n 4 4"]) -> Float[Tensor, "4 4"]:
    """The Sim(3) nearest to those of a part's keyframes, at their centres and in their views."""
    T_wc = se3_inverse(torch.from_numpy(views.T_cw))
    depth = torch.from_numpy(views.median_depth)
    corners = depth.new_tensor([[0, 0, 0], [-0.5, -0.4, 1], [0.5, -0.4, 1], [0, 0.6, 1]])
    points = corners * depth[:, None, None]
    points = points @ T_wc[:, :3, :3].mT + T_wc[:, None, :3, 3]
    moved = points @ similarities[:, :3, :3].mT + similarities[:, None, :3, 3]
    scale, R, t = umeyama(points.flatten(0, 1), moved.flatten(0, 1))
    S = torch.eye(4, dtype=torch.float64)
    S[:3, :3] = scale * R
    S[:3, 3] = t
    return S


def transformed(disks: MapSnapshot, S: Float[Tensor, "n 4 4"]) -> MapSnapshot:
    """Transform each disk by its own similarity."""
    if not len(disks):
        return disks
    none = torch.zeros(len(disks), dtype=torch.long, device=disks.position.device)
    moved = GaussianMap.of(DiskParameters.of(disks), none)
    with torch.no_grad():
        moved.transform(S)
    return moved.snapshot()


@on_one_torch_thread
def merge_disks(file: Path, before: Sequence[Path]) -> Bool[Tensor, "n"]:
    """Mask of the disks of a part that no disk of the parts ``before`` covers, by their files."""
    own = load_map_file(file, "cpu").disks
    keep = torch.ones(len(own), dtype=torch.bool)
    for path in before:
        keep &= ~is_covered(own, load_map_file(path, "cpu").disks)
    return keep


def is_covered(disks: MapSnapshot, others: MapSnapshot) -> Bool[Tensor, "n"]:
    """Mask of the disks that lie within the extent of one of ``others`` with a similar normal."""
    covered = torch.zeros(len(disks), dtype=torch.bool)
    if not len(disks) or not len(others):
        return covered
    x = disks.position.double()
    y = others.position.double()
    axes = quaternion_to_matrix(others.quaternion.double())  # tangents and normal, as columns
    own_normal = disks.normal.double()
    _, index = nearest_neighbors(x, y, min(_NEAREST, len(others)))
    for k in range(index.shape[1]):
        at = index[:, k]
        local = ((x - y[at])[:, None] @ axes[at])[:, 0]
        scale = others.scale[at].double()
        inside = (local[:, :2] / scale).norm(dim=1) < _WITHIN
        near = local[:, 2].abs() < _AWAY * scale.mean(1)
        alike = (own_normal * axes[at, :, 2]).sum(1) > _ALIKE
        covered |= inside & near & alike
    return covered


def joined_disks(disks: Sequence[MapSnapshot]) -> MapSnapshot:
    """The disks of all parts in one map."""
    return MapSnapshot(*(torch.cat([getattr(d, c) for d in disks]) for c in _COLUMNS))


def kept(disks: MapSnapshot, keep: Bool[Tensor, "n"]) -> MapSnapshot:
    """The marked disks."""
    return MapSnapshot(*(getattr(disks, c)[keep] for c in _COLUMNS))
