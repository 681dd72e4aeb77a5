"""Local planes: normals, planarity, scale, orientation."""

from dataclasses import replace

import torch

from geogs.config import DiskConfig
from geogs.geometry.lie import quaternion_to_matrix
from geogs.splat.init import face_camera, fit_local_planes, initialise_disks, random_disks

CONFIG = DiskConfig(planarity_shrink=0.1)


def plane(n: int, step: float, noise: float = 0.0) -> torch.Tensor:
    """A square grid on the plane z = 2 - 0.5 x."""
    i, j = torch.meshgrid(torch.arange(n), torch.arange(n), indexing="ij")
    x, y = (i - n / 2) * step, (j - n / 2) * step
    z = 2 - 0.5 * x + noise * torch.randn(n, n, generator=torch.Generator().manual_seed(0))
    return torch.stack([x, y, z], -1).reshape(-1, 3)


def test_normals_of_a_noisy_plane():
    points = plane(30, 0.05, noise=0.002)
    fitted = fit_local_planes(points, points[:0], 12)
    expected = torch.tensor([0.5, 0.0, 1.0]) / 1.25**0.5
    angle = torch.rad2deg(torch.acos((fitted.normal @ expected).abs().clamp(max=1)))
    assert angle.median() < 2.0
    assert angle.quantile(0.95) < 6.0
    assert fitted.planarity.median() > 0.5
    # 3DGS's rule on a grid with spacings 0.05 and 0.05 * sqrt(1.25): the three nearest.
    assert abs(float(fitted.spacing.median()) - 0.052) < 0.003


def test_a_line_and_a_blob_have_no_planarity():
    line = torch.linspace(0, 1, 60)[:, None] * torch.tensor([[1.0, 2.0, 3.0]])
    assert fit_local_planes(line, line[:0], 10).planarity.max() < 1e-6
    blob = torch.randn(4000, 3, generator=torch.Generator().manual_seed(1))
    flat = fit_local_planes(plane(40, 0.05), blob[:0], 40).planarity.median()
    assert fit_local_planes(blob, blob[:0], 40).planarity.median() < 0.5 * flat


def test_existing_disks_complete_the_neighbourhood():
    """Two lonely points get the right normal because the map around them knows the plane."""
    points = plane(20, 0.05)
    new, old = points[[190, 210]], torch.cat([points[:190], points[191:210], points[211:]])
    expected = torch.tensor([0.5, 0, 1.0]) / 1.25**0.5
    astray = torch.tensor([[0.3, 0.1, 1.2], [0.2, -0.2, 3.0]])
    alone = fit_local_planes(new, astray, 12).normal @ expected
    helped = fit_local_planes(new, old, 12).normal @ expected
    assert helped.abs().min() > 0.9999
    assert alone.abs().max() < 0.9


def test_disks_face_the_camera_and_lie_in_the_plane():
    points = plane(24, 0.04)
    disks = initialise_disks(
        points, torch.zeros(3), torch.full((len(points),), 0.04), points[:0], CONFIG
    )
    R = quaternion_to_matrix(disks.quaternion)
    assert ((R[..., 2] * -points).sum(-1) > 0).all()
    inner = (points[:, :2].abs() < 0.35).all(1)
    assert (R[inner][..., 2] @ (torch.tensor([0.5, 0, 1.0]) / 1.25**0.5)).abs().min() > 0.9999
    assert (torch.linalg.det(R) - 1).abs().max() < 1e-5
    assert torch.allclose(disks.log_scale[inner].exp(), torch.tensor(0.6 * 0.0418), rtol=0.03)
    assert torch.allclose(disks.opacity_logit.sigmoid(), torch.tensor(0.7))


def test_scale_is_cut_where_there_is_no_plane():
    line = torch.linspace(1, 2, 50)[:, None] * torch.tensor([[0.1, 0.05, 1.0]])
    footprint = torch.full((50,), 0.02)
    disks = initialise_disks(line, torch.zeros(3), footprint, line[:0], CONFIG)
    loose = replace(CONFIG, planarity_threshold=0.0)
    full = initialise_disks(line, torch.zeros(3), footprint, line[:0], loose)
    assert torch.allclose(full.log_scale - disks.log_scale, torch.tensor(10.0).log(), atol=1e-4)


