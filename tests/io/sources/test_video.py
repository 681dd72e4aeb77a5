"""Videos: real time stamps, rotation, damage, seeking by counting."""

import logging
from dataclasses import replace

import av
import numpy as np
import pytest

from geogs.config import InputConfig
from geogs.errors import InputError
from geogs.io.sources.formats import video_file
from geogs.io.sources.formats.video_file import clockwise_quarter_turns, turn_upright
from geogs.io.sources.sniff import open_source
from io_samples import gradient_image, write_video

IMAGES = [gradient_image(i) for i in range(12)]
UNEVEN = [0, 33, 80, 100, 180, 200, 333, 400, 401, 500, 700, 1000]
NATIVE = InputConfig(intrinsics="50,50,31.5,23.5", long_edge=0)

needs_rotation = pytest.mark.skipif(
    not hasattr(av.video.stream.VideoStream, "set_display_rotation"),
    reason="this PyAV cannot write a display matrix",
)


def noise(count: int) -> list[np.ndarray]:
    """Images that compress badly, so that cutting the file cuts frames."""
    generator = np.random.default_rng(0)
    return list(generator.integers(0, 255, (count, 48, 64, 3)).astype(np.uint8))


@pytest.mark.parametrize("codec", ["libx264", "mpeg4"])
@pytest.mark.parametrize("suffix", ["mp4", "mkv", "bin"])
def test_frames_carry_presentation_times(tmp_path, codec, suffix):
    """The container's uneven times, in display order; the name's ending does not matter."""
    written = write_video(tmp_path / f"v.{'mp4' if suffix == 'bin' else suffix}", IMAGES, UNEVEN,
                          codec=codec)  # fmt: skip
    path = written.rename(tmp_path / f"v.{suffix}")
    source = open_source(path, NATIVE)
    frames = list(source)
    assert (source.kind, source.name) == ("video", path.name)
    assert [frame.index for frame in frames] == list(range(12))
    np.testing.assert_allclose([f.timestamp * 1000 for f in frames], UNEVEN, atol=0.51)
    for i, frame in enumerate(frames):
        assert np.abs(frame.image.astype(int) - gradient_image(i)).mean() < 6
    assert source.length in (12, None)


def test_video_selection_keeps_its_times(tmp_path):
    path = write_video(tmp_path / "v.mp4", IMAGES, UNEVEN)
    config = InputConfig(intrinsics="50,50,31.5,23.5", start=1, stop=10, stride=4)
    source = open_source(path, config)
    np.testing.assert_allclose([f.timestamp * 1000 for f in source], [33, 200, 500], atol=0.51)
    assert source.length == 3


@needs_rotation
@pytest.mark.parametrize("rotation", [90, 180, -90])
def test_rotated_video_is_upright_with_its_intrinsics(tmp_path, rotation):
    """Columns (green) and rows (blue) of the stored image end up where the matrix says."""
    path = write_video(tmp_path / "v.mp4", IMAGES[:3], rotation=rotation)
    source = open_source(path, InputConfig(intrinsics="50,55,30,20", long_edge=0))
    image = next(iter(source)).image.astype(int)
    upright = np.rot90(gradient_image(0), rotation // 90)
    assert image.shape == upright.shape
    assert np.abs(image - upright).mean() < 6
    camera = source.camera
    assert (camera.width, camera.height) == (image.shape[1], image.shape[0])
    expected = {
        90: (55, 50, 20, 33),  # left side becomes the bottom
        -90: (55, 50, 27, 30),
        180: (50, 55, 30, 20),  # no shape tells stored from shown: taken as shown
    }
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == expected[rotation]


def test_display_angle_to_quarter_turns():
    angles = (0.0, -90.0, 90.0, 180.0, -180.0, 89.9)
    assert [clockwise_quarter_turns(a) for a in angles] == [0, 1, 3, 2, 2, 3]
    image = gradient_image(0)
    np.testing.assert_array_equal(turn_upright(image, 1)[0, -1], image[0, 0])
    np.testing.assert_array_equal(turn_upright(image, 2), image[::-1, ::-1])


@pytest.mark.parametrize(
    ("name", "said"), [("v.mkv", "it lasts 3.0 s, but"), ("v.mp4", "it has 90 images here, but")]
)
def test_truncated_video_gives_the_frames_before_the_cut_and_is_told(tmp_path, caplog, name, said):
    path = write_video(tmp_path / name, noise(90), index_first=name.endswith("mp4"))
    assert len(list(open_source(path, NATIVE))) == 90
    assert caplog.messages == []
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with caplog.at_level(logging.WARNING, logger="geogs"):
        frames = list(open_source(path, NATIVE))
    assert 30 <= len(frames) <= 60
    np.testing.assert_allclose(np.diff([f.timestamp for f in frames]), 0.033, atol=1e-3)
    assert f"{name} says that {said}" in caplog.messages[-1]
    caplog.clear()
    assert len(list(open_source(path, replace(NATIVE, stop=10)))) == 10
    assert caplog.messages == []


@pytest.mark.parametrize("threads", [1, 2, 16])
def test_damaged_packets_are_skipped_and_counted(tmp_path, caplog, monkeypatch, threads):
    # More threads hold more packets back, up to the end of the file.
    opened = video_file._open

    def open_with_threads(path):
        container = opened(path)
        container.streams.video[0].codec_context.thread_count = threads
        return container

    monkeypatch.setattr(video_file, "_open", open_with_threads)
    path = write_video(tmp_path / "v.mp4", noise(30), codec="mpeg4", gop=1)
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 9000] = b"\xff" * 9000
    path.write_bytes(data)
    source = open_source(path, NATIVE)
    with caplog.at_level(logging.WARNING, logger="geogs"):
        frames = list(source)
    assert source.place.skipped >= 1
    assert len(frames) + source.place.skipped == 30
    assert "cannot be read; skipped" in caplog.text
    times = [frame.timestamp for frame in frames]
    np.testing.assert_allclose(times[-1], 29 * 0.033, atol=1e-3)  # later frames are not shifted


def test_video_without_its_index_cannot_be_opened(tmp_path):
    path = write_video(tmp_path / "v.mp4", noise(5))
    path.write_bytes(path.read_bytes()[:-400])
    with pytest.raises(InputError, match="cannot be opened as a video"):
        open_source(path)


def test_start_beyond_the_end_of_a_video(tmp_path):
    path = write_video(tmp_path / "v.mkv", IMAGES)
    source = open_source(path, InputConfig(start=50))
    with pytest.raises(InputError, match="ends before frame 50"):
        list(source)
    path = write_video(tmp_path / "v.mp4", IMAGES)
    with pytest.raises(InputError, match="only 12 frames"):
        open_source(path, InputConfig(start=50))
