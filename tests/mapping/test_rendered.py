"""The surface that blended disks show: of one at a slant their mean, of two one of them."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from geogs.config import MappingConfig, MeshConfig, preset, reconstruct_preset
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.geometry.jumps import JUMP
from geogs.mapping.rendered import SurfaceMaps, SurfaceRules, rendered_surface
from geogs.world.disks import DiskParameters

CAMERA = Camera(160.0, 160.0, 159.5, 31.5, 320, 160)
RULES = SurfaceRules.of(MappingConfig())
EVERY_RULE = {
    SurfaceRules.of(of_command(name).mapping)
    for of_command in (preset, reconstruct_preset)
    for name in ("default", "fast", "accurate", "paper")
}
ABSURD = {replace(RULES, plane_reach=reach) for reach in (1.0, 2e6, math.inf)}
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


def show(
    map_of: DiskParameters, mask: Tensor | None = None, rules: SurfaceRules = RULES
) -> SurfaceMaps:
    """What the camera sees at the origin."""
    with torch.no_grad():
        return rendered_surface(map_of, CAMERA, torch.eye(4, dtype=torch.float64), rules, mask)


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


def walls_and_hole() -> DiskParameters:
    """The walls of :func:`two_walls`, of which the far one lacks what is right of x = z / 2, and
    with all disks off their wall by 0.2 % of its distance."""
    walls = two_walls()
    there = walls.position[:, 0] < 0.5 * walls.position[:, 2]
    random = torch.Generator().manual_seed(1)
    noise = 1 + 0.002 * torch.randn(len(walls.position), generator=random)
    position = torch.cat([walls.position[:, :2], walls.position[:, 2:] * noise[:, None]], 1)
    return DiskParameters(*(values[there] for values in walls._replace(position=position)))


@pytest.mark.parametrize("rules", sorted(EVERY_RULE | ABSURD, key=repr), ids=repr)
def test_walls_stay_apart_and_holes_stay_holes_by_every_rule(rules):
    assert len(EVERY_RULE) == 3
    maps = show(walls_and_hole(), rules=rules)
    x = torch.arange(CAMERA.width).expand(CAMERA.height, -1)
    hole = x > 240 + 8  # disks reach over the end of their wall
    assert float(maps.depth[hole].abs().max()) == 0
    assert float(maps.weight[hole].abs().max()) == 0
    for wall, side in ((2.0, x < 160 - 8), (4.0, (x > 160 + 8) & (x < 240 - 8))):
        off = maps.depth[side] / wall - 1
        assert float(off.abs().max()) < 0.01
        assert float(off.mean().abs()) < 0.003  # disks in front hide those behind


@pytest.mark.parametrize("rules", sorted(EVERY_RULE | ABSURD, key=repr), ids=repr)
def test_a_floor_stays_a_plane_by_every_rule(rules):
    floor = uneven_road()
    level = torch.full_like(floor.opacity_logit, math.pi / 2)
    maps = show(disks(floor.position, level, 0.02 * floor.position[:, 2], 0.7), rules=rules)
    rays = CAMERA.rays()
    true = HEIGHT / rays[..., 1].clamp(min=1e-3)
    seen = (true > 4) & (true < 8) & ((rays[..., 0] * true).abs() < 2)
    assert float((maps.depth / true - 1)[seen].abs().max()) < 1e-3


def test_no_run_may_average_farther_than_a_jump():
    assert MappingConfig(plane_reach=JUMP).plane_reach == JUMP
    with pytest.raises(InputError, match="plane-reach"):
        MappingConfig(plane_reach=1.01 * JUMP)