def test_edge_on_normals_are_leaned_towards_the_camera():
    normal = torch.tensor([[1.0, 0, 0], [-0.6, 0, -0.8]])
    to_camera = torch.tensor([[0.0, 0, -1], [0, 0, -1]])
    leaned = face_camera(normal, to_camera)
    assert (leaned * to_camera).sum(-1).min() > 0.14
    assert torch.allclose(leaned[1], normal[1])


def test_no_points_no_disks():
    none = torch.zeros(0, 3)
    assert len(initialise_disks(none, torch.zeros(3), none[:, 0], none, CONFIG).position) == 0


def started(points: torch.Tensor, **settings):
    footprint, config = torch.full((len(points),), 0.04), DiskConfig(**settings)
    return initialise_disks(points, torch.zeros(3), footprint, points[:0], config)


def turned(points: torch.Tensor, seed: int = 0, opacity: float = 0.7):
    return random_disks(points, points[:0], opacity, torch.Generator().manual_seed(seed))


def test_unbounded_scales_are_3dgs_s_and_far_points_make_blankets():
    points = torch.cat([plane(30, 0.04), torch.tensor([[0.0, 0.0, 40.0]])])
    free = started(points, bound_spacing=False, scale_factor=1.0, planarity_threshold=0.0)
    # The three nearest of a grid with spacings 0.04 and 0.04 * sqrt(1.25): 0.04 twice, 0.0447.
    inner = (points[:-1, :2].abs() < 0.4).all(1)
    expected = torch.tensor((2 * 0.04**2 + 1.25 * 0.04**2) / 3).sqrt()
    assert torch.allclose(free.log_scale[:-1][inner].exp(), expected, rtol=1e-3)
    assert free.log_scale[-1].exp().min() > 35
    bounded = started(points, scale_factor=1.0)
    assert bounded.log_scale[-1].exp().max() < 1.51 * 0.04


def test_random_disks_are_as_large_as_3dgs_makes_them():
    random = torch.Generator().manual_seed(2)
    points, existing = torch.rand(40, 3, generator=random), torch.rand(30, 3, generator=random)
    points[7] = 30.0  # far from all, and as large as that asks for
    nearest = torch.cdist(points, torch.cat([points, existing])).sort(1).values[:, 1:4]
    disks = random_disks(points, existing, 0.7, random)
    expected = nearest.square().mean(1).sqrt().log()[:, None].expand(-1, 2)
    assert torch.allclose(disks.log_scale, expected, atol=1e-4)


def test_random_disks_lie_anyhow():
    points = plane(60, 0.04)
    disks = turned(points, opacity=0.6)
    assert torch.equal(disks.position, points)
    assert torch.allclose(disks.opacity_logit.sigmoid(), torch.tensor(0.6))
    assert torch.allclose(disks.quaternion.norm(dim=1), torch.tensor(1.0))
    normal = quaternion_to_matrix(disks.quaternion)[..., 2]
    assert normal.mean(0).norm() < 0.05
    # Each coordinate of a uniform direction is uniform in [-1, 1].
    assert torch.allclose(normal.square().mean(0), torch.tensor(1 / 3), atol=0.03)


def test_random_disks_follow_their_seed():
    points = plane(12, 0.04)
    first, same, other = (turned(points, seed) for seed in (1, 1, 2))
    assert torch.equal(first.quaternion, same.quaternion)
    assert not torch.allclose(first.quaternion, other.quaternion)
    assert len(turned(points[:0]).position) == 0


def test_normals_that_were_seen_stand_however_slanted_and_zero_asks_the_points():
    points = plane(24, 0.04)
    footprint = torch.full((len(points),), 0.04)
    seen = torch.zeros_like(points)
    edge_on = torch.linalg.cross(points[0], torch.tensor([0.0, 1.0, 0.0]))
    seen[0] = torch.nn.functional.normalize(edge_on, dim=0)  # 90 degrees from the ray
    alone = initialise_disks(points, torch.zeros(3), footprint, points[:0], CONFIG)
    given = initialise_disks(points, torch.zeros(3), footprint, points[:0], CONFIG, seen)
    R = quaternion_to_matrix(given.quaternion)
    assert torch.allclose(R[0, :, 2], seen[0], atol=1e-5)
    assert (torch.linalg.det(R) - 1).abs().max() < 1e-5
    assert torch.equal(given.quaternion[1:], alone.quaternion[1:])
    assert torch.equal(given.log_scale, alone.log_scale)
