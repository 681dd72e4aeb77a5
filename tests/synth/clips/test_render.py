"""Random rooms for training: exact geometry, fair statistics, the same again from the same seed."""

import math
from dataclasses import replace

import pytest
import torch

from geogs_synth.camera.camera_batch import pixel_grid, rays
from geogs_synth.camera.clip_camera import compress, develop, draw_flaws
from geogs_synth.clips.clip_batch import ClipBatch
from geogs_synth.clips.room_options import RoomOptions
from geogs_synth.clips.sampler import RoomSampler
from geogs_synth.draw import Draw
from geogs_synth.raycast.cpu_caster import CpuCaster
from geogs_synth.raycast.solid_distance import signed_distance, wall_distance
from geogs_synth.scene.solids import BOX, ELLIPSOID, FRUSTUM
from random_rooms import looking_along_y, nothing, room_of, small_bank, solids_of, use_fast_rooms

OPTIONS = RoomOptions(width=64, height=48, textures=8, texture_size=32, candidates=12)


@pytest.fixture(scope="module")
def sampler() -> RoomSampler:
    """Renders with the emulated kernel, many times as fast as the reference."""
    with pytest.MonkeyPatch.context() as patch:
        use_fast_rooms(patch)
        yield RoomSampler(OPTIONS, "cpu")


@pytest.fixture(scope="module")
def clips(sampler) -> ClipBatch:
    return sampler.sample(0, 24)


def depth_of(*rows) -> torch.Tensor:
    """Depth that a camera at (2, 1, 1.5) has of some solids; 25 x 33 pixels."""
    solids = solids_of(*rows) if rows else nothing()
    views = looking_along_y([2.0, 1.0, 1.5])
    return CpuCaster().render(room_of(solids, 1), small_bank(), views).depth[0, 0]


def test_depth_of_the_walls():
    depth = depth_of()
    assert depth[12, 16] == pytest.approx(4.0, abs=1e-12)
    # The left wall is two metres away: a ray with tangent 16/30 meets it after 3.75 m.
    assert depth[12, 0] == pytest.approx(3.75, abs=1e-12)


def test_depth_of_a_box_a_sphere_a_cylinder_and_a_cone():
    assert depth_of((BOX, [2, 3, 1.5], [0.5, 0.25, 0.5], None))[12, 16] == pytest.approx(1.75)
    assert depth_of((ELLIPSOID, [2, 3, 1.5], [0.5] * 3, None))[12, 16] == pytest.approx(1.5)
    cylinder = depth_of((FRUSTUM, [2, 3, 1.5], [0.5, 0.5, 1.0], None))
    assert cylinder[12, 16] == pytest.approx(1.5)
    s = 2 / 30  # beside the axis: (s t)^2 + (t - 2)^2 = 0.25
    t = (2 - math.sqrt(4 - (1 + s * s) * 3.75)) / (1 + s * s)
    assert cylinder[12, 18] == pytest.approx(t)
    cone = depth_of((FRUSTUM, [2, 3, 1.5], [0.6, 0.2, 1.0], None))
    assert cone[12, 16] == pytest.approx(1.6)


def test_depth_of_a_turned_box():
    # Standing on an edge, its diagonal towards the camera.
    c = math.sqrt(0.5)
    R = torch.tensor([[c, -c, 0], [c, c, 0], [0, 0, 1.0]])
    depth = depth_of((BOX, [2, 3, 1.5], [0.4, 0.4, 0.4], R))
    assert depth[12, 16] == pytest.approx(2 - 0.4 * math.sqrt(2), abs=1e-6)


def test_a_box_hides_what_is_behind_it():
    solids = solids_of((BOX, [2, 3, 1.5], [0.2, 0.2, 0.2], None))
    views = looking_along_y([2.0, 1.0, 1.5], [2.6, 1.0, 1.5])
    depth = CpuCaster().render(room_of(solids), small_bank(), views).depth
    origin, direction = rays(views, 0, *pixel_grid(views))
    points = (origin + depth[:, 0].flatten(1)[..., None] * direction).unflatten(1, depth.shape[2:])
    truth = CpuCaster().flow(solids, views, points, 1)
    # Each point of the far wall moves by 30 * 0.6 / 4 pixels.
    assert truth.pixels[0, 5, 16, 0] == pytest.approx(16 - 4.5)
    assert truth.visible[0, 5, 16]
    assert not truth.visible[0, 5, 2]  # moved out of the image
    assert not truth.visible[0, 12, 12]  # wall beside the box, behind it for the second camera
    assert truth.visible[0, 12, 22]
    assert truth.visible[0, 12, 16]  # the box itself
    assert truth.valid.all()


