"""The surface that blended disks show: of one at a slant their mean, of two one of them."""

import math

import torch
from torch import Tensor

from geogs.config import MeshConfig
from geogs.geometry.camera import Camera
from geogs.mapping.rendered import SurfaceMaps, SurfaceRules, rendered_surface
from geogs.world.disks import DiskParameters

CAMERA = Camera(160.0, 160.0, 159.5, 31.5, 320, 160)
RULES = SurfaceRules(min_alpha=0.5, max_spread=0.01)
HEIGHT = 1.2


def disks(position: Tensor, lean: Tensor, scale: Tensor, opacity: float) -> DiskParameters:
    """Round disks that face the camera where they lean by nothing, radians about its x axis."""
    zero = torch.zeros_like(lean)
    return DiskParameters(
        position.float(),
        torch.stack([(lean / 2).cos(), (lean / 2).sin(), zero, zero], 1),
        scale.log()[:, None].expand(-1, 2).contiguous(),
        torch.full_like(scale, opacity).logit(),
    )


def uneven_road() -> DiskParameters:
    """Disks on the ground ahead that lean by two degrees, as large as the camera asks for."""
    rows, z = [], 3.0
    while z < 30:
        x = torch.arange(-4, 4, 0.02 * z)
        rows.append(torch.stack([x, torch.full_like(x, HEIGHT), torch.full_like(x, z)], 1))
        z *= 1.018
    position = torch.cat(rows)
    random = torch.Generator().manual_seed(0)
    lean = math.radians(2) * torch.randn(len(position), generator=random) + math.pi / 2
    return disks(position, lean, 0.03 * position[:, 2], 0.7)


def show(map_of: DiskParameters, mask: Tensor | None = None) -> SurfaceMaps:
    """What the camera sees at the origin."""
    with torch.no_grad():
        return rendered_surface(map_of, CAMERA, torch.eye(4, dtype=torch.float64), RULES, mask)


def test_an_uneven_road_is_one_surface_far_ahead():
    maps, rays = show(uneven_road()), CAMERA.rays()
    true = HEIGHT / rays[..., 1].clamp(min=1e-3)
    # Where a ray meets the road at 5 to 11 degrees. Along the ray: 0.83, 0.0073, 0.956.
    road = (true > 6) & (true < 15) & ((rays[..., 0] * true).abs() < 2)
    off = (maps.depth / true - 1)[road]
    assert int(road.sum()) > 1000
    assert float((maps.weight[road] == 1).float().mean()) > 0.97
    assert float(off.std()) < 0.006
    assert float((off.abs() < 0.02).float().mean()) > 0.97


def two_walls() -> DiskParameters:
    """One to the left 2 ahead, and one that fills the image 4 ahead."""
    y, x = torch.meshgrid(torch.arange(-2, 2, 0.03), torch.arange(-4, 4, 0.03), indexing="ij")
    x, y = x.flatten(), y.flatten()
    near = torch.stack([x, y, torch.full_like(x, 2.0)], 1)[x < 0]
    far = torch.stack([2 * x, 2 * y, torch.full_like(x, 4.0)], 1)
    position = torch.cat([near, far])
    return disks(position, torch.zeros(len(position)), 0.015 * position[:, 2], 0.9)


def test_no_depth_lies_between_two_walls():
    maps = show(two_walls())
    between = (maps.depth > 2.06) & (maps.depth < 3.88)
    assert float(between.float().mean()) < 0.0005
    assert float((maps.depth < 2.06).float().mean()) > 0.4
    assert float((maps.depth > 3.88).float().mean()) > 0.4


def test_one_view_makes_a_surface_but_for_its_ends():
    x = torch.arange(CAMERA.width).expand(CAMERA.height, -1)
    maps, least = show(two_walls(), x < 250), MeshConfig().min_weight
    step = int(((maps.depth > 0) & (maps.depth < 3))[CAMERA.height // 2].sum())
    assert 155 < step < 165
    ends = ((x - step + 0.5).abs() < 2) | ((x < 250) & (x >= 248))
    assert float((maps.weight[ends] >= least).float().mean()) < 0.01
    assert float((4 * maps.weight[ends] >= least).float().mean()) > 0.99
    inside = ((x - step + 0.5).abs() > 4) & (x < 247)
    assert float((maps.weight[inside] >= least).float().mean()) > 0.99
    assert float(maps.weight[x >= 250].abs().max()) == 0
