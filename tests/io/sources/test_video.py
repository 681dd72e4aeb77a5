"""Videos: real time stamps, rotation, damage, seeking by counting."""

import itertools
import logging
import math
import struct
from dataclasses import replace
from fractions import Fraction

import av
import numpy as np
import pytest

from geogs.config import InputConfig
from geogs.errors import InputError
from geogs.io.sources import video_limits
from geogs.io.sources.formats import video_file
from geogs.io.sources.formats.video_file import VideoFile, turn_upright
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


def test_quarter_turns_are_clockwise():
    image = gradient_image(0)
    np.testing.assert_array_equal(turn_upright(image, 1)[0, -1], image[0, 0])
    np.testing.assert_array_equal(turn_upright(image, 2), image[::-1, ::-1])


@pytest.mark.parametrize("signs", itertools.product((-1, 1), repeat=2))
@pytest.mark.parametrize("swaps", [False, True])
def test_a_video_is_shown_by_its_display_matrix_mirrored_too(tmp_path, signs, swaps):
    """A stored position (x, y) is shown at (a x + c y, b x + d y)."""
    a, d, b, c = (0, 0, *signs) if swaps else (*signs, 0, 0)
    path = write_video(tmp_path / "v.mp4", IMAGES[:2])
    data = bytearray(path.read_bytes())
    at = data.index(b"tkhd") + 44
    one = 1 << 16
    struct.pack_into(">9i", data, at, a * one, b * one, 0, c * one, d * one, 0, 0, 0, 1 << 30)
    path.write_bytes(data)
    source = open_source(path, InputConfig(long_edge=0))
    shown = next(iter(source)).image.astype(int)
    stored = gradient_image(0)
    expected = stored if a else stored.transpose(1, 0, 2)
    expected = expected[:, ::-1] if min(a, c) < 0 else expected
    expected = expected[::-1] if min(b, d) < 0 else expected
    assert shown.shape == expected.shape
    assert np.abs(shown - expected).mean() < 6
    is_said = any("mirrored" in line for line in source.account.used)
    assert is_said == (a * d - b * c < 0)


@pytest.mark.parametrize(("aspect", "ratio"), [((4, 3), 0.75), ((16, 15), 0.9375), ((1, 2), 2.0)])
@pytest.mark.parametrize("rotation", [0, pytest.param(90, marks=needs_rotation)])
def test_pixels_that_are_not_square_have_two_focal_lengths(tmp_path, aspect, ratio, rotation):
    """As the container says, of the upright image; given intrinsics stay as they are."""
    aspect = Fraction(*aspect)
    path = write_video(tmp_path / "v.mkv", IMAGES[:2], rotation=rotation, aspect=aspect)
    guessed = open_source(path, InputConfig(long_edge=0))
    fx, fy = guessed.calibration.fx, guessed.calibration.fy
    assert fx / fy == pytest.approx(1 / ratio if rotation else ratio)
    # Along the longer side as shown, 60 degrees.
    longer = max(64 * float(aspect), 48)
    assert max(fx, fy) == pytest.approx(longer * max(ratio, 1) / 2 / np.tan(np.pi / 6))
    assert "times as wide as high, by the video file" in guessed.account.used[-1]
    given = open_source(path, InputConfig(intrinsics="50,55,23.5,31.5", long_edge=0)).calibration
    assert (given.fx, given.fy) == (50, 55)


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
    assert source.spread(8) == []
    with pytest.raises(InputError, match="ends before frame 50"):
        list(source)
    path = write_video(tmp_path / "v.mp4", IMAGES)
    with pytest.raises(InputError, match="only 12 frames"):
        open_source(path, InputConfig(start=50))


