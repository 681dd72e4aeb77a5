"""The baseline with colour: everything but the CUDA operators."""

import itertools
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from geogs.config import MeshConfig
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.geometry.lie import quaternion_to_matrix
from geogs.mesh.extract import extract_mesh
from geogs_bench.appearance import appearance_trainer as trainer_module
from geogs_bench.appearance.appearance_config import AppearanceConfig
from geogs_bench.appearance.appearance_disks import (
    AppearanceDisks,
    DiskOptimizer,
    GradientStatistics,
    constant_from_colour,
    disks_at_points,
    refine,
    split_disks,
)
from geogs_bench.appearance.appearance_trainer import (
    AppearanceTrainer,
    RefinementClock,
    Schedule,
    normal_loss,
    photometric_loss,
    ssim,
)
from geogs_bench.appearance.rasteriser import (
    GsplatRasteriser,
    MedianDisks,
    crossing_depth,
    depth_views,
    normals_of_depth,
    shifted_matrix,
)
from geogs_bench.appearance.training_views import TrainingView, scene_scale
from geogs_photos.start_points import find_start_points, in_visual_hull
from oracles.appearance_reference import ReferenceRasteriser, basis, view_colours

pytestmark = pytest.mark.system

CAMERA = Camera(40.0, 42.0, 15.3, 11.2, 32, 24)
CONFIG = AppearanceConfig()
HASTY = replace(
    CONFIG, initial_opacity=0.6, sh_constant_rate=0.05, scales_rate=0.02, refine_iterations=10,
    grow_gradient=2e-3, grow_scale=0.2, prune_scale=10.0,
)  # fmt: skip
"""For a hundred iterations instead of thousands."""


def make_disks(n: int, seed: int = 0, size: float = 0.15) -> AppearanceDisks:
    """Random disks in front of a camera at the origin."""
    random = torch.Generator().manual_seed(seed)
    means = torch.rand((n, 3), generator=random) * torch.tensor([2.0, 1.5, 2.0])
    means += torch.tensor([-1.0, -0.75, 2.0])
    disks = disks_at_points(means, torch.rand((n, 3), generator=random), CONFIG, random)
    rest = 0.2 * torch.randn(disks.sh_rest.shape, generator=random)
    quaternions = torch.randn((n, 4), generator=random)
    scales = torch.log(size * (0.5 + torch.rand((n, 2), generator=random)))
    logits = torch.randn(n, generator=random)
    return replace(
        disks, sh_rest=rest, quaternions=quaternions, log_scales=scales, opacity_logits=logits
    )


def look_at(place: tuple[float, float, float], target: tuple[float, float, float]) -> np.ndarray:
    """World to camera, y of the world down."""
    forward = np.subtract(target, place) / np.linalg.norm(np.subtract(target, place))
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    T[:3, 3] = -T[:3, :3] @ np.asarray(place)
    return T


def plane_views(camera: Camera, count: int, radius: float = 0.8) -> list[TrainingView]:
    """A textured plane z = 3 of the world, from cameras on an arc."""
    random = np.random.default_rng(0)
    noise = sum(
        cv2.resize(random.random((k, k, 3)), (512, 512), interpolation=cv2.INTER_CUBIC)
        for k in (8, 32, 96)
    )
    noise = (noise - noise.min()) / np.ptp(noise)
    texture = (255 * noise).astype(np.uint8)
    # Texture pixel (a, b) lies at world (a / 128 - 2, b / 128 - 2, 3).
    world = np.array([[1 / 128, 0, -2], [0, 1 / 128, -2], [0, 0, 3], [0, 0, 1]])
    views = []
    for angle in np.linspace(-0.5, 0.5, count):
        place = (radius * np.sin(2 * angle), 0.3 * np.cos(5 * angle), 0.1 * angle)
        T = look_at(place, (0.0, 0.0, 3.0))
        H = camera.matrix().numpy() @ T[:3] @ world
        image = cv2.warpPerspective(texture, H, (camera.width, camera.height))
        views.append(TrainingView(image, None, camera, T))
    return views


