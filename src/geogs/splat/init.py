"""Initial disks: in local planes (paper, Sec. "Local-plane driven initialization") or random."""

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.config import DiskConfig
from geogs.geometry.lie import matrix_to_quaternion
from geogs.geometry.neighbors import all_pairs_neighbors, nearest_neighbors
from geogs.gpu.kernels import kernels_for
from geogs.world.disks import DiskParameters

NEIGHBOURS = 12
"""Points of the local plane fit: enough for noise to average, few enough to follow edges."""
MIN_COSINE = 0.15
"""Least cosine of a disk's normal to its own camera: one that is seen edge-on gets no gradient."""
# Scale of coinciding points, map units.
_LEAST_SCALE = 1e-7
# Margin around some points, relative to their extent, in which neighbours are searched first.
_MARGIN = 0.05
_SOURCE = Path(__file__).parent / "cuda" / "local_planes.cu"
_BLOCK = 64


@dataclass(frozen=True)
class LocalPlane:
    """Plane fitted to the neighbourhood of each point."""

    normal: Float[Tensor, "n 3"]
    """Unit, the eigenvector of the smallest eigenvalue, sign arbitrary."""
    tangent: Float[Tensor, "n 3"]
    """Unit, the eigenvector of the largest eigenvalue."""
    planarity: Float[Tensor, "n"]
    """(l1 - l0) / l2 in [0, 1]: near 1 on an evenly sampled plane, 0 on a line or a blob."""
    spacing: Float[Tensor, "n"]
    """Root mean square distance to the three nearest other points, as in 3DGS, map units."""


def fit_local_planes(
    points: Float[Tensor, "n 3"], context: Float[Tensor, "m 3"], k: int
) -> LocalPlane:
    """PCA over the k nearest of ``points`` and ``context``, the point itself included.

    Source: Eq. planarity of the paper; the spacing is 3DGS's rule for initial scales.
    """
    if points.device.type == "cuda":
        return fit_local_planes_on_gpu(points, context, k)
    distances, neighbours = _neighbourhoods(points, context, k)
    centred = neighbours - neighbours.mean(1, keepdim=True)
    eigenvalues, vectors = torch.linalg.eigh(centred.mT @ centred)
    low, middle, high = eigenvalues.clamp(min=0).unbind(-1)
    spacing = distances[:, 1:4].square().mean(1).sqrt()
    planarity = (middle - low) / high.clamp(min=1e-30)
    found = (vectors[..., 0], vectors[..., 2], planarity, spacing)
    return LocalPlane(*(values.to(points.dtype) for values in found))


def _neighbourhoods(
    points: Float[Tensor, "n 3"], context: Float[Tensor, "m 3"], k: int
) -> tuple[Float[Tensor, "n j"], Float[Tensor, "n j 3"]]:
    """Distances and positions of the k + 1 nearest of points and context, float64.

    In a large context only nearby points are searched, if they suffice.
    """
    low, high = points.amin(0), points.amax(0)
    margin = _MARGIN * (high - low).norm()
    near = ((context > low - margin) & (context < high + margin)).all(1)
    union = torch.cat([points, context[near]]).double()
    distances, indices = nearest_neighbors(points.double(), union, k + 1)
    if not bool(near.all()) and (len(union) <= k or float(distances.max()) > float(margin)):
        union = torch.cat([points, context]).double()
        distances, indices = nearest_neighbors(points.double(), union, k + 1)
    return distances, union[indices]


def fit_local_planes_on_gpu(
    points: Float[Tensor, "n 3"], context: Float[Tensor, "m 3"], k: int
) -> LocalPlane:
    """``fit_local_planes`` without waiting for the device, by float32 distances; k <= 31."""
    union = torch.cat([points, context]).detach().float().contiguous()
    neighbours = all_pairs_neighbors(union[: len(points)], union, min(k + 1, len(union)))
    return LocalPlane(*(x.to(points.dtype) for x in principal_planes(union, neighbours)))


def face_camera(
    normal: Float[Tensor, "n 3"], to_camera: Float[Tensor, "n 3"]
) -> Float[Tensor, "n 3"]:
    """Flip normals to the camera; lean those seen edge-on towards it, up to about ``MIN_COSINE``.

    ``to_camera`` is a unit vector.
    """
    cosine = (normal * to_camera).sum(-1, keepdim=True)
    normal = torch.where(cosine < 0, -normal, normal)
    cosine = cosine.abs()
    lean = (MIN_COSINE - cosine).clamp(min=0)
    normal = normal + lean * to_camera
    return normal / normal.norm(dim=-1, keepdim=True)


