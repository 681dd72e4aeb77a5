"""What rectified rows are off by: against points followed through time one by one."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from geogs.bundle.projection import carried_over, project
from geogs.camera.shutter.angular_motion import AngularMotion
from geogs.camera.shutter.rolling_camera import RollingCamera
from geogs.camera.shutter.rows import RowOffsets
from geogs.camera.shutter.shutter import Shutter
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_exp, se3_inverse
from geogs.tracking.frames.row_errors import LONGEST_INTERVAL, RowErrors, lagrange
from geogs.types import SeenRows, Trajectory
from geogs.world.grid import SampleGrid
from lenses import LENSES, with_lens

CAMERA = Camera(220.0, 215.0, 157.0, 121.0, 320, 240)
GRID = SampleGrid(CAMERA)
READOUT, RATE, COUNT, FRAME = 0.03, 30.0, 9, 4
ASSUMED = AngularMotion(np.array([0.05, -0.9, 0.1]), np.array([0.5, 0.2, -0.3]))
"""By how much rows were taken to turn; the camera turns by more, and moves."""


def pose(time: float) -> torch.Tensor:
    """World to camera, at seconds from the frame that is looked at."""
    twist = torch.tensor([0.5, -0.2, 0.3, 0.1, -1.1, 0.05], dtype=torch.float64)
    change = torch.tensor([1.0, 0.6, -2.0, 0.8, 1.5, -0.7], dtype=torch.float64)
    return se3_exp(twist * time + change * time**2)


def trajectory(interval: float = 1 / RATE) -> Trajectory:
    times = (np.arange(COUNT) - FRAME) * interval
    T_wc = np.stack([se3_inverse(pose(t)).numpy() for t in times])
    return Trajectory(times, T_wc, np.ones(COUNT, bool))


def rows(distortion: tuple[float, ...] = ()) -> tuple[RollingCamera, RowOffsets, SeenRows]:
    rolling = RollingCamera(with_lens(CAMERA, distortion))
    offsets = RowOffsets(rolling, CAMERA)
    return rolling, offsets, offsets.seen(offsets.nodes(ASSUMED, READOUT), Shutter(READOUT))


def errors(seen: SeenRows, path: Trajectory | None = None) -> RowErrors:
    known = dict.fromkeys(range(COUNT), seen)
    return RowErrors(GRID, known, range(COUNT), path or trajectory())


def read_at(rolling: RollingCamera, point: np.ndarray) -> np.ndarray:
    """The pixel of the sensor that sees a point: the row's time and its place have to agree."""
    early, late = -0.75, 0.75
    for _ in range(50):  # bisection: a row passes the point once
        middle = (early + late) / 2
        T = pose(READOUT * middle).numpy()
        pixel = rolling.pixels((T[:3, :3] @ point + T[:3, 3])[None])
        late, early = (middle, early) if rolling.line_times(pixel)[0] < middle else (late, middle)
    return pixel[0]


def shown_at(rolling: RollingCamera, offsets: RowOffsets, pixel: np.ndarray) -> np.ndarray:
    """The pixel of the rectified image that was taken from one of the sensor's."""
    dense = offsets.dense(offsets.nodes(ASSUMED, READOUT)).astype(np.float64)
    here = pixel.copy()
    for _ in range(20):
        u, v = np.clip(here, 0, [CAMERA.width - 1.001, CAMERA.height - 1.001])
        at, (a, b) = (int(u), int(v)), (u % 1, v % 1)
        near = dense[at[1] : at[1] + 2, at[0] : at[0] + 2]
        moved = np.tensordot(np.outer([1 - b, b], [1 - a, a]), near, 2)
        ray = np.array([(here[0] - CAMERA.cx) / CAMERA.fx, (here[1] - CAMERA.cy) / CAMERA.fy, 1.0])
        here = here + 0.9 * (pixel - rolling.pixels(ray[None])[0] - moved)
    return here


@pytest.mark.parametrize("distortion", [(), (-0.1, 0.02, 0.0, 0.0)])
def test_points_lie_beside_where_a_wrong_motion_put_them(distortion):
    rolling, offsets, seen = rows(distortion)
    for u, v, z in [(60, 40, 1.5), (160, 60, 0.8), (250, 200, 2.5), (40, 215, 1.2)]:
        ray = np.array([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, 1.0])
        shown = shown_at(rolling, offsets, read_at(rolling, z * ray))
        expected = np.array([u, v]) - shown
        assert np.abs(expected).max() > 0.2
        found = (
            errors(seen)
            .of_pixels([FRAME], torch.tensor(shown[None, None]).float(), torch.full((1, 1), 1 / z))
            .shift
        )
        np.testing.assert_allclose(found[0, 0], expected, atol=0.02 + 0.04 * np.abs(expected).max())


@pytest.mark.parametrize("device", ["loops", "plain"])
@pytest.mark.parametrize("name", LENSES)
def test_what_a_lens_shows_lies_where_the_pinhole_has_it_but_for_the_bend(name, device):
    """All pixels being seen at one time, which is another than was assumed."""
    lens = replace(CAMERA, **LENSES[name])
    nodes = rows()[2]
    seen = SeenRows(torch.zeros_like(nodes.offset), torch.full_like(nodes.seconds, 0.02))
    pixels, d = GRID.pixels[None], torch.full((1, GRID.size), 0.7)
    found = []
    for camera in (CAMERA, lens):
        known = RowErrors(SampleGrid(camera), {FRAME: seen}, range(COUNT), trajectory())
        at = camera.pixels(CAMERA.plane(pixels))
        if device == "loops":
            shifts = known.of_pixels([FRAME], at, d)
        else:
            shifts = known._shifted(list(known._rectified.values()), [0], at, d)
        longer = known.with_readout(1.02).of_pixels([FRAME], at, d)
        slope = (longer.shift - shifts.shift) / 0.02
        torch.testing.assert_close(shifts.slope, slope, atol=0.03, rtol=0.02)
        found.append(camera.plane(at - shifts.shift))
    assert float((found[0] - CAMERA.plane(pixels)).abs().max()) > 0.01
    torch.testing.assert_close(*found, atol=1e-5, rtol=0)