def test_spherical_harmonics_are_orthonormal() -> None:
    nodes, weights = np.polynomial.legendre.leggauss(12)
    angles = np.arange(24) * 2 * np.pi / 24
    z, angle = np.meshgrid(nodes, angles, indexing="ij")
    r = np.sqrt(1 - z**2)
    directions = np.stack([r * np.cos(angle), r * np.sin(angle), z], -1).reshape(-1, 3)
    w = torch.from_numpy(np.repeat(weights, 24) * 2 * np.pi / 24)
    values = basis(3, torch.from_numpy(directions))
    torch.testing.assert_close(values.T @ (w[:, None] * values), torch.eye(16).double())


def test_spherical_harmonics_follow_splatting_in_sign_and_order() -> None:
    x, y, z = (basis(1, torch.eye(3)[i : i + 1])[0] for i in range(3))
    c0, c1 = 0.2820948, 0.4886025
    torch.testing.assert_close(x, torch.tensor([c0, 0, 0, -c1]))
    torch.testing.assert_close(y, torch.tensor([c0, -c1, 0, 0]))
    torch.testing.assert_close(z, torch.tensor([c0, 0, c1, 0]))
    diagonal = basis(2, torch.tensor([[0.6, 0.8, 0.0]]))[0, 4:]
    expected = [1.0925484 * 0.48, 0, -0.3153916, 0, 0.5462742 * (0.36 - 0.64)]
    torch.testing.assert_close(diagonal, torch.tensor(expected))


def test_constant_coefficient_shows_its_colour_from_everywhere() -> None:
    colour = torch.tensor([[0.1, 0.5, 0.9]])
    coefficients = torch.zeros(1, 16, 3)
    coefficients[:, 0] = constant_from_colour(colour)
    for direction in torch.randn(5, 1, 3):
        torch.testing.assert_close(view_colours(3, direction, coefficients), colour)


def test_ssim_is_that_of_scikit_image() -> None:
    random = np.random.default_rng(1)
    one = cv2.GaussianBlur(random.random((40, 52, 3)), (0, 0), 2)
    other = (one + 0.05 * random.standard_normal(one.shape)).clip(0, 1)
    expected, full = structural_similarity(
        one, other, channel_axis=2, data_range=1.0, gaussian_weights=True, sigma=1.5,
        use_sample_covariance=False, full=True,
    )  # fmt: skip
    got = float(ssim(torch.from_numpy(one), torch.from_numpy(other)))
    assert got == pytest.approx(full[5:-5, 5:-5].mean(), abs=1e-9)
    assert got == pytest.approx(expected, abs=1e-9)
    assert 0.1 < got < 0.99


def test_ssim_has_the_derivative_of_its_value() -> None:
    random = torch.Generator().manual_seed(0)
    one, other = torch.rand((2, 13, 14, 3), generator=random, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda image: ssim(image, other), (one.requires_grad_(),))


def test_ssim_of_flat_bright_images_is_exact_enough_for_its_constants() -> None:
    random = torch.Generator().manual_seed(0)
    one = 0.9 + 0.01 * torch.rand((40, 50, 3), generator=random)
    other = (one + 0.003 * torch.randn(one.shape, generator=random)).requires_grad_()
    exact = other.detach().double().requires_grad_()
    for image in (other, exact):
        ssim(image, one.to(image.dtype)).backward()
    torch.testing.assert_close(other.grad.double(), exact.grad, rtol=0.02, atol=1e-6)


def test_photometric_loss_weighs_l1_and_ssim() -> None:
    one, other = torch.rand(20, 20, 3), torch.rand(20, 20, 3)
    loss = photometric_loss(one, other, 0.2)
    expected = 0.8 * (one - other).abs().mean() + 0.2 * (1 - ssim(one, other))
    assert float(loss) == pytest.approx(float(expected), abs=1e-6)
    assert float(photometric_loss(one, one, 0.2)) == pytest.approx(0, abs=1e-5)


def test_normal_loss_is_zero_for_equal_normals_and_weighs_by_alpha() -> None:
    normal = torch.zeros(4, 5, 3)
    normal[..., 2] = -1
    assert float(normal_loss(normal, normal, torch.ones(4, 5))) == pytest.approx(0)
    assert float(normal_loss(normal, normal, torch.full((4, 5), 0.25))) == pytest.approx(0.75)


