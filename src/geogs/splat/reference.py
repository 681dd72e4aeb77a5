"""The renderer's specification: every pixel against every disk, in PyTorch, by autograd.

2-D Gaussian splatting (Huang et al. 2024) for disks without colour. Slow and obvious; the other
backends are tested against it.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from geogs.geometry.camera import Camera
from geogs.geometry.lie import quaternion_to_matrix
from geogs.world.disks import DiskParameters

MIN_ALPHA = 1 / 255
"""Least opacity at a pixel for a disk to be blended."""
MAX_ALPHA = 0.99
MIN_TRANSMITTANCE = 1e-4
"""Blending stops before the disk that would leave less light than this."""
MIN_FACING = 1e-4
"""Lower bound of |cos| between a disk's normal and the line to its centre."""
MAX_HIT_RATIO = 1e4
"""Largest depth of a hit that counts, as a multiple of the centre's depth."""
MAX_LOG_SCALE = 40.0
"""Larger or smaller disks are ignored."""
MAX_REACH_RATIO = 1e3
"""Upper bound of a disk's depth extent, as a multiple of its centre's depth."""

# Elements of one (pixels, disks) array; above it the image is rendered piece by piece and each
# piece is computed again in the backward pass.
_CHUNK_ELEMENTS = 4_000_000


class ProjectedDisks(NamedTuple):
    """Disks in front of the camera, nearest centre first.

    Camera frame; every field has one row per disk.
    """

    rows: Tensor
    """Indices among all disks."""
    center: Tensor
    tangents: tuple[Tensor, Tensor]
    normal: Tensor
    """Unit length, facing the camera."""
    facing: Tensor
    """n . c, kept away from zero."""
    scale: Tensor
    opacity: Tensor
    reach: tuple[Tensor, Tensor]
    """Extent of the disk in front of and behind its centre, along z; constants."""


class PixelValues(NamedTuple):
    """The maps of :class:`geogs.splat.render.RenderOutput` for some pixels."""

    depth: Tensor
    normal: Tensor
    alpha: Tensor
    distortion: Tensor
    median_depth: Tensor
    visible: Tensor
    """Whether any of these pixels blends a projected disk, one for each."""


