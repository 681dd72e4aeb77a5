"""Coloured disks in plain PyTorch: every pixel against every disk, for small scenes and tests.

The same image as :mod:`geogs_bench.appearance.rasteriser`, whose thresholds are used.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.geometry.camera import Camera
from geogs.geometry.lie import quaternion_to_matrix
from geogs_bench.appearance.appearance_disks import AppearanceDisks
from geogs_bench.appearance.rasteriser import (
    MIN_ALPHA,
    PIXEL_SHARPNESS,
    MedianDisks,
    Rendering,
    normals_of_depth,
)

MAX_ALPHA = 0.999
MIN_TRANSMITTANCE = 1e-4

# sqrt(1 / 4 pi), sqrt(3 / 4 pi), sqrt(15 / 4 pi), ...: norms of the real basis functions. The
# signs follow the Condon-Shortley phase, which splatting's coefficients include.
_C0 = 0.28209479177387814
_C1 = 0.4886025119029199
_C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
_C3 = (
    0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154,
    1.445305721320277,
)  # fmt: skip


@dataclass(frozen=True)
class _Blend:
    """Weights of the disks in front of the camera, nearest centre first, in each pixel."""

    rows: Tensor
    weight: Float[Tensor, "p n"]
    before: Float[Tensor, "p n"]
    """Light that reaches the disk."""
    screen: Float[Tensor, "n 2"]

    @property
    def alpha(self) -> Float[Tensor, "p"]:
        return self.weight.sum(1)


class ReferenceRasteriser:
    """Slow and obvious; memory grows with pixels times disks."""

    def __init__(self, near: float) -> None:
        self._near = near

    def render(
        self,
        disks: AppearanceDisks,
        camera: Camera,
        T_cw: Float[Tensor, "4 4"],
        sh_degree: int,
        background: Float[Tensor, "3"] | None,
        with_normals: bool,
    ) -> Rendering:
        """See :class:`geogs_bench.appearance.rasteriser.Rasteriser`."""
        blend = self._blend(disks, camera, T_cw)
        shape = (camera.height, camera.width)
        offset = disks.means - _centre(T_cw)
        colours = view_colours(sh_degree, offset, disks.coefficients)[blend.rows]
        colour = blend.weight @ colours
        if background is not None:
            colour = colour + (1 - blend.alpha)[:, None] * background
        normal = depth_normal = None
        if with_normals:
            normal = (blend.weight @ _facing_normals(disks, T_cw)[blend.rows]).reshape(*shape, 3)
            z = (disks.means @ T_cw[2, :3] + T_cw[2, 3])[blend.rows]
            expected = (blend.weight @ z) / blend.alpha.clamp(min=1e-10)
            depth_normal = normals_of_depth(expected.reshape(shape), camera.rays())
        visible = torch.zeros(len(disks), dtype=torch.bool, device=disks.means.device)
        visible[blend.rows] = blend.weight.detach().amax(0) > 0
        alpha = blend.alpha.reshape(shape)
        return Rendering(
            colour.reshape(*shape, 3), alpha, normal, depth_normal, blend.screen, visible
        )

    @torch.no_grad()
    def median_disks(
        self, disks: AppearanceDisks, camera: Camera, T_cw: Float[Tensor, "4 4"]
    ) -> MedianDisks:
        """See :class:`geogs_bench.appearance.rasteriser.Rasteriser`."""
        blend = self._blend(disks, camera, T_cw)
        counts = (blend.before > 0.5) & (blend.weight > 0)
        order = torch.arange(1, len(blend.rows) + 1, device=counts.device)
        last = (counts * order).amax(1)
        index = torch.where(last > 0, blend.rows[(last - 1).clamp(min=0)], -1)
        shape = (camera.height, camera.width)
        return MedianDisks(index.reshape(shape), blend.alpha.reshape(shape))

    def _blend(self, disks: AppearanceDisks, camera: Camera, T_cw: Tensor) -> _Blend:
        centre = disks.means @ T_cw[:3, :3].T + T_cw[:3, 3]
        rows = torch.nonzero(centre[:, 2] > self._near)[:, 0]
        rows = rows[centre[rows, 2].argsort(stable=True)]
        screen = torch.zeros((len(disks), 2), device=centre.device, requires_grad=True)
        power = _exponent(disks, rows, centre, camera, T_cw, screen)
        alpha = (disks.opacities[rows] * torch.exp(-0.5 * power)).clamp(max=MAX_ALPHA)
        alpha = torch.where(alpha >= MIN_ALPHA, alpha, 0.0)
        after = torch.cumprod(1 - alpha, 1)
        before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], 1)
        weight = torch.where(after > MIN_TRANSMITTANCE, alpha * before, 0.0)
        return _Blend(rows, weight, before, screen)


def _exponent(
    disks: AppearanceDisks,
    rows: Tensor,
    centre: Float[Tensor, "n 3"],
    camera: Camera,
    T_cw: Float[Tensor, "4 4"],
    screen: Float[Tensor, "n 2"],
) -> Float[Tensor, "p k"]:
    """Squared distance, in standard deviations, of each pixel's ray from each disk's centre."""
    R = T_cw[:3, :3] @ quaternion_to_matrix(disks.quaternions[rows])
    c, n, scales = centre[rows], R[..., 2], disks.scales[rows]
    rays = camera.rays(centre.dtype, centre.device).reshape(-1, 3)
    facing = rays @ n.T
    z = (n * c).sum(-1) / torch.where(facing == 0, 1e-9, facing)
    hit = z[..., None] * rays[:, None] - c
    u, v = ((hit * R[..., i]).sum(-1) / scales[:, i] for i in (0, 1))
    pixel = rays[:, :2] * rays.new_tensor([camera.fx, camera.fy])
    place = c[:, :2] / c[:, 2:] * rays.new_tensor([camera.fx, camera.fy]) + screen[rows]
    near = PIXEL_SHARPNESS * (pixel[:, None] - place).square().sum(-1)
    return torch.minimum(u * u + v * v, near)


def _facing_normals(disks: AppearanceDisks, T_cw: Tensor) -> Float[Tensor, "n 3"]:
    normals = quaternion_to_matrix(disks.quaternions)[..., 2]
    towards = ((disks.means - _centre(T_cw)) * normals).sum(-1, keepdim=True)
    return torch.where(towards > 0, -normals, normals) @ T_cw[:3, :3].T


def _centre(T_cw: Tensor) -> Float[Tensor, "3"]:
    return -T_cw[:3, :3].T @ T_cw[:3, 3]


def basis(degree: int, directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n k"]:
    """Values of the basis functions in unit directions."""
    x, y, z = directions.unbind(-1)
    values = [torch.full_like(x, _C0)]
    if degree > 0:
        values += [-_C1 * y, _C1 * z, -_C1 * x]
    if degree > 1:
        a, b, c = _C2
        values += [a * x * y, -a * y * z, b * (3 * z * z - 1), -a * x * z, c * (x * x - y * y)]
    if degree > 2:
        a, b, c, d, e = _C3
        values += [
            -a * y * (3 * x * x - y * y),
            b * x * y * z,
            -c * y * (5 * z * z - 1),
            d * z * (5 * z * z - 3),
            -c * x * (5 * z * z - 1),
            e * z * (x * x - y * y),
            -a * x * (x * x - 3 * y * y),
        ]
    return torch.stack(values, -1)


def view_colours(
    degree: int, directions: Float[Tensor, "n 3"], coefficients: Float[Tensor, "n k 3"]
) -> Float[Tensor, "n 3"]:
    """RGB, at least 0, of disks seen along ``directions`` (camera to disk, any length)."""
    unit = torch.nn.functional.normalize(directions, dim=-1)
    used = coefficients[:, : (degree + 1) ** 2]
    return (torch.einsum("nk,nkc->nc", basis(degree, unit), used) + 0.5).clamp(min=0)