def test_schedule_stretches_over_the_budget() -> None:
    schedule = Schedule(CONFIG, 60.0)
    assert schedule.step(30.0) == 15_000
    assert [schedule.sh_degree(s) for s in (0.0, 999.0, 1e3, 2500.0, 3e3, 29_999.0)] == [
        0,
        0,
        1,
        2,
        3,
        3,
    ]
    assert schedule.means_rate(0.0, 2.0) == pytest.approx(3.2e-4)
    assert schedule.means_rate(15e3, 2.0) == pytest.approx(3.2e-5)
    assert schedule.means_rate(40e3, 2.0) == pytest.approx(3.2e-6)
    assert not schedule.uses_normals(7000.0)
    assert schedule.uses_normals(7001.0)


def test_refinement_waits_for_steps_and_for_iterations() -> None:
    slow = RefinementClock(CONFIG)  # one iteration a step: every 100 steps from 600 to 14 900
    due = [step for step in range(0, 20_000) if slow.is_due(float(step), step)]
    assert due[:2] == [600, 700]
    assert due[-1] == 14_900
    assert len(due) == 144
    fast = RefinementClock(CONFIG)  # ten steps an iteration: every 25 iterations
    due = [i for i in range(3000) if fast.is_due(10.0 * i, i)]
    assert due[:3] == [60, 85, 110]
    assert due[-1] < 1500


def test_start_disks_are_as_large_as_their_neighbours_are_far() -> None:
    grid = torch.stack(torch.meshgrid(*[torch.arange(4.0)] * 3, indexing="ij"), -1).reshape(-1, 3)
    disks = disks_at_points(0.5 * grid, torch.rand(64, 3), CONFIG, torch.Generator())
    torch.testing.assert_close(disks.scales, torch.full((64, 2), 0.5))
    torch.testing.assert_close(disks.opacities, torch.full((64,), 0.1))
    assert disks.bytes == 64 * 61 * 4
    assert sum(t[0].numel() for t in disks.tensors()) == 58  # and three unused of the file's normal


def test_gradients_are_means_over_the_views_that_saw_a_disk() -> None:
    statistics = GradientStatistics(3, torch.device("cpu"))
    gradient = torch.tensor([[1.0, 0.0], [0.0, 1.0], [5.0, 5.0]])
    statistics.add(gradient, torch.tensor([True, True, False]), 100, 60)
    statistics.add(2 * gradient, torch.tensor([True, False, False]), 100, 60)
    torch.testing.assert_close(statistics.mean(), torch.tensor([75.0, 30.0, 0.0]))


def test_refinement_doubles_splits_and_removes() -> None:
    disks = make_disks(6)
    sizes = torch.tensor([0.005, 0.005, 0.05, 0.05, 0.5, 0.05]).log()
    clear = torch.tensor([0.5, 0.5, 0.5, 0.01, 0.5, 0.5]).logit()
    disks = replace(disks, log_scales=sizes[:, None].repeat(1, 2), opacity_logits=clear)
    gradient = torch.tensor([1e-3, 1e-5, 1e-3, 1e-5, 1e-5, 1e-5])
    kept, added = refine(disks, gradient, 2000.0, 1.0, CONFIG, torch.Generator())
    assert kept.tolist() == [0, 1, 4, 5]  # 2 is split, 3 too clear
    assert len(added) == 3  # 0 is doubled
    torch.testing.assert_close(added.means[0], disks.means[0])
    torch.testing.assert_close(added.scales[1:], torch.full((2, 2), 0.05 / 1.6))
    kept, added = refine(disks, gradient, 4000.0, 1.0, CONFIG, torch.Generator())
    assert kept.tolist() == [0, 1, 5]  # 4 is too large by now
    assert len(added) == 3


def test_halves_of_a_disk_lie_in_its_plane() -> None:
    disks = make_disks(200, size=0.3)
    halves = split_disks(disks, 1.6, torch.Generator().manual_seed(3))
    R = quaternion_to_matrix(disks.quaternions)
    offset = halves.means.reshape(2, 200, 3) - disks.means
    local = torch.einsum("nij,hni->hnj", R, offset)
    assert float(local[..., 2].abs().max()) < 1e-5
    spread = (local[..., :2] / disks.scales).std()
    assert float(spread) == pytest.approx(1.0, abs=0.1)


