"""The GPU's room kernels against the caster for the CPU."""

from dataclasses import replace

import pytest
import torch

import geogs_synth.raycast.cuda_caster as cuda_module
from cuda_emulator import use_emulator
from geogs_synth.camera.camera_batch import CameraBatch, pixel_grid, rays
from geogs_synth.clips.furnishing import draw_furnishing
from geogs_synth.clips.lights import draw_lights
from geogs_synth.clips.materials import draw_surfaces
from geogs_synth.clips.path_choice import choose_cameras, too_near
from geogs_synth.clips.paths import draw_paths
from geogs_synth.clips.room_options import RoomOptions
from geogs_synth.clips.sampler import RoomSampler
from geogs_synth.draw import Draw
from geogs_synth.raycast.cpu_caster import CpuCaster
from geogs_synth.raycast.cuda_caster import SOURCE, CudaCaster
from geogs_synth.scene.batch import on_device
from geogs_synth.scene.rooms import MOST_SOLIDS, Rooms
from random_rooms import small_bank

HOST = torch.device("cpu")


@pytest.fixture(params=["emulated", pytest.param("gpu", marks=pytest.mark.gpu)])
def device(request, monkeypatch) -> torch.device:
    """Where the kernels run; everything is emulated where there is no GPU."""
    if request.param == "emulated":
        use_emulator(monkeypatch, cuda_module)
        return torch.device("cpu")
    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA GPU")
    return torch.device("cuda")


def furnished(device: torch.device) -> tuple[Rooms, CameraBatch]:
    """Random rooms as they are trained with; on a GPU as large."""
    large = device.type == "cuda"
    width, height = (512, 384) if large else (45, 30)
    options = RoomOptions(
        width=width, height=height, least_density=0.7, most_density=0.9, candidates=8
    )
    draw = Draw.keyed(torch.device("cpu"), 3)
    size = draw.uniform(3.0, 6.0, 2 if large else 1, 3)
    layout = draw_furnishing(draw, size, options.least_density, options.most_density)
    surfaces = draw_surfaces(draw, layout, 2, 1)
    lights = draw_lights(draw, size, 2, 1.0)
    views = choose_cameras(draw_paths(draw, options, size), size, layout.solids, width, height)
    solids = layout.solids.without(too_near(layout.solids, views))
    return on_device(Rooms(size, solids, surfaces, lights), device), on_device(views, device)


def sweep_of(views: CameraBatch) -> torch.Tensor:
    """A few degrees and centimetres from the first row to the last."""
    g = torch.Generator().manual_seed(4)
    b, v = views.T_cw.shape[:2]
    sweep = torch.cat([0.04 * torch.randn(b, v, 3, generator=g),
                       0.03 * torch.randn(b, v, 3, generator=g)], -1)  # fmt: skip
    return sweep.to(views.T_cw)


def seen_points(views: CameraBatch, depth: torch.Tensor) -> torch.Tensor:
    """World points at depths before the first view."""
    origin, direction = rays(views, 0, *pixel_grid(views))
    return (origin + depth.flatten(1)[..., None] * direction).unflatten(1, depth.shape[1:])


def test_sources_and_python_agree_on_sizes():
    text = SOURCE.with_name("solids.cuh").read_text()
    assert f"#define MOST_SOLIDS {MOST_SOLIDS}\n" in text


def test_renders_like_the_reference(device):
    rooms, views = furnished(device)
    views = replace(views, sweep=sweep_of(views))
    bank = small_bank()
    bank = replace(bank, texels=bank.texels.to(device))
    fast = on_device(CudaCaster().render(rooms, bank, views), HOST)
    slow = CpuCaster().render(on_device(rooms, HOST), small_bank(), on_device(views, HOST))
    # Rays that graze an edge, or whose texture level is between two, may fall on either side.
    wrong = (fast.depth - slow.depth).abs() > 1e-4 * slow.depth
    assert wrong.float().mean() < 2e-3
    turned = 1 - (fast.normal * slow.normal).sum(2)
    assert (turned > 1e-4).float().mean() < 4e-3
    difference = (fast.colour - slow.colour).abs().amax(2)
    assert difference.quantile(0.98) < 2e-3 if difference.numel() < 1e6 else True
    assert (difference > 5e-3).float().mean() < 0.01
    assert (fast.solid != slow.solid).float().mean() < 2e-3


def test_hits_like_the_reference(device):
    rooms, _ = furnished(device)
    g = torch.Generator().manual_seed(2)
    b = len(rooms.size)
    direction = torch.randn(b, 500, 3, generator=g).to(device)
    origin = (0.5 * rooms.size[:, None]).expand_as(direction)
    fast = on_device(CudaCaster().first_hit(rooms.size, rooms.solids, origin, direction), HOST)
    rooms = on_device(rooms, HOST)
    slow = CpuCaster().first_hit(rooms.size, rooms.solids, origin.cpu(), direction.cpu())
    assert (fast.solid != slow.solid).float().mean() < 5e-3
    same = fast.solid == slow.solid
    torch.testing.assert_close(fast.t[same], slow.t[same], rtol=1e-4, atol=1e-5)


def test_flows_like_the_reference(device):
    rooms, views = furnished(device)
    b = len(views.T_cw)
    views = replace(views, sweep=sweep_of(views))
    points = seen_points(views, 1 + torch.rand(b, views.height, views.width, device=device))
    fast = on_device(CudaCaster().flow(rooms.solids, views, points, 1), HOST)
    slow = CpuCaster().flow(on_device(rooms.solids, HOST), on_device(views, HOST), points.cpu(), 1)
    torch.testing.assert_close(fast.pixels, slow.pixels, rtol=1e-4, atol=1e-2)
    assert (fast.valid == slow.valid).all()
    assert (fast.visible != slow.visible).float().mean() < 2e-3
    assert 0 < fast.visible.float().mean() < 1


@pytest.mark.gpu
def test_samples_on_a_gpu():
    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA GPU")
    sampler = RoomSampler(RoomOptions(textures=8, texture_size=64), "cuda")
    clips, again = (sampler.sample(5, 4) for _ in range(2))
    assert (clips.images == again.images).all()
    assert clips.flow(0, 1).visible.float().mean() > 0.4