def render_reference(
    disks: DiskParameters, camera: Camera, T_cw: Float[Tensor, "4 4"], near: float
) -> tuple[Tensor, ...]:
    """Depth, normal, alpha, distortion, median depth and visibility; see ``render``.

    Computed in the dtype and on the device of the positions.
    """
    projected = project_disks(disks, T_cw.to(disks.position), near)
    h, w = camera.height, camera.width
    y, x = torch.meshgrid(
        torch.arange(h).to(disks.position), torch.arange(w).to(disks.position), indexing="ij"
    )
    pixels = torch.stack([x.flatten(), y.flatten()], -1)
    step = max(1, _CHUNK_ELEMENTS // max(1, len(projected.rows)))
    if step >= len(pixels):
        *maps, shown = blend(projected, pixels, camera, near)
    else:
        pieces = [
            checkpoint(blend, projected, p, camera, near, use_reentrant=False)
            for p in pixels.split(step)
        ]
        *parts, seen = zip(*pieces, strict=True)
        maps = [torch.cat(part) for part in parts]
        shown = torch.stack(seen).any(0)
    visible = torch.zeros(len(disks.position), dtype=torch.bool, device=x.device)
    visible[projected.rows] = shown
    return (*(values.view(h, w, *values.shape[1:]) for values in maps), visible)


def project_disks(disks: DiskParameters, T_cw: Float[Tensor, "4 4"], near: float) -> ProjectedDisks:
    """Move disks to the camera frame, without those that no pixel can blend, sorted by depth.

    Left out are disks whose centre is not beyond ``near``, whose opacity is below ``MIN_ALPHA``,
    whose quaternion is zero, whose log-scale exceeds ``MAX_LOG_SCALE`` or that hold a number that
    is not finite.
    """
    R = T_cw[:3, :3]
    t = T_cw[:3, 3]
    with torch.no_grad():
        finite = torch.cat([disks.position, disks.quaternion, disks.log_scale], 1).isfinite()
        ok = finite.all(1) & disks.opacity_logit.isfinite() & (disks.quaternion != 0).any(1)
        ok &= (disks.log_scale.abs() < MAX_LOG_SCALE).all(1)
        center_z = (disks.position @ R.mT + t)[:, 2]
        ok &= (center_z > near) & (disks.opacity_logit.sigmoid() >= MIN_ALPHA)
        order = torch.argsort(torch.where(ok, center_z, torch.inf), stable=True)
        index = order[: int(ok.sum())]
    center = disks.position[index] @ R.mT + t
    tangent_u, tangent_v, normal = (R @ quaternion_to_matrix(disks.quaternion[index])).unbind(-1)
    facing = (normal * center).sum(-1)
    away = facing > 0
    least = MIN_FACING * center.detach().norm(dim=-1)
    bound = torch.where(facing < 0, -least, least)
    scale = disks.log_scale[index].exp()
    with torch.no_grad():
        z = center[:, 2]
        reach = 3 * (scale * torch.stack([tangent_u[:, 2], tangent_v[:, 2]], -1)).norm(dim=-1)
        in_front = torch.minimum(reach, z - near)
        behind = torch.minimum(reach, MAX_REACH_RATIO * z)
    return ProjectedDisks(
        rows=index,
        center=center,
        tangents=(tangent_u, tangent_v),
        normal=torch.where(away[:, None], -normal, normal),
        facing=torch.where(facing.abs() < least, bound, facing) * torch.where(away, -1.0, 1.0),
        scale=scale,
        opacity=disks.opacity_logit[index].sigmoid(),
        reach=(in_front, behind),
    )


def intersect(
    disks: ProjectedDisks, pixels: Float[Tensor, "p 2"], camera: Camera, near: float
) -> tuple[Float[Tensor, "p n"], Float[Tensor, "p n"]]:
    """Squared distance rho from the disk's centre in standard deviations, and depth of the hit.

    rho is the smaller of rho3, on the disk's plane, and rho2, in the image with a deviation of
    1/sqrt(2) pixels about the projected centre (the low-pass filter). The plane's inverse depth at
    a pixel offset delta (at unit depth) from the projected centre c / c_z is
    w = 1/c_z + n . delta / (n . c), and the hit lies (delta - c (n . delta) / (n . c)) / w from the
    centre. In the low-pass branch the depth is kept within the disk's own extent.
    """
    c = disks.center
    z_c = disks.center[:, 2]
    focal = torch.stack([c.new_tensor(camera.fx), c.new_tensor(camera.fy)])
    principal = torch.stack([c.new_tensor(camera.cx), c.new_tensor(camera.cy)])
    offset = pixels[:, None] - (focal * c[:, :2] / z_c[:, None] + principal)
    delta = offset / focal
    slope = (delta * disks.normal[:, :2]).sum(-1) / disks.facing
    w = 1 / z_c + slope
    hits = (w > 1 / (MAX_HIT_RATIO * z_c)) & (w < 1 / near)
    z = 1 / torch.where(hits, w, 1 / z_c)
    rho3 = torch.zeros_like(w)
    for tangent, scale in zip(disks.tangents, disks.scale.unbind(-1), strict=True):
        along = (delta * tangent[:, :2]).sum(-1) - slope * (tangent * c).sum(-1)
        rho3 = rho3 + (z * along / scale) ** 2
    rho2 = 2 * (offset**2).sum(-1)
    on_plane = hits & (rho3 <= rho2)
    nearest = z_c - disks.reach[0]
    furthest = z_c + disks.reach[1]
    kept = torch.where(w < 1 / furthest, furthest, torch.where(w > 1 / nearest, nearest, z))
    return torch.where(on_plane, rho3, rho2), torch.where(on_plane, z, kept)


def blend(
    disks: ProjectedDisks, pixels: Float[Tensor, "p 2"], camera: Camera, near: float
) -> PixelValues:
    """Composite the disks front to back at each pixel (x, y)."""
    rho, z = intersect(disks, pixels, camera, near)
    alpha = (disks.opacity * torch.exp(-rho / 2)).clamp(max=MAX_ALPHA)
    alpha = torch.where(alpha >= MIN_ALPHA, alpha, torch.zeros_like(alpha))
    after = torch.cumprod(1 - alpha, 1)
    before = torch.cat([torch.ones_like(after[:, :1]), after], 1)[:, : after.shape[1]]
    weight = torch.where(after >= MIN_TRANSMITTANCE, alpha * before, torch.zeros_like(alpha))
    total = weight.sum(1)
    depth = (weight * z).sum(1) / torch.where(total > 0, total, torch.ones_like(total))
    normal = weight @ disks.normal
    median = _median(weight.detach(), before, z.detach())
    visible = (weight > 0).any(0)
    return PixelValues(depth, normal, total, distortion(weight, z), median, visible)


def distortion(weight: Float[Tensor, "p n"], z: Float[Tensor, "p n"]) -> Float[Tensor, "p"]:
    """Spread of the hits along each ray: 2 sum_i w_i |z_i A_i - Z_i|.

    A_i and Z_i are the sums of w_j and w_j z_j over j < i. Equal to the paper's
    sum_ij w_i w_j |z_i - z_j| where the hits are sorted along the ray; where disks cross, so that
    the order of centres is not the order of hits, it is smaller but never negative.
    """
    weighted = weight * z
    before = torch.cumsum(weight, 1) - weight
    before_z = torch.cumsum(weighted, 1) - weighted
    return 2 * (weight * (z * before - before_z).abs()).sum(1)


def _median(weight: Tensor, before: Tensor, z: Tensor) -> Tensor:
    """Depth of the last disk that is blended while more than half of the light is left."""
    n = weight.shape[1]
    if n == 0:
        return weight.sum(1)
    rank = torch.arange(1, n + 1, device=weight.device)
    last = torch.where((weight > 0) & (before > 0.5), rank, torch.zeros_like(rank)).amax(1)
    found = torch.gather(z, 1, (last - 1).clamp(min=0)[:, None])[:, 0]
    return torch.where(last > 0, found, torch.zeros_like(found))