def test_moments_follow_their_disks() -> None:
    optimizer = DiskOptimizer(make_disks(5), CONFIG, 1e-3)
    sum((t * t).sum() for t in optimizer.disks.tensors()).backward()
    optimizer.step(1e-3)
    before = [optimizer._adam.state[t]["exp_avg"].clone() for t in optimizer.disks.tensors()]
    optimizer.change(torch.tensor([4, 1]), make_disks(3, seed=9))
    for old, tensor in zip(before, optimizer.disks.tensors(), strict=True):
        state = optimizer._adam.state[tensor]
        assert len(tensor) == 5
        torch.testing.assert_close(state["exp_avg"][:2], old[[4, 1]])
        assert not state["exp_avg"][2:].any()
        assert float(state["step"]) == 1
    assert len(optimizer._adam.state) == 6
    sum((t * t).sum() for t in optimizer.disks.tensors()).backward()
    optimizer.step(1e-3)


def test_intrinsics_move_by_half_a_pixel() -> None:
    K = shifted_matrix(CAMERA, torch.device("cpu"))
    assert K[0, 2] == pytest.approx(15.8)
    assert K[1, 2] == pytest.approx(11.7)
    assert K[0, 0] == pytest.approx(40.0)


def test_crossing_depth_is_that_of_ray_and_plane() -> None:
    disks = make_disks(40, size=0.4)
    T_cw = torch.from_numpy(look_at((0.2, -0.1, 0.3), (0.1, 0.0, 3.0))).float()
    median = ReferenceRasteriser(0.01).median_disks(disks, CAMERA, T_cw)
    depth = crossing_depth(disks, median, CAMERA, T_cw, 0.5)
    T, R = T_cw.double().numpy(), quaternion_to_matrix(disks.quaternions).double().numpy()
    crossings = 0
    for v, u in itertools.product(range(CAMERA.height), range(CAMERA.width)):
        row = int(median.index[v, u])
        if row < 0 or median.alpha[v, u] < 0.5:
            assert depth[v, u] == 0
            continue
        ray = np.array([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, 1.0])
        c = T[:3, :3] @ disks.means[row].double().numpy() + T[:3, 3]
        axes = T[:3, :3] @ R[row]
        z = (axes[:, 2] @ c) / (axes[:, 2] @ ray)
        facing = abs(axes[:, 2] @ ray) / np.linalg.norm(ray)
        # As far as a disk of no size is seen: 255 exp(-r^2) = 1.
        reach = 3 * float(disks.scales[row].max()) + np.sqrt(np.log(255)) * c[2] / CAMERA.fx
        is_sane = facing > 0.1 and np.linalg.norm(z * ray - c) < reach and z > 0
        assert float(depth[v, u]) == pytest.approx(z if is_sane else c[2], rel=1e-4)
        crossings += is_sane
    assert crossings > 100


@pytest.mark.parametrize("size", [0.6, 1.0, 2.0])
def test_crossing_of_small_disks_is_nearer_the_surface_than_their_centres(size: float) -> None:
    random = torch.Generator().manual_seed(0)
    camera = Camera(40.0, 40.0, 15.5, 11.5, 32, 24)
    pixel = 3.0 / 40.0
    count = int(2 * np.pi * (0.8 / (size * pixel)) ** 2)
    z = -(torch.arange(count) + 0.5) / count
    angle = 2.39996 * torch.arange(count)
    radius = (1 - z * z).sqrt()
    outside = torch.stack([radius * angle.cos(), radius * angle.sin(), z], 1)
    # Disks as long as a pixel is wide, more or less, on a ball, turned by some 10 degrees.
    inside = -outside + 0.15 * torch.randn((count, 3), generator=random)
    inside = torch.nn.functional.normalize(inside, dim=1)
    turned = torch.stack([1 + inside[:, 2], -inside[:, 1], inside[:, 0], 0 * z], 1)
    disks = replace(
        disks_at_points(0.8 * outside, torch.rand((count, 3)), CONFIG, random),
        means=0.8 * outside + torch.tensor([0.0, 0.0, 3.0]),
        quaternions=turned,
        log_scales=torch.full((count, 2), np.log(size * pixel)),
        opacity_logits=torch.full((count,), 1.5),
    )
    median = ReferenceRasteriser(0.01).median_disks(disks, camera, torch.eye(4))
    got = crossing_depth(disks, median, camera, torch.eye(4), 0.5)
    rays = camera.rays()
    along, squared = 3.0 * rays[..., 2], rays.square().sum(-1)
    root = along.square() - squared * (9.0 - 0.64)
    truth = (along - root.clamp(min=0).sqrt()) / squared
    is_ball = (root > 0) & (got > 0)
    assert int(is_ball.sum()) > 250
    error = (got - truth)[is_ball].abs() / pixel
    by_centre = (disks.means[median.index, 2] - truth)[is_ball].abs() / pixel
    assert float(error.median()) < 0.7 * float(by_centre.median())
    assert float(error.square().mean()) < 0.6 * float(by_centre.square().mean())