@pytest.mark.parametrize(("size", "scaled"), [((48, 36), 5), ((128, 96), 5), ((48, 64), 0)])
def test_a_resolution_that_changes_in_mid_stream(tmp_path, caplog, size, scaled):
    """Images of the same shape are scaled, others are skipped; both are said once."""
    parts = [
        write_video(tmp_path / f"{n}.ts", [gradient_image(i, *at) for i in range(5)])
        for n, at in enumerate([(64, 48), size])
    ]
    both = tmp_path / "both.ts"
    both.write_bytes(b"".join(part.read_bytes() for part in parts))
    source = open_source(both, NATIVE)
    with caplog.at_level(logging.WARNING, logger="geogs"):
        frames = list(source)
    assert len(frames) == 5 + scaled
    said = f"is {size[0]}x{size[1]}" + (": scaled to 64x48" if scaled else " but the others are")
    assert sum(said in line for line in caplog.messages) == 1
    assert not any("cut off" in line for line in caplog.messages)
    for k, frame in enumerate(frames):
        assert np.abs(frame.image.astype(int) - gradient_image(k % 5)).mean() < 6
    assert source.place.recordings[0].scaled == scaled


def write_gif(path, width, height, images=3):
    """Black images, of a few bytes each whatever their size."""
    data = b"GIF89a" + struct.pack("<HH", width, height) + b"\x80\0\0\0\0\0\xff\xff\xff"
    image = b"\x21\xf9\x04\x04\x05\0\0\0," + struct.pack("<4H", 0, 0, 2, 2)
    path.write_bytes(data + images * (image + b"\0\x02\x03\x44\x02\x05\0") + b";")


def write_y4m(path, width, height):
    path.write_bytes(f"YUV4MPEG2 W{width} H{height} F30:1 C420\nFRAME\n".encode() + bytes(500))


@pytest.mark.parametrize(("write", "suffix"), [(write_gif, "gif"), (write_y4m, "y4m")])
@pytest.mark.parametrize("size", [(16200, 16200), (65000, 300), (8193, 8193)])
def test_no_file_can_have_images_far_larger_than_itself(tmp_path, monkeypatch, write, suffix, size):
    write(tmp_path / f"v.{suffix}", *size)
    monkeypatch.setattr(video_file, "_decoded", lambda *_: pytest.fail("an image was decoded"))
    with pytest.raises(InputError, match=r"states \d+x\d+ pixels|cannot be opened"):
        VideoFile(tmp_path / f"v.{suffix}")


def test_an_image_that_grows_in_mid_stream_is_not_decoded(tmp_path, monkeypatch):
    small, large = [gradient_image(0)] * 12, [np.zeros((480, 640, 3), np.uint8)] * 2
    for name, images in (("a", small), ("b", large)):
        write_video(tmp_path / f"{name}.h264", images)
    whole = b"".join((tmp_path / f"{name}.h264").read_bytes() for name in "ab")
    (tmp_path / "v.h264").write_bytes(whole)
    with video_file._open(tmp_path / "v.h264") as container:
        shapes = [f and (f.width, f.height) for f in video_file._decoded(container, tmp_path)]
    assert shapes[-1] == (640, 480)
    monkeypatch.setattr(video_limits, "MOST_PIXELS", 64 * 48)
    with video_file._open(tmp_path / "v.h264") as container:
        shapes = {f and (f.width, f.height) for f in video_file._decoded(container, tmp_path)}
    assert shapes == {(64, 48), None}


@pytest.mark.parametrize("code", [b"ZZZZ", b"\0\0\0\0", b"none"])
def test_a_video_of_an_unknown_codec_is_refused_in_a_sentence(tmp_path, code):
    path = write_video(tmp_path / "v.avi", [gradient_image(i) for i in range(3)], codec="mpeg4")
    path.write_bytes(path.read_bytes().replace(b"FMP4", code))
    with pytest.raises(InputError, match=r"v\.avi (cannot be decoded|holds no picture)"):
        VideoFile(path)


@pytest.mark.parametrize(
    ("stated", "taken"),
    [(None, 30), (0.0, 30), (1e-9, 30), (1e9, 30), (Fraction(30000, 1001), 29.97), (math.nan, 30)],
)
def test_a_rate_that_no_camera_has_counts_as_unknown(stated, taken):
    assert video_limits.nominal_rate(stated) == pytest.approx(taken, abs=0.01)