def test_light_is_finite_and_shadows_are_dark():
    solids = solids_of((BOX, [2, 2.5, 1.5], [0.8, 0.8, 0.05], None))
    views = looking_along_y([2.0, 0.4, 0.8])
    colour = CpuCaster().render(room_of(solids, 1), small_bank(), views).colour
    assert colour.isfinite().all()
    assert (colour > 0).all()
    open_ = CpuCaster().render(room_of(nothing(), 1), small_bank(), views).colour
    below = colour[0, 0, :, 18:24, 10:22].mean() / open_[0, 0, :, 18:24, 10:22].mean()
    assert below < 0.8


def test_flow_is_the_reprojection_of_depth(clips):
    truth = clips.flow(0, 1)
    v, u = 20, 33
    fx, fy, cx, cy = clips.views.intrinsics.double().T
    z = clips.depth[:, 0, v, u].double()
    p = torch.stack([(u - cx) / fx * z, (v - cy) / fy * z, z, torch.ones_like(z)], -1)
    T = clips.views.T_cw.double()
    q = torch.einsum("bij,bj->bi", T[:, 1] @ torch.linalg.inv(T[:, 0]), p)
    expected = torch.stack([fx * q[:, 0] / q[:, 2] + cx, fy * q[:, 1] / q[:, 2] + cy], -1)
    front = truth.valid[:, v, u]
    torch.testing.assert_close(
        truth.pixels[:, v, u][front].double(), expected[front], rtol=1e-4, atol=2e-3
    )


def test_flow_there_and_back(clips):
    """Where a visible point lands, the second view's depth leads back to it."""
    truth = clips.flow(0, 1)
    back = clips.flow(1, 0)
    scale = torch.tensor([2 / 63, 2 / 47])
    grid = torch.nn.functional.grid_sample(
        back.pixels.movedim(-1, 1), truth.pixels * scale - 1, align_corners=True
    ).movedim(1, -1)
    y, x = torch.meshgrid(torch.arange(48.0), torch.arange(64.0), indexing="ij")
    error = (grid - torch.stack([x, y], -1)).norm(dim=-1)[truth.visible & truth.valid]
    assert error.median() < 0.02
    assert error.quantile(0.85) < 1.0  # interpolation fails at edges


def test_same_numbers_give_the_same_clips(sampler):
    first, again = sampler.sample(3, 2), sampler.sample(3, 2)
    assert (first.images == again.images).all()
    assert (first.views.T_cw == again.views.T_cw).all()
    for other in (sampler.sample(4, 2), sampler.sample(3, 2, rank=1)):
        assert (first.views.T_cw != other.views.T_cw).any()


def test_validation_has_other_rooms_and_textures(sampler):
    options = replace(OPTIONS, validation=True)
    other = RoomSampler(options, "cpu")
    assert (other.bank.texels != sampler.bank.texels).float().mean() > 0.5
    assert (other.sample(3, 2).views.T_cw != sampler.sample(3, 2).views.T_cw).any()


def test_statistics_of_the_clips(clips):
    truth = clips.flow(0, 1)
    fraction = truth.visible.float().mean((1, 2))
    assert fraction.mean() > 0.5
    assert fraction.median() < 0.97
    y, x = torch.meshgrid(torch.arange(48.0), torch.arange(64.0), indexing="ij")
    motion = (truth.pixels - torch.stack([x, y], -1)).norm(dim=-1)[truth.visible] * 512 / 64
    assert motion.quantile(0.1) < 25
    assert motion.quantile(0.95) > 60
    assert clips.images.min() >= 0
    assert clips.images.max() <= 1
    assert 0.2 < clips.images.mean() < 0.7
    assert clips.depth.isfinite().all()
    assert clips.depth.min() > 0.05


