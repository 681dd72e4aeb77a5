"""Frames whose place nobody knows, and those that look so beside them."""

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from geogs_photos import known_positions
from geogs_photos.known_positions import with_known_positions


def model_of(places: np.ndarray) -> Any:
    """A reconstruction of frames at so many places, looking along z."""
    images: dict[int, Any] = {}

    def frame(n: int, place: np.ndarray) -> Any:
        pose = SimpleNamespace(matrix=lambda: np.column_stack([np.eye(3), -place]))
        return SimpleNamespace(
            name=f"{n:03d}", image_id=n, frame_id=100 + n, has_pose=True, num_points3D=50,
            cam_from_world=lambda: pose,
        )  # fmt: skip

    def deregister_frame(number: int) -> None:
        images[number - 100].has_pose = False

    images |= {n: frame(n, place) for n, place in enumerate(places)}
    return SimpleNamespace(
        images=images, deregister_frame=deregister_frame, tear_down=lambda: None
    )  # fmt: skip


def kept(monkeypatch: pytest.MonkeyPatch, places: np.ndarray, own: Sequence[float]) -> list[int]:
    """Frames that keep their place, each being known to what is its own and to a hundredth of the
    extent of all that are there, as one that lies far off takes part in what is aligned."""

    def deviations(model, images, T_cw, is_known):
        extent = known_positions.extent_of(np.linalg.inv(T_cw))
        known = np.hypot(np.array(own)[[image.image_id for image in images]], 0.01 * extent)
        return known, np.zeros(len(images))

    monkeypatch.setattr(known_positions, "pose_deviations", deviations)
    model = with_known_positions(model_of(places), is_known=False)
    return [n for n, image in model.images.items() if image.has_pose]


def test_what_lies_anywhere_goes_first_and_then_what_it_hid(monkeypatch):
    places = np.column_stack([np.linspace(-2, 2, 20), np.zeros((20, 2))])
    places[3] = 0, 30, 0  # makes an extent of 1.2 one of 6.7
    own = np.full(20, 0.01)
    own[3], own[11] = 3.0, 0.25  # a tenth and less of 6.7, a fifth of 1.2
    assert kept(monkeypatch, places, own) == [n for n in range(20) if n not in (3, 11)]
    own[11] = 0.05
    assert kept(monkeypatch, places, own) == [n for n in range(20) if n != 3]


def test_where_all_are_unsure_the_verdict_says_so(monkeypatch):
    places = np.column_stack([np.linspace(-2, 2, 20), np.zeros((20, 2))])
    assert kept(monkeypatch, places, np.full(20, 0.5)) == list(range(20))
    assert kept(monkeypatch, places, np.full(20, np.inf)) == list(range(20))
    assert kept(monkeypatch, places[:3], [0.01, 0.01, 9.0]) == [0, 1, 2]
