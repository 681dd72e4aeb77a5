"""Stereo pairs in one picture and panoramas: recognised, refused with advice, and cut."""

import cv2
import numpy as np
import pytest

from geogs.application.calibrate import without_overlay
from geogs.config import InputConfig
from geogs.errors import InputError
from geogs.io.sources.sniff import open_source
from geogs.io.sources.views import Direction, no_pinhole, views_of
from io_samples import write_video
from moving_wall import seen

COUNT = 8


def wall(step: float = 9.0, seed: int = 0, shift: int = 0) -> list[np.ndarray]:
    """A finely textured wall that a camera moves along, seen from some pixels further."""
    rng = np.random.default_rng(seed)
    coarse = rng.uniform(20, 235, (40, 200)).astype(np.float32)
    picture = cv2.resize(coarse, (800, 160), interpolation=cv2.INTER_CUBIC).clip(0, 255)
    starts = [round(step * k) + shift for k in range(COUNT)]
    return [np.repeat(picture[:120, s : s + 160, None], 3, 2).astype(np.uint8) for s in starts]


def pairs(axis: int) -> list[np.ndarray]:
    """Two views next to each other along an axis of the image."""
    return [np.concatenate(pair, axis=axis) for pair in zip(wall(), wall(shift=5), strict=True)]


def panoramas(width: int = 256) -> list[np.ndarray]:
    """Panoramas of a camera that turns in a textured ball, ever further."""
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(24, 3)) * 6
    v, u = np.mgrid[: width // 2, :width]
    latitude = ((v + 0.5) / width * 2 - 0.5) * np.pi
    found = []
    for k in range(COUNT):
        longitude = (u + 0.5) / width * 2 * np.pi + 0.3 * k
        ray = np.stack([np.sin(longitude), np.tan(latitude), np.cos(longitude)], -1)
        ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
        grey = 128 + 20 * np.sin(ray @ directions.T).sum(-1)
        found.append(np.repeat(grey.clip(0, 255)[..., None], 3, 2).astype(np.uint8))
    return found


@pytest.mark.parametrize(
    ("axis", "advice"), [(1, "--take left or --take right"), (0, "--take top")]
)
def test_stereo_pairs_are_recognised(axis, advice):
    sentence = no_pinhole(pairs(axis))
    assert sentence is not None
    assert advice in sentence


def test_panoramas_are_recognised():
    sentence = no_pinhole(panoramas())
    assert sentence is not None
    assert "--take front" in sentence


@pytest.mark.parametrize("seed", range(3))
def test_plain_images_are_not(seed):
    assert no_pinhole(wall(seed=seed)) is None
    assert no_pinhole([image[:80] for image in wall(seed=seed)]) is None
    assert no_pinhole([np.repeat(image[..., None], 3, 2) for image in seen(COUNT)]) is None


def test_a_scene_that_repeats_itself_is_no_stereo_pair():
    """Its halves are alike, but just as much as those of different images."""
    tiles = [np.tile(image[:60, :20], (2, 8, 1)) for image in wall(step=0.0)]
    assert no_pinhole(tiles) is None


def test_a_direction_has_the_camera_that_it_says():
    """A ray of the view is that of the panorama, wherever it looks."""
    width = 512
    v, u = np.mgrid[: width // 2, :width]
    codes = np.stack([u / 2, v, np.zeros_like(u)], -1).astype(np.uint8)
    for yaw, pitch in ((0.0, 0.0), (90.0, 0.0), (30.0, 40.0)):
        view = Direction(yaw, pitch)
        size = view.size(width, width // 2)
        camera = view.camera(*size)
        assert camera.fx == size[0] / 2
        middle = view(codes)[size[1] // 2, size[0] // 2].astype(float)
        assert abs(2 * middle[0] - (yaw / 360 + 0.5) * width) < 4
        assert abs(middle[1] - (0.5 - pitch / 180) * width / 2) < 3
    x = 40.0
    column = Direction(0.0, 0.0)(codes)[128, round(camera.cx + x)][0] * 2.0
    seen_at = np.degrees(np.arctan2(x + 0.5, camera.fx))
    assert abs((column / width - 0.5) * 360 - seen_at) < 2


def test_a_stereo_video_is_refused_unless_a_half_is_taken(tmp_path):
    path = write_video(tmp_path / "v.mp4", [image for image in pairs(1) for _ in range(3)], gop=60)
    with pytest.raises(InputError, match=r"side by side.*--take left"):
        without_overlay(open_source(path))
    source = without_overlay(open_source(path, InputConfig(take="right")))
    assert (source.camera.width, source.camera.height) == (160, 120)
    assert any("right of images of 320x120" in sentence for sentence in source.account.used)
    whole = open_source(path, InputConfig(take="none"))
    assert without_overlay(whole).camera.width == 320
    given = open_source(path, InputConfig(take="left", intrinsics="150,150,79.5,59.5"))
    assert given.camera.fx == 150


def test_a_view_of_a_panorama_has_a_known_camera(tmp_path):
    path = write_video(tmp_path / "v.mp4", [image for image in panoramas() for _ in range(3)])
    with pytest.raises(InputError, match=r"panorama of 360 degrees.*--take front"):
        without_overlay(open_source(path))
    source = without_overlay(open_source(path, InputConfig(take="360:90,0")))
    assert (source.camera.width, source.camera.height, source.camera.fx) == (128, 128, 64)
    assert not source.is_calibration_open


def test_a_half_that_was_squeezed_has_pixels_twice_as_wide(tmp_path):
    images = [cv2.resize(image, (320, 180)) for image in pairs(1)]
    path = write_video(tmp_path / "v.mp4", images)
    camera = open_source(path, InputConfig(take="left")).camera
    assert abs(camera.fy / camera.fx - 2) < 1e-6


@pytest.mark.parametrize("take", ["middle", "360:10", "360:0,100", "left+"])
def test_what_names_no_part_is_an_error(take):
    with pytest.raises(InputError, match="take"):
        views_of(take)


def test_a_panorama_cannot_be_cut_from_other_shapes(tmp_path):
    path = write_video(tmp_path / "v.mp4", wall())
    with pytest.raises(InputError, match="twice as wide as high"):
        open_source(path, InputConfig(take="front"))


def test_a_panorama_whose_resolution_changes_is_scaled(tmp_path):
    parts = [write_video(tmp_path / f"{n}.ts", panoramas(n)[:4]) for n in (256, 128)]
    both = tmp_path / "both.ts"
    both.write_bytes(b"".join(part.read_bytes() for part in parts))
    frames = list(open_source(both, InputConfig(take="front", long_edge=0)))
    assert [frame.image.shape for frame in frames] == [(128, 128, 3)] * 8