def test_much_of_the_area_has_next_to_no_texture(sampler):
    options = replace(OPTIONS, disturbance=0.0)
    images = 255 * RoomSampler(options, "cpu").sample(2, 12).images
    across = (images[..., 1:, 1:] - images[..., 1:, :-1]).abs().amax(2)
    down = (images[..., 1:, 1:] - images[..., :-1, 1:]).abs().amax(2)
    plain = (torch.maximum(across, down) < 3).float().mean()
    assert 0.2 < plain < 0.7


def test_cameras_are_in_free_space(clips):
    free = signed_distance(clips.solids, clips.views.centre).amin(-1)
    assert free.min() > 0.1


def test_paths_of_many_views(sampler):
    options = replace(OPTIONS, views=5)
    five = RoomSampler(options, "cpu").sample(1, 4)
    assert five.images.shape == (4, 5, 3, 48, 64)
    for k in range(4):
        assert five.flow(k, k + 1).visible.float().mean() > 0.5


def test_draws_follow_their_shares():
    draw = Draw.keyed(torch.device("cpu"), 1)
    counts = torch.bincount(draw.choose((1.0, 2.0, 1.0), 4000)) / 4000
    torch.testing.assert_close(counts, torch.tensor([0.25, 0.5, 0.25]), rtol=0, atol=0.04)
    R = draw.rotation(10)
    torch.testing.assert_close(R @ R.transpose(-1, -2), torch.eye(3).expand(10, 3, 3))


def test_compression_keeps_what_it_does_not_round():
    image = torch.rand(2, 3, 20, 27, generator=torch.Generator().manual_seed(0))
    fine = compress(image, torch.full((2,), 1e-3))
    torch.testing.assert_close(fine, image, rtol=0, atol=1e-3)
    coarse = compress(image, torch.tensor([2.0, 30.0]))
    error = (coarse - image).abs().mean((1, 2, 3))
    assert 0.005 < error[0] < error[1]


def test_pictures_without_flaws_are_those_of_the_light():
    draw = Draw.keyed(torch.device("cpu"), 0)
    flaws = draw_flaws(draw, 2, 2, disturbance=0.0)
    light = torch.rand(2, 2, 3, 24, 32, generator=torch.Generator().manual_seed(1))
    image = develop(draw, flaws, light)
    assert ((image * 255) % 1).abs().max() < 1e-3
    # Brighter light makes brighter pixels, and nothing else does.
    order = light[0, 0, 0].flatten().argsort()
    assert (image[0, 0, 0].flatten()[order].diff() >= 0).all()


def test_wall_distance():
    size = torch.tensor([[4.0, 5.0, 3.0]])
    assert wall_distance(size, torch.tensor([[[1.0, 1.0, 2.5]]])).item() == pytest.approx(0.5)


def test_normals_are_those_of_the_depth_and_face_the_camera(clips):
    x = (torch.arange(64.0) - clips.views.intrinsics[:, 2:3]) / clips.views.intrinsics[:, :1]
    y = (torch.arange(48.0) - clips.views.intrinsics[:, 3:]) / clips.views.intrinsics[:, 1:2]
    ray = torch.stack(torch.broadcast_tensors(x[:, None], y[:, :, None], torch.ones(1)), 1)
    assert ((clips.normal * ray[:, None]).sum(2) < 1e-4).float().mean() > 0.999
    assert torch.allclose(clips.normal.norm(dim=2), torch.ones(()), atol=1e-5)
    point = clips.depth[:, :, None] * ray[:, None]
    across = point[..., 1:-1, 2:] - point[..., 1:-1, :-2]
    down = point[..., :-2, 1:-1] - point[..., 2:, 1:-1]
    found = torch.nn.functional.normalize(torch.linalg.cross(across, down, dim=2), dim=2)
    cosine = (found * clips.normal[..., 1:-1, 1:-1]).sum(2)
    # All but edges: three quarters of the pixels of such small views.
    assert (cosine > 0.999).float().mean() > 0.6