def test_disk_seen_from_the_side_has_its_centres_depth() -> None:
    disks = make_disks(1)
    quarter = torch.tensor([[2**-0.5, 0.0, 2**-0.5, 0.0]])  # its normal points to the right
    disks = replace(disks, means=torch.tensor([[0.0, 0.0, 2.0]]), quaternions=quarter)
    rays = MedianDisks(torch.zeros(24, 32, dtype=torch.int64), torch.ones(24, 32))
    depth = crossing_depth(disks, rays, CAMERA, torch.eye(4), 0.5)
    assert float(depth[11, 15]) == pytest.approx(2.0)
    assert depth.isfinite().all()


def test_median_disk_is_the_last_before_half_the_light_is_gone() -> None:
    disks = make_disks(3, size=50.0)
    disks = replace(
        disks,
        means=torch.tensor([[0.0, 0.0, 4.0], [0.0, 0.0, 2.0], [0.0, 0.0, 3.0]]),
        quaternions=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(3, 1),
        opacity_logits=torch.tensor([0.9, 0.4, 0.4]).logit(),
    )
    median = ReferenceRasteriser(0.01).median_disks(disks, CAMERA, torch.eye(4))
    assert (median.index == 2).all()  # 0.6 of the light reaches it, 0.36 passes
    assert float(median.alpha[5, 5]) == pytest.approx(1 - 0.6 * 0.6 * 0.1, abs=2e-3)


def test_normals_of_the_depth_of_a_slanted_plane() -> None:
    normal = torch.tensor([0.3, -0.2, -1.0]).double()
    normal /= normal.norm()
    rays = CAMERA.rays(torch.float64)
    depth = (normal @ torch.tensor([0.0, 0.0, 3.0]).double()) / (rays @ normal)
    got = normals_of_depth(depth, rays)
    torch.testing.assert_close(got[3, 4], normal)
    assert not got[0].any()


def test_scene_scale_is_the_radius_of_the_cameras() -> None:
    image = np.zeros((24, 32, 3), np.uint8)
    views = [
        TrainingView(image, None, CAMERA, look_at((x, 0.0, 0.0), (x, 0.0, 1.0))) for x in (0, 4)
    ]
    assert scene_scale(views, 1.1) == pytest.approx(2.2)


def test_start_points_lie_on_the_textured_plane() -> None:
    camera = Camera(260.0, 260.0, 159.5, 119.5, 320, 240)
    views = plane_views(camera, 5)
    points = find_start_points(views)
    assert len(points) > 150
    distance = np.abs(points.positions[:, 2] - 3)
    assert np.median(distance) < 0.005
    assert np.quantile(distance, 0.95) < 0.03
    mask = np.zeros((240, 320), dtype=bool)
    mask[:, :160] = True
    masked = [replace(views[0], mask=mask), *views[1:]]
    inside = in_visual_hull(masked, points.positions)
    local = points.positions @ views[0].T_cw[:3, :3].T + views[0].T_cw[:3, 3]
    column = 260 * local[:, 0] / local[:, 2] + 159.5
    shown = (column > 0) & (column < 319)
    assert inside[shown & (column < 159)].all()
    assert not inside[shown & (column > 160)].any()


def test_start_points_need_texture() -> None:
    flat = [replace(v, image=np.full_like(v.image, 90)) for v in plane_views(CAMERA, 3)]
    with pytest.raises(InputError, match="too little texture"):
        find_start_points(flat)