def initialise_disks(
    points: Float[Tensor, "n 3"],
    camera_centre: Float[Tensor, "*c 3"],
    footprint: Float[Tensor, "n"],
    existing: Float[Tensor, "m 3"],
    config: DiskConfig,
    seen: Float[Tensor, "n 3"] | None = None,
) -> DiskParameters:
    """Disks at ``points`` (world frame), lying in the planes of their neighbourhoods.

    Where ``seen``, unit normals (world frame) that face the camera, is given and not zero, it
    replaces the neighbourhood's, however slanted.
    ``camera_centre`` is the centre of the camera that sees them, or one for each.
    ``footprint`` is the distance between neighbouring samples at each point's depth; the spacing
    is kept within [0.3, 1.5] of it so that a stray point makes neither a speck nor a blanket.
    Without ``bound_spacing`` it is not bounded, as in the paper. Where planarity is under the
    threshold the scale shrinks, as the paper does with a factor 0.1.
    """
    if len(points) == 0:
        empty = points.new_zeros
        return DiskParameters(empty(0, 3), empty(0, 4), empty(0, 2), empty(0))
    plane = fit_local_planes(points, existing, NEIGHBOURS)
    to_camera = camera_centre - points
    to_camera = to_camera / to_camera.norm(dim=-1, keepdim=True)
    normal = face_camera(plane.normal, to_camera)
    if seen is not None:
        normal = torch.where((seen != 0).any(-1, keepdim=True), seen, normal)
    tangent = plane.tangent - (plane.tangent * normal).sum(-1, keepdim=True) * normal
    tangent = tangent / tangent.norm(dim=-1, keepdim=True).clamp(min=1e-12)
    rotation = torch.stack([tangent, torch.linalg.cross(normal, tangent), normal], -1)
    spacing = plane.spacing.clamp(min=_LEAST_SCALE)
    if config.bound_spacing:
        spacing = torch.minimum(torch.maximum(spacing, 0.3 * footprint), 1.5 * footprint)
    shrink = torch.where(plane.planarity < config.planarity_threshold, config.planarity_shrink, 1.0)
    scale = config.scale_factor * spacing * shrink
    logit = torch.logit(points.new_full((len(points),), config.opacity))
    return DiskParameters(
        points, matrix_to_quaternion(rotation), scale.log()[:, None].expand(-1, 2).clone(), logit
    )


def random_disks(
    points: Float[Tensor, "n 3"],
    existing: Float[Tensor, "m 3"],
    opacity: float,
    random: torch.Generator,
) -> DiskParameters:
    """Disks at ``points``, initialised like the Gaussians of 3DGS, with random orientations.

    They are round; their scale is the root mean square distance to the three nearest of ``points``
    and ``existing``, neither shrunk nor bounded.
    """
    count = len(points)
    # A normalised Gaussian sample in four dimensions is uniform on the unit quaternions.
    quaternion = torch.randn(count, 4, generator=random).to(points)
    quaternion = quaternion / quaternion.norm(dim=-1, keepdim=True)
    spacing = fit_local_planes(points, existing, NEIGHBOURS).spacing if count else points[:, 0]
    scale = spacing.clamp(min=_LEAST_SCALE).log()[:, None].expand(-1, 2).clone()
    logit = torch.logit(points.new_full((count,), opacity))
    return DiskParameters(points, quaternion, scale, logit)


def principal_planes(
    points: Float[Tensor, "m 3"], neighbours: Int[Tensor, "n k"]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"], Float[Tensor, "n"], Float[Tensor, "n"]]:
    """Normal, tangent, planarity and spacing of each neighbourhood; see ``LocalPlane``.

    ``neighbours`` are indices (int64) of ``points`` (float32), nearest first, beginning with the
    point itself. Computed in float64: Jacobi's method on the 3 x 3 scatter matrices.
    """
    n, k = neighbours.shape
    normal = points.new_empty(n, 3)
    tangent = points.new_empty(n, 3)
    planarity = points.new_empty(n)
    spacing = points.new_empty(n)
    kernel = kernels_for(_SOURCE, points.device)["local_planes"]
    blocks = (n + _BLOCK - 1) // _BLOCK
    kernel(blocks, _BLOCK, points, neighbours, n, k, normal, tangent, planarity, spacing)
    return normal, tangent, planarity, spacing
