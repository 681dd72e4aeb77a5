"""Sources of a rolling shutter: rows rectified, and the same wherever reading begins."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from geogs.camera.shutter.shutter import Shutter
from geogs.config import InputConfig
from geogs.errors import InputError
from geogs.io.sources.frame_source import Source
from geogs.io.sources.sniff import open_source
from io_samples import write_image
from rolling_scenes import RATE, READOUT, global_image, hand_held, rolling_frames, rolling_image

INTRINSICS = "150,150,95.5,71.5"
COUNT = 8
INNER = np.s_[12:-12, 12:-12]
"""Pixels whose surroundings are seen in both images."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("rolling")
    for frame in rolling_frames(hand_held, COUNT):
        write_image(folder / f"{frame.index:03d}.png", frame.image)
    return folder


def opened(folder: Path, readout: float = READOUT, **options) -> Source:
    return open_source(folder, InputConfig(INTRINSICS, readout=readout, **options))


def difference(image: np.ndarray, other: np.ndarray) -> float:
    """Mean absolute difference in grey levels, borders left out."""
    return float(np.abs(image.astype(float) - other)[INNER].mean())


def test_rows_come_to_the_time_of_the_middle_one(folder):
    rectified, as_read = list(opened(folder)), list(opened(folder, 0.0))
    assert [frame.index for frame in rectified] == list(range(COUNT))
    for frame, raw in zip(rectified, as_read, strict=True):
        true = global_image(hand_held, frame.timestamp)
        assert difference(frame.image, true) < 0.5 * difference(raw.image, true)
    middle = COUNT // 2  # where the turning is known from both sides
    true = global_image(hand_held, as_read[middle].timestamp)
    assert difference(rectified[middle].image, true) < 0.4 * difference(as_read[middle].image, true)


def test_without_a_readout_images_are_as_they_were(folder):
    for raw in (opened(folder, 0.0), open_source(folder, InputConfig(INTRINSICS))):
        for frame in raw:
            stored = cv2.imread(str(folder / f"{frame.index:03d}.png"))[..., ::-1]
            np.testing.assert_array_equal(frame.image, stored)


def test_images_of_an_open_shutter_stay_and_tell_when_their_rows_may_have_been_seen(folder):
    source = opened(folder, 0.0)
    assert all(frame.rows is None for frame in source)
    for raw, frame in zip(source, source.with_shutter(Shutter(0.0, "open", 0.01)), strict=True):
        np.testing.assert_array_equal(frame.image, raw.image)
        assert not frame.rows.is_rectified
        assert float(frame.rows.offset.abs().max()) < 1e-3
        middle = frame.rows.seconds[:, 1]
        step = 0.01 * 8 / (frame.image.shape[0] - 1)  # eight pixels
        np.testing.assert_allclose(middle.diff(), step, rtol=0.02)
        assert float(middle.max()) == pytest.approx(0.005, abs=2 * step)


def test_a_camera_that_stands_still_loses_nothing(tmp_path):
    still = global_image(hand_held, 0.3)
    for k in range(3):
        write_image(tmp_path / f"{k}.png", still)
    for frame in opened(tmp_path):
        assert difference(frame.image, still) < 0.02


def test_going_on_gives_the_same_bytes(folder):
    source = opened(folder, start=1, stop=7)
    whole, places = zip(*((frame, source.place) for frame in source), strict=True)
    assert len(whole) == 6
    for place in (1, 3, 5):
        rest = list(source.frames_after(places[place - 1]))
        assert [frame.index for frame in rest] == list(range(place, 6))
        for frame, expected in zip(rest, whole[place:], strict=True):
            np.testing.assert_array_equal(frame.image, expected.image)


@pytest.mark.parametrize("stride", [2, 3])
def test_a_stride_and_a_selection_keep_the_neighbours_of_the_source(folder, stride):
    every = {round(30 * frame.timestamp): frame.image for frame in opened(folder)}
    some = list(opened(folder, start=1, stop=6, stride=stride))
    assert [round(30 * frame.timestamp) for frame in some] == list(range(1, 6, stride))
    for frame in some:
        np.testing.assert_array_equal(frame.image, every[round(30 * frame.timestamp)])


def test_an_unreadable_neighbour_is_skipped_and_the_other_side_tells(folder, tmp_path):
    for k in range(5):
        (tmp_path / f"{k}.png").write_bytes((folder / f"{k:03d}.png").read_bytes())
    (tmp_path / "2.png").write_bytes(b"damaged")
    source = opened(tmp_path)
    frames, places = zip(*((frame, source.place) for frame in source), strict=True)
    assert (len(frames), source.place.skipped) == (4, 1)
    after = list(source.frames_after(places[1]))
    assert len(after) == 2
    for frame, expected in zip(after, frames[2:], strict=True):
        np.testing.assert_array_equal(frame.image, expected.image)
    true = global_image(hand_held, 1 / 30)
    raw = cv2.imread(str(folder / "001.png"))
    assert difference(frames[1].image, true) < 0.5 * difference(raw, true)


def test_distortion_and_rows_are_undone_at_once(tmp_path):
    barrel = (-0.12, 0.02, 0.0, 0.0)
    for k in range(3):
        image = rolling_image(hand_held, k / RATE, distortion=barrel)
        write_image(tmp_path / f"{k}.png", image)
    intrinsics = ",".join([INTRINSICS, *map(str, barrel)])
    source = open_source(tmp_path, InputConfig(intrinsics, readout=READOUT))
    lens_only = open_source(tmp_path, InputConfig(intrinsics, readout=0.0))
    assert source.camera == lens_only.camera
    true = global_image(hand_held, 1 / RATE, source.camera)
    both, one = (list(frames.straight())[1].image for frames in (source, lens_only))
    assert difference(both, true) < 0.35 * difference(one, true)


def test_images_as_recorded_skip_none_and_are_not_rectified(tmp_path):
    for k in range(10):
        write_image(tmp_path / f"{k:03d}.png", np.full((48, 64, 3), k, np.uint8))
    config = InputConfig("50,50,31.5,23.5", start=1, stop=8, stride=3, readout=READOUT)
    source = open_source(tmp_path, config)
    frames = list(source.as_recorded())
    assert [int(frame.image[0, 0, 0]) for frame in frames] == list(range(1, 8))
    assert all(frame.rows is None for frame in frames)
    assert [int(frame.image[0, 0, 0]) for frame in source] == [1, 4, 7]


def test_who_says_what_the_shutter_is(folder):
    unsaid, given = open_source(folder, InputConfig(INTRINSICS)), opened(folder)
    assert unsaid.is_shutter_open
    assert not given.is_shutter_open
    assert not opened(folder, 0.0).is_shutter_open
    assert given.shutter == Shutter(READOUT, "as given")
    found = unsaid.with_shutter(Shutter(READOUT, "found"))
    assert not found.is_shutter_open
    assert found.with_calibration(found.calibration).shutter.origin == "found"
    for frame, expected in zip(found, given, strict=True):
        np.testing.assert_array_equal(frame.image, expected.image)


@pytest.mark.parametrize("readout", [27.6, float("nan"), -0.2, "global"])
def test_a_readout_that_cannot_be_is_refused(readout):
    with pytest.raises(InputError, match=r"input\.readout .* auto or a number from -0\.1 to 0\.1"):
        InputConfig(readout=readout)
    with pytest.raises(InputError, match="readout"):
        Shutter(27.6)
