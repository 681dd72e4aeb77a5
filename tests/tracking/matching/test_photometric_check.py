"""The images' word on a location: against the obvious reference, and what it tells apart."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from geogs.geometry.camera import Camera
from geogs.tracking.matching import photometric_check
from geogs.tracking.matching.photometric_check import (
    MAX_WINDOWS,
    MIN_CONTRAST,
    MIN_WINDOWS,
    PhotometricCheck,
    correlation_at,
    correlation_matched,
    reprojected_windows,
)
from geogs.world.grid import SampleGrid
from lenses import LENSES
from tracking_scenes import CAMERA, pose, render

GRID = SampleGrid(CAMERA)
KNOWN = torch.ones(GRID.size)
HERE = pose(0.0)


def view(T_wc: np.ndarray, camera: Camera = CAMERA) -> tuple[torch.Tensor, torch.Tensor]:
    """Grey levels of a rendered view, and inverse depth of its cells."""
    image, depth = render(T_wc, camera)
    cells = 1 / depth[4:-3:8, 4:-3:8].reshape(-1)
    return torch.from_numpy(image[..., 0].copy()).float(), torch.from_numpy(cells).float()


def relative(T_wc: np.ndarray) -> torch.Tensor:
    """From the first camera to one at ``T_wc``."""
    return torch.from_numpy(np.linalg.inv(T_wc) @ HERE)


def noise(seed: int) -> torch.Tensor:
    return torch.from_numpy(
        np.random.default_rng(seed).integers(0, 255, (CAMERA.height, CAMERA.width))
    ).float()


def at_once(image: np.ndarray, x: float, y: float) -> float:
    """Bilinear grey level."""
    u, v = min(int(x), image.shape[1] - 2), min(int(y), image.shape[0] - 2)
    a, b = x - u, y - v
    top = (1 - a) * image[v, u] + a * image[v, u + 1]
    return (1 - b) * top + b * ((1 - a) * image[v + 1, u] + a * image[v + 1, u + 1])


def smoothed(window: np.ndarray) -> np.ndarray:
    """Means of 3 x 3 pixels of a window of 9 x 9."""
    return np.array([
        [window[r : r + 3, c : c + 3].mean() for c in range(7)] for r in range(7)
    ])  # fmt: skip


def reference(
    first: np.ndarray, second: np.ndarray, T_ji: np.ndarray, inverse_depth: np.ndarray, step: int
) -> tuple[float, int]:
    """Window by window and pixel by pixel, with the camera's own matrix."""
    K, found = CAMERA.matrix().numpy(), []
    height, width = first.shape
    for n in range(0, GRID.size, step):
        x, y = GRID.pixels[n].long().tolist()
        here, there = np.empty((9, 9)), np.empty((9, 9))
        inside = True
        for r in range(9):
            for c in range(9):
                u, v = x + c - 4, y + r - 4
                here[r, c] = first[min(v, height - 1), min(u, width - 1)]
                point = np.linalg.inv(K) @ [u, v, 1] / inverse_depth[n]
                seen = K @ (T_ji[:3, :3] @ point + T_ji[:3, 3])
                px, py = seen[:2] / seen[2]
                inside &= bool(seen[2] > 0 and 0 <= px <= width - 1 and 0 <= py <= height - 1)
                there[r, c] = at_once(second, px, py) if inside else 0
        here, there = smoothed(here), smoothed(there)
        if inside and here.std() > MIN_CONTRAST:
            found.append(np.corrcoef(here.ravel(), there.ravel())[0, 1])
    found.sort()
    return found[(len(found) - 1) // 2], len(found)


@pytest.mark.parametrize(
    "there", [pose(0.12, yaw=0.03), pose(-0.3, 0.05, 0.2, -0.1), pose(0.0, z=-0.5)]
)
def test_it_is_the_median_correlation_of_the_reprojected_windows(there):
    first, inverse_depth = view(HERE)
    second, _ = view(there)
    T = relative(there)
    T[0, 3] += 0.02  # so that it is not one
    step = photometric_check._spread(GRID).step
    expected, count = reference(
        first.numpy(), second.numpy(), T.numpy(), inverse_depth.numpy(), step
    )
    found = PhotometricCheck.of(correlation_at(GRID, first, second, T, inverse_depth, KNOWN))
    assert count - 2 <= found.windows <= count + 2  # on the verge of the border
    assert found.correlation == pytest.approx(expected, abs=2e-3)
    assert 0.3 < found.correlation < 0.99


def test_windows_follow_the_camera_when_it_turns_and_comes_near():
    """What shifted windows miss: a camera rolled by 30 degrees, half as far away."""
    a = np.pi / 6
    there = pose(0.0, z=1.0)
    there[:2, :2] = [[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]
    (first, inverse_depth), (second, _) = view(HERE), view(there)
    T = relative(there)
    found = PhotometricCheck.of(correlation_at(GRID, first, second, T, inverse_depth, KNOWN))
    middle = reprojected_windows(GRID, T, inverse_depth)[:, 40]
    shifted = PhotometricCheck.of(correlation_matched(GRID, first, second, middle))
    assert found.windows > 100
    assert found.correlation > 0.97
    assert shifted.correlation < 0.6


@pytest.mark.parametrize("name", LENSES)
def test_windows_bend_as_the_lens_bends_them(name):
    """Against each pixel's own ray; a window is linear to first order."""
    grid = SampleGrid(replace(CAMERA, **LENSES[name]))
    camera, some = grid.camera, photometric_check._spread(grid)
    T = relative(pose(0.2, yaw=0.05))
    depth = torch.linspace(0.3, 0.6, grid.size)
    pixels = grid.pixels[some, None] + photometric_check._offsets(grid)
    plane = camera.plane(pixels.double())
    points = torch.cat([plane, torch.ones_like(plane[..., :1])], -1)
    seen = points @ T[:3, :3].mT + depth[some, None, None] * T[:3, 3]
    wanted = camera.pixels(seen[..., :2] / seen[..., 2:])
    found = reprojected_windows(grid, T, depth)
    off = (found - wanted).norm(dim=-1)
    middle = found.shape[1] // 2
    assert float(off.max()) < 0.3
    assert float(off[:, middle - 1 : middle + 2].max()) < 0.03
    torch.testing.assert_close(found[:, middle].double(), wanted[:, middle], atol=1e-3, rtol=0)


def test_one_place_is_told_from_noise_and_from_another():
    first, inverse_depth = view(HERE)
    near = pose(0.1, 0.02, 0.05, 0.04)
    true = PhotometricCheck.of(
        correlation_at(GRID, first, view(near)[0], relative(near), inverse_depth, KNOWN)
    )
    assert true.correlation > 0.97
    wrong = [noise(k) for k in range(5)]
    wrong += [view(near)[0].flip(0), view(near)[0].flip(1), view(pose(0.0, yaw=np.pi))[0]]
    for image in wrong:
        found = PhotometricCheck.of(
            correlation_at(GRID, first, image, relative(near), inverse_depth, KNOWN)
        )
        assert found.windows > 300
        assert abs(found.correlation) < 0.1


def test_a_smooth_flow_makes_noise_no_more_alike():
    from geogs.tracking.flow.classical_flow import ClassicalFlow

    operator = ClassicalFlow(GRID)
    images = [render(HERE)[0], render(pose(0.05, yaw=0.02))[0]]
    images += [np.repeat(noise(k).byte().numpy()[..., None], 3, -1) for k in range(5)]
    first, *others = (operator.encode(image) for image in images)
    found = []
    for other in others:
        there, _ = operator.measure([first], [other], fine=False)
        grey = operator.grey(first), operator.grey(other)
        found.append(
            PhotometricCheck.of(correlation_matched(GRID, *grey, there.pixels[0])).correlation
        )
    assert found[0] > 0.97
    assert max(found[1:]) < 0.25


def test_exposure_does_not_matter():
    first, inverse_depth = view(HERE)
    there = pose(0.1, yaw=0.02)
    second, T = view(there)[0], relative(there)
    before, after = (
        correlation_at(GRID, first, image, T, inverse_depth, KNOWN)
        for image in (second, 0.3 * second + 40)
    )
    torch.testing.assert_close(before, after, rtol=1e-5, atol=1e-5)


def test_only_windows_with_texture_and_depth_in_view_count():
    first, inverse_depth = view(HERE)
    second, T = first.clone(), torch.eye(4, dtype=torch.float64)

    def count(image: torch.Tensor, known: torch.Tensor, T: torch.Tensor = T) -> int:
        found = correlation_at(GRID, image, second, T, inverse_depth, known.float())
        return PhotometricCheck.of(found).windows

    x, y = GRID.pixels.unbind(-1)
    whole = count(first, KNOWN)
    assert whole > 0.85 * GRID.size
    left, right = count(first, x < 96), count(first, x > 96)
    assert left + right == whole
    assert min(left, right) > 0.4 * whole
    textured = first.clone()
    textured[72:] = 90  # where the windows of row 68 end
    assert count(textured, KNOWN) == count(first, y < 72)
    T[0, 3] = 1.0  # to the right of much of it
    assert 0 < count(first, KNOWN, T) < 0.8 * whole
    T[2, 3] = -10.0  # behind the camera
    nothing = PhotometricCheck.of(correlation_at(GRID, first, second, T, inverse_depth, KNOWN))
    assert nothing == PhotometricCheck(0.0, 0)


@pytest.mark.parametrize(("width", "height"), [(32, 32), (311, 201), (512, 384), (640, 480)])
def test_windows_are_spread_over_an_image_of_any_size(width, height):
    grid = SampleGrid(Camera(300.0, 300.0, width / 2, height / 2, width, height))
    image = torch.from_numpy(np.random.default_rng(0).random((height, width))).float()
    windows = photometric_check._windows(grid, image)
    cells = grid.pixels[photometric_check._spread(grid)].long()
    assert MAX_WINDOWS / 2 < len(windows) <= MAX_WINDOWS or len(windows) == grid.size
    torch.testing.assert_close(windows[:, 40], image[cells[:, 1], cells[:, 0]])
    torch.testing.assert_close(windows[:, 0], image[cells[:, 1] - 4, cells[:, 0] - 4])
    assert len(cells[:, 0].unique()) > 0.9 * grid.width
    assert len(cells[:, 1].unique()) > 0.9 * grid.height


def test_without_texture_only_what_was_expected_is_believed():
    for correlation in (-1.0, 1.0):
        few = PhotometricCheck(correlation, MIN_WINDOWS - 1)
        assert few.passes(0.5, is_expected=True)
        assert not few.passes(0.5, is_expected=False)
    for is_expected in (True, False):
        assert PhotometricCheck(0.51, MIN_WINDOWS).passes(0.5, is_expected)
        assert not PhotometricCheck(0.49, MIN_WINDOWS).passes(0.5, is_expected)