def test_without_gsplat_one_sentence_says_how_to_get_it(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(InputError, match="pip install gsplat"):
        GsplatRasteriser(0.01)


class Clock:
    """Seconds that pass only when they are asked for."""

    def __init__(self, tick: float) -> None:
        self.now, self.tick = 0.0, tick

    def perf_counter(self) -> float:
        """The time, a tick later each call."""
        self.now += self.tick
        return self.now


def plane_trainer(config: AppearanceConfig) -> tuple[AppearanceTrainer, list[TrainingView]]:
    """A trainer of the textured plane whose start points lie a little off it."""
    views = plane_views(CAMERA, 4)
    random = np.random.default_rng(2)
    points = random.uniform((-1.3, -1.1, 2.9), (1.3, 1.1, 3.1), (160, 3))
    colours = np.full((160, 3), 128, np.uint8)
    rasteriser = ReferenceRasteriser(0.01)
    return AppearanceTrainer(views, points, colours, rasteriser, config, device="cpu"), views


def test_training_improves_the_picture_within_its_budget(monkeypatch) -> None:
    clock = Clock(0.1)
    monkeypatch.setattr(trainer_module, "time", clock)
    trainer, views = plane_trainer(HASTY)
    before, calls, values = trainer.psnr(), [], []

    def on_time(seconds: float, disks: AppearanceDisks) -> None:
        clock.now += 1000.0  # the clock of training stands still
        calls.append((seconds, disks))
        values.append(trainer.psnr())

    result = trainer.train(10.0, [2.0, 5.0, 99.0], on_time)
    assert 95 <= result.iterations <= 100
    assert result.seconds < 11
    assert [round(seconds) for seconds, _ in calls] == [2, 5, 10]
    assert not torch.equal(calls[0][1].means[:9], result.disks.means[:9])
    assert result.psnr > before + 4
    assert all(later > earlier for earlier, later in itertools.pairwise([before, *values]))
    assert len(result.disks) != 160
    maps = depth_views(result.disks, views, ReferenceRasteriser(0.01), CONFIG)
    depth = maps[0].depth[maps[0].depth > 0]
    assert float((maps[0].depth > 0).float().mean()) > 0.7
    rays = CAMERA.rays()[maps[0].depth > 0]
    T = torch.from_numpy(views[0].T_cw).float()
    world = (rays * depth[:, None] - T[:3, 3]) @ T[:3, :3]
    assert float((world[:, 2] - 3).abs().median()) < 0.1
    mesh = extract_mesh(maps, MeshConfig(voxel=0.1, min_component_faces=1))
    assert len(mesh.faces) > 50


def test_mask_leaves_the_outside_to_a_random_background(monkeypatch) -> None:
    monkeypatch.setattr(trainer_module, "time", Clock(0.1))
    views = plane_views(CAMERA, 3)
    mask = np.zeros((24, 32), dtype=bool)
    mask[6:18, 8:24] = True
    views = [replace(view, mask=mask) for view in views]
    random = np.random.default_rng(2)
    points = random.uniform((-0.8, -0.6, 2.9), (0.8, 0.6, 3.1), (100, 3))
    rasteriser = ReferenceRasteriser(0.01)
    trainer = AppearanceTrainer(
        views, points, np.full((100, 3), 128, np.uint8), rasteriser, HASTY, device="cpu"
    )
    disks = trainer.train(8.0).disks
    T = torch.from_numpy(views[1].T_cw).float()
    alpha = rasteriser.median_disks(disks, CAMERA, T).alpha
    inside = torch.from_numpy(mask)
    assert float(alpha[inside].mean()) > 0.8
    assert float(alpha[~inside].mean()) < 0.5 * float(alpha[inside].mean())
    for view in depth_views(disks, views, rasteriser, CONFIG):
        assert not view.depth[~inside].any()


def test_too_few_points_are_refused() -> None:
    views = plane_views(CAMERA, 2)
    with pytest.raises(InputError, match="only 3"):
        AppearanceTrainer(
            views, np.zeros((3, 3)), np.zeros((3, 3), np.uint8), ReferenceRasteriser(0.01), CONFIG,
            device="cpu",
        )  # fmt: skip
