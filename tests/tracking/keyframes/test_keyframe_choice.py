"""Motion, overlap and sharpness decide which frames become keyframes."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from geogs.config import TrackingConfig, preset
from geogs.geometry.camera import Camera
from geogs.tracking.keyframes.keyframe_choice import (
    KeyframeChoice,
    SeenMotion,
    is_near_end,
    mean_flow,
    sharpness,
)
from geogs.types import FlowMatch
from geogs.world.grid import SampleGrid

CONFIG = TrackingConfig(keyframe_parallax=0.025, keyframe_overlap=0.7)
GRID = SampleGrid(Camera(400.0, 400.0, 255.5, 191.5, 512, 384))
UNMATCHED = FlowMatch(GRID.pixels[None], torch.zeros(1, GRID.size, 2))


def seen(flow: float, overlap: float, parallax: float | None = None) -> SeenMotion:
    return SeenMotion(flow, overlap, UNMATCHED, parallax)


def moved(grid: SampleGrid, columns: int, near: float, far: float = 0.0) -> FlowMatch:
    """Matches that moved by ``near`` pixels in the first columns of cells and ``far`` in others;
    the last row is not matched, and seems to move by a thousand."""
    shape = (grid.height, grid.width)
    length = torch.full(shape, far)
    length[:, :columns] = near
    length[-1] = 1000.0
    weight = torch.ones(*shape, 2)
    weight[-1] = 0
    along = torch.tensor([0.6, -0.8])
    pixels = grid.pixels + length.reshape(-1, 1) * along
    return FlowMatch(pixels[None], weight.reshape(1, -1, 2))


def texture(seed: int = 0) -> np.ndarray:
    """Large surfaces with a grain, as in pictures."""
    random = np.random.default_rng(seed)
    surfaces = np.kron(random.integers(40, 200, (6, 8, 3)), np.ones((20, 20, 1)))
    grain = cv2.GaussianBlur(random.normal(0, 40, (120, 160, 3)), (0, 0), 1.0)
    return np.clip(surfaces + grain, 0, 255).astype(np.uint8)


def is_chosen(flow: float, overlap: float) -> bool:
    return KeyframeChoice(CONFIG, GRID).calls_for(seen(flow, overlap, flow))


def test_motion_makes_a_keyframe_whatever_overlaps() -> None:
    assert is_chosen(12.9, 1.0)
    assert not is_chosen(12.7, 1.0)


def test_before_depths_are_known_the_rotation_counts_and_more_is_asked_for() -> None:
    choice = KeyframeChoice(CONFIG, GRID)
    assert not choice.calls_for(seen(17.9, 1.0))
    assert choice.calls_for(seen(18.0, 1.0))


def test_near_the_end_a_third_of_the_parallax_is_enough() -> None:
    choice = KeyframeChoice(CONFIG, GRID)
    assert not choice.calls_for(seen(4.2, 1.0, 4.2), near=True)
    assert choice.calls_for(seen(4.3, 1.0, 4.3), near=True)
    assert choice.calls_for(seen(6.0, 1.0), near=True)
    assert not choice.calls_for(seen(5.9, 1.0), near=True)


def test_the_end_is_near_where_no_usual_keyframe_comes_any_more() -> None:
    assert is_near_end(8, [10, 15, 24])
    assert not is_near_end(9, [10, 15, 24])
    assert is_near_end(8, [15, 24, 27, 30])  # the latest are closer because it is
    assert not is_near_end(0, [10])
    assert not is_near_end(None, [10, 15, 24])


def test_lost_overlap_makes_a_keyframe_before_the_median_motion_does() -> None:
    assert is_chosen(6.0, 0.65)
    assert not is_chosen(6.0, 0.75)


def test_a_poor_image_of_a_resting_camera_is_no_keyframe() -> None:
    assert not is_chosen(2.0, 0.3)


def test_blur_takes_sharpness_and_light_does_not() -> None:
    sharp = texture()
    blurred = cv2.blur(sharp, (7, 1))
    assert sharpness(blurred) < 0.6 * sharpness(sharp)
    darker = (0.7 * sharp.astype(np.float32) + 10).astype(np.uint8)
    assert sharpness(darker) == pytest.approx(sharpness(sharp), rel=0.05)


def test_a_blurred_frame_waits_for_a_sharper_one_but_not_for_long() -> None:
    choice = KeyframeChoice(CONFIG, GRID)
    for seed in range(5):
        choice.see(texture(seed))
    assert choice.calls_for(seen(12.9, 1.0, 12.9))
    choice.see(cv2.blur(texture(5), (9, 1)))
    assert not choice.calls_for(seen(17.8, 1.0, 17.8))
    assert choice.calls_for(seen(18.0, 1.0, 18.0))
    assert not choice.calls_for(seen(9.0, 0.6, 9.0))
    assert choice.calls_for(seen(9.0, 0.45, 9.0))


def test_where_all_are_blurred_none_waits() -> None:
    choice = KeyframeChoice(CONFIG, GRID)
    for seed in range(12):
        choice.see(cv2.blur(texture(seed), (9, 1)))
    assert choice.calls_for(seen(12.9, 1.0, 12.9))


def test_a_choice_goes_on_where_another_was() -> None:
    recent: list[float] = []
    choice = KeyframeChoice(CONFIG, GRID, recent)
    for seed in range(5):
        choice.see(texture(seed))
    choice.settle()
    other = KeyframeChoice(CONFIG, GRID, recent)
    other.see(cv2.blur(texture(5), (9, 1)))
    assert not other.calls_for(seen(13.0, 1.0, 13.0))


def test_a_camera_that_turns_makes_keyframes_by_what_goes_out_of_sight() -> None:
    choice = KeyframeChoice(CONFIG, GRID)
    turned = 60.0
    assert not choice.calls_for(seen(turned, 0.85, parallax=5.0))
    assert choice.calls_for(seen(turned, 0.85, parallax=12.9))
    assert choice.calls_for(seen(turned, 0.65, parallax=0.5))
    assert choice.calls_for(seen(77.0, 0.85, parallax=0.5))  # flow should not be measured farther


def test_the_mean_flow_is_that_of_the_matched_cells() -> None:
    assert (GRID.width, GRID.height) == (64, 48)
    match = moved(GRID, columns=16, near=40.0, far=4.0)
    assert mean_flow(GRID, match) == pytest.approx((16 * 40.0 + 48 * 4.0) / 64, rel=1e-5)
    lengths = [
        float((match.pixels[0, u] - GRID.pixels[u]).norm())
        for u in range(GRID.size)
        if match.weight[0, u, 0] > 0
    ]
    assert mean_flow(GRID, match) == pytest.approx(sum(lengths) / len(lengths), rel=1e-5)
    assert mean_flow(GRID, UNMATCHED) == 0.0


def test_the_papers_keyframes_are_made_by_the_mean_flow_alone() -> None:
    """2.4 cells of 8 pixels at 616, whatever the median, the overlap, parallax and sharpness."""
    grid = SampleGrid(Camera(500.0, 500.0, 307.5, 171.5, 616, 344))
    config = preset("paper").tracking
    choice = KeyframeChoice(config, grid)
    columns = grid.width // 3
    for mean, is_keyframe in ((19.0, False), (19.2, True)):
        match = moved(grid, columns, near=mean * grid.width / columns)
        median = float((match.pixels - grid.pixels)[0, : -grid.width].norm(dim=-1).median())
        assert (median, mean_flow(grid, match)) == (0.0, pytest.approx(mean, rel=1e-4))
        for overlap, parallax in ((1.0, 0.0), (0.2, 100.0), (0.5, None)):
            motion = SeenMotion(median, overlap, match, parallax)
            assert choice.calls_for(motion) == is_keyframe
            assert choice.calls_for(motion, near=True) == is_keyframe
        for seed in range(5):
            choice.see(texture(seed))
        choice.see(cv2.blur(texture(5), (9, 1)))
        assert choice.calls_for(motion) == is_keyframe
    usual = KeyframeChoice(replace(config, keyframe_mean_flow=0.0), grid)
    assert not usual.calls_for(SeenMotion(0.0, 1.0, match, 0.0))