def test_a_match_is_corrected_at_both_its_ends():
    seen = rows()[2]
    T_ji = pose(1 / RATE) @ se3_inverse(pose(0.0))
    d = torch.full((1, GRID.size), 0.7)
    p = project(CAMERA, GRID.rays, T_ji[None], d)
    known = errors(seen)
    both = known.of_matches([FRAME], [FRAME + 1], T_ji[None], GRID.rays, d, p.pixels).shift
    there = known.of_pixels([FRAME + 1], p.pixels, d / p.z).shift
    here = known.of_pixels([FRAME], GRID.pixels[None], d).shift
    rays = GRID.rays.clone()
    rays[:, :2] += here[0] / torch.tensor([CAMERA.fx, CAMERA.fy])
    beside = project(CAMERA, rays, T_ji[None], d).pixels
    small = both.norm(dim=-1) > 0  # where it is believed
    assert small.float().mean() > 0.9
    torch.testing.assert_close(both[small], (there - beside + p.pixels)[small], atol=0.01, rtol=0)


@pytest.mark.parametrize("name", LENSES)
def test_a_step_is_carried_as_finite_differences_carry_it(name):
    camera = replace(CAMERA, **LENSES[name])
    T_ji = se3_exp(torch.tensor([[0.3, -0.1, 0.4, 0.2, -0.3, 0.15]], dtype=torch.float64))
    d = torch.linspace(0.2, 1.5, GRID.size, dtype=torch.float64)[None]
    pixels, small = GRID.pixels.double(), 1e-5

    def rays(pixels: torch.Tensor) -> torch.Tensor:
        return torch.cat([camera.plane(pixels), torch.ones(GRID.size, 1).double()], 1)

    p = project(camera, rays(pixels), T_ji, d)
    for axis in (0, 1):
        step = torch.zeros(1, GRID.size, 2, dtype=torch.float64)
        step[..., axis] = 1.0
        moved = rays(pixels + small * step[0])
        numeric = (project(camera, moved, T_ji, d).pixels - p.pixels) / small
        carried = carried_over(camera, rays(pixels), T_ji, p, step)
        torch.testing.assert_close(carried[p.valid], numeric[p.valid], atol=1e-3, rtol=1e-3)


def test_shares_follow_a_polynomial():
    times = torch.tensor([[-0.06, -0.03, 0.0, 0.04, 0.07]], dtype=torch.float64)
    at = torch.tensor([[-0.015, 0.0, 0.011]], dtype=torch.float64)
    for power in range(5):
        weights, changes = (torch.stack(x, -1) for x in lagrange(times, at))
        value, change = ((x * (times**power)[:, None]).sum(-1) for x in (weights, changes))
        torch.testing.assert_close(value, at**power)
        torch.testing.assert_close(change, power * at ** max(power - 1, 0))


def test_compiled_loops_say_what_plain_pytorch_does():
    known, g = errors(rows()[2]).with_readout(1.1), torch.Generator().manual_seed(4)
    frames = [2, 5, 2, 4]
    size = torch.tensor([CAMERA.width, CAMERA.height])
    pixels = size * (1.2 * torch.rand(4, 300, 2, generator=g) - 0.1)  # some beyond the border
    d = 0.3 + torch.rand(4, 300, generator=g)
    fast = known.of_pixels(frames, pixels, d)
    order = [2, 5, 4]
    which = [order.index(frame) for frame in frames]
    plain = known._shifted([known._rectified[frame] for frame in order], which, pixels, d)
    torch.testing.assert_close(fast.shift, plain.shift, rtol=0, atol=5e-4)
    torch.testing.assert_close(fast.slope, plain.slope, rtol=1e-3, atol=2e-3)


def test_the_slope_is_what_a_longer_readout_adds():
    known = errors(rows()[2])
    T_ji, d = pose(1 / RATE) @ se3_inverse(pose(0.0)), torch.full((1, GRID.size), 0.7)
    p = project(CAMERA, GRID.rays, T_ji[None], d)

    def matches(factor: float):
        at = known.with_readout(factor)
        return at.of_matches([FRAME], [FRAME + 1], T_ji[None], GRID.rays, d, p.pixels)

    numeric = (matches(1.02).shift - matches(0.98).shift) / 0.04
    slope = matches(1.0).slope
    assert slope.abs().max() > 0.5
    torch.testing.assert_close(slope, numeric, rtol=0, atol=0.005)


def test_nothing_is_said_where_too_little_is_known():
    seen = rows()[2]
    pixels, d = GRID.pixels[None], torch.full((1, GRID.size), 0.5)
    assert errors(seen).of_pixels([FRAME], pixels, d).shift.abs().max() > 0.3
    slow = trajectory(1.1 * LONGEST_INTERVAL)
    assert not errors(seen, slow).of_pixels([FRAME], pixels, d).shift.any()
    whole = trajectory()
    holes = Trajectory(whole.timestamps, whole.T_wc, np.arange(COUNT) % 4 != 3)
    assert not errors(seen, holes).of_pixels([FRAME], pixels, d).shift.any()
    without = RowErrors(GRID, {}, range(COUNT), trajectory())
    assert not without.of_pixels([FRAME], pixels, d).shift.any()
