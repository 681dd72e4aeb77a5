"""Points followed through images whose motion is known."""

from collections.abc import Generator

import cv2
import numpy as np

from geogs.camera.shutter import clip_tracks as clip_tracks_module
from geogs.camera.shutter.clip_tracks import (
    LEAST_SEEN,
    FollowedClips,
    even,
    followed_clip,
    followed_points,
)
from geogs.camera.shutter.rolling_camera import RollingCamera
from geogs.geometry.camera import Camera
from geogs.types import Frame

SIZE = 160, 120
STEP = np.array([[1.004, 0.012, 0.8], [-0.002, 1.002, -0.5]])
"""From one image to the next: moved, grown and sheared."""


def after(steps: int) -> np.ndarray:
    whole, one = np.eye(3), np.vstack([STEP, [0, 0, 1]])
    for _ in range(abs(steps)):
        whole = whole @ (one if steps > 0 else np.linalg.inv(one))
    return whole


def images(count: int) -> list[np.ndarray]:
    """A pattern that is coarser below than above, so that gradients are not in the middle."""
    rng = np.random.default_rng(1)
    base = np.zeros(SIZE[::-1])
    for size in (4, 8, 16):
        noise = rng.uniform(-1, 1, (SIZE[1] // size + 1, SIZE[0] // size + 1))
        base += size * cv2.resize(noise, SIZE, interpolation=cv2.INTER_CUBIC)
    base = np.clip(128 + 5 * base, 0, 255).astype(np.uint8)
    middle = count // 2
    return [
        cv2.warpAffine(base, after(k - middle)[:2], SIZE, flags=cv2.INTER_CUBIC, borderValue=128)
        for k in range(count)
    ]


def test_points_move_as_the_image_does():
    seen = followed_points(images(9))
    assert seen.shape[0] == 9
    assert np.isfinite(seen).all(axis=(0, 2)).sum() > 40
    for k, places in enumerate(seen):
        there = np.isfinite(places[:, 0])
        true = seen[4][there] @ after(k - 4)[:2, :2].T + after(k - 4)[:2, 2]
        error = places[there] - true
        assert np.median(np.abs(error)) < 0.1
        assert np.abs(np.median(error, axis=0)).max() < 0.04


def test_what_is_lost_stays_lost():
    covered = images(9)
    covered[6] = np.full_like(covered[6], 128)
    seen = followed_points(covered)
    assert np.isfinite(seen[5]).any()
    assert not np.isfinite(seen[6:]).any()


def test_an_image_without_texture_has_no_points():
    assert followed_points([np.full((60, 80), 99, np.uint8)] * 3).shape == (3, 0, 2)


def test_light_that_falls_off_moves_no_points(monkeypatch):
    """It stays with the camera, while the pattern moves through it."""
    v, u = np.mgrid[: SIZE[1], : SIZE[0]]
    light = 1 - 0.6 * np.hypot(u / SIZE[0] - 0.5, v / SIZE[1] - 0.5)
    dimmed = [np.rint(image * light).astype(np.uint8) for image in images(15)]
    clear, seen = followed_points(images(15)), followed_points(dimmed)
    monkeypatch.setattr(clip_tracks_module, "even", lambda image: image)

    def moved(seen: np.ndarray) -> float:
        """Pixels by which the light has moved the points, where the last image shows them."""
        both = np.isfinite(seen[14, :, 0])
        true = seen[7][both] @ after(7)[:2, :2].T + after(7)[:2, 2]
        return float(np.sqrt(np.square(seen[14][both] - true).mean()))

    as_it_is, evened = moved(followed_points(dimmed)), moved(seen)
    print(as_it_is, evened, moved(clear))
    assert evened < 0.7 * as_it_is
    assert evened < 1.2 * moved(clear)


def test_an_image_that_shows_few_points_is_left_out():
    clip = [Frame(k, k / 30, np.repeat(i[..., None], 3, 2)) for k, i in enumerate(images(12))]
    camera = RollingCamera(Camera(150.0, 150.0, 79.5, 59.5, *SIZE))
    whole = followed_clip(clip)
    grey = np.full_like(clip[0].image, 128)
    clip[:3] = [Frame(k, k / 30, grey) for k in range(3)]
    shorter = followed_clip(clip)
    assert whole is not None
    assert shorter is not None
    whole, shorter = whole.through(camera), shorter.through(camera)
    assert (len(whole.times), whole.middle) == (12, 6)
    assert (len(shorter.times), shorter.middle) == (9, 3)
    assert shorter.seen.sum(axis=1).min() >= LEAST_SEEN
    np.testing.assert_allclose(shorter.times, (np.arange(3, 12) - 6) / 30, atol=1e-12)


def test_points_are_seen_where_the_camera_has_their_rays():
    clip = [Frame(k, k / 30, np.repeat(i[..., None], 3, 2)) for k, i in enumerate(images(9))]
    followed = followed_clip(clip)
    assert followed is not None
    camera = RollingCamera(Camera(150.0, 140.0, 79.5, 59.5, *SIZE), (-0.1, 0.02, 0.0, 0.0))
    tracks = followed.through(camera)
    seen = np.isfinite(followed.pixels[..., 0])
    np.testing.assert_array_equal(tracks.seen, seen)
    again = camera.pixels(np.column_stack([tracks.plane[seen], np.ones(seen.sum())]))
    np.testing.assert_allclose(again, followed.pixels[seen], atol=1e-3)
    assert not tracks.plane[~seen].any()


def test_a_bare_image_is_evened_to_grey():
    """Sums that run along its rows may leave a contrast a little below nothing."""
    bare = np.full((240, 320), 255, np.uint8)
    bare[:, :90] = np.random.default_rng(0).integers(0, 255, (240, 90))
    with np.errstate(invalid="raise"):
        evened = even(bare)
    np.testing.assert_array_equal(evened[:, 250:], 128)


def test_clips_are_read_and_followed_once():
    clip = [Frame(k, k / 30, np.repeat(i[..., None], 3, 2)) for k, i in enumerate(images(9))]
    read: list[int] = []

    def clips(first: int) -> Generator[list[Frame], None, None]:
        for n in range(first, 5):
            read.append(n)
            yield clip if n != 1 else clip[:4]

    followed, told = FollowedClips(clips), list[float]()
    first = next(followed.up_to((2, 4, 12), told.append))
    assert read == [0, 1]
    assert len(first) == 1  # the other is too short
    assert told == [1 / 12, 2 / 12]
    groups = list(followed.up_to((2, 4, 12), told.append))
    assert read == [0, 1, 2, 3, 4]
    assert [len(group) for group in groups] == [1, 2, 1]
    assert groups[0][0] is first[0]
    assert list(map(len, followed.up_to((3, 12), told.append))) == [2, 2]
    assert read == [0, 1, 2, 3, 4]
