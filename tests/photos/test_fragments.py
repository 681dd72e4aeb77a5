"""Ways that are tried where structure from motion of a video falls into parts."""

from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from geogs.application.structure_from_motion.chosen_frames import ChosenFrames
from geogs.errors import InputError
from geogs.io.sources.calibration import Calibration
from geogs.types import Frame
from geogs_photos import fragments, incremental_mapping, video
from geogs_photos.database import SharedCamera
from geogs_photos.fragments import firmly_joined, rejoined, with_known_positions
from geogs_photos.incremental_mapping import placed_images
from posed_layouts import render_room

CAMERA = SharedCamera(Calibration(100.0, 100.0, 50.0, 40.0), is_known=False)


@dataclass
class Image:
    name: str
    num_points3D: int
    has_pose: bool = True


class Part:
    """A reconstruction of so many frames, and of some that hardly a point places."""

    cameras = ()

    def __init__(self, frames: int) -> None:
        self.frames = frames
        points = [20] * frames + [3] * 50
        self.images = {k: Image(f"{k:03d}", n) for k, n in enumerate(points)}


@pytest.mark.parametrize(
    ("first", "false", "without", "globally", "again", "best", "tried"),
    [
        ([95], [(1, 2)], [], [], [], 95, []),  # whole enough
        ([60, 35], [], [], [98], [], 98, ["globally"]),
        ([60, 35], [], [], [40], [92], 92, ["globally", "again"]),
        ([60, 35], [], [], [65], [30], 65, ["globally", "again"]),  # of all the largest
        ([60, 35], [(1, 2)], [97], [], [], 97, ["without"]),
        ([60, 35], [(1, 2)], [70], [60], [60], 70, ["without", "globally", "again"]),
        ([], [], [], [], [], None, ["globally"]),
        ([], [], [], [70], [80], 80, ["globally", "again"]),
    ],
)
def test_of_all_ways_the_one_that_puts_most_into_one(
    monkeypatch, first, false, without, globally, again, best, tried
):
    asked = []

    def by_way(name: str, sizes: list[int]):
        def way(*given: object) -> list[Part]:
            asked.append(name)
            assert Path("pruned" if "without" in asked[:-1] else "all") in given
            return [Part(n) for n in sizes]

        return way

    by_rest = by_way("without", without)
    monkeypatch.setattr(fragments, "believed", lambda part, _: part)
    monkeypatch.setattr(fragments, "with_known_positions", lambda part, _: part)
    monkeypatch.setattr(fragments, "false_pairs", lambda *_: false)
    monkeypatch.setattr(fragments, "_without", lambda *given: (by_rest(*given), Path("pruned")))
    monkeypatch.setattr(fragments, "_globally", by_way("globally", globally))
    monkeypatch.setattr(fragments, "_with_camera_of", by_way("again", again))
    monkeypatch.setattr(fragments, "_closely", by_way("closely", []))
    _without_refinement(monkeypatch)
    parts = [Part(n) for n in first]
    found = rejoined(parts, Path("all"), 100, [CAMERA], 0, lambda *_: None)
    assert asked == [*tried, *(["closely"] if best else [])]
    assert (found[0].frames if found else None) == best


def _without_refinement(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fragments, "load_colmap", lambda: SimpleNamespace(Reconstruction=copy))
    monkeypatch.setattr(fragments, "refine", lambda model, _: model)


def path_of(frames: int, astray: int = 0) -> Any:
    """A reconstruction of a bent path, the last frames of which lie beside it."""
    images = {}
    for k in range(frames):
        T = np.eye(4)
        T[:3, 3] = -np.array([0.1 * k, np.sin(0.1 * k), 2.0 * (k >= frames - astray)])
        pose = SimpleNamespace(matrix=lambda T=T: T[:3])
        images[k] = SimpleNamespace(
            image_id=k, name=f"{k:03d}", has_pose=True, num_points3D=20,
            cam_from_world=lambda pose=pose: pose, projection_center=lambda T=T: -T[:3, 3],
        )  # fmt: skip
    return SimpleNamespace(images=images, cameras=())


@pytest.mark.parametrize(
    ("closely", "taken"), [((90,), 1), ((89,), 0), ((100, 3), 1), ((100, 20), 0), (None, 0)]
)
def test_close_matches_are_taken_where_nearly_all_frames_stay_where_they_were(
    monkeypatch, closely, taken
):
    monkeypatch.setattr(fragments, "believed", lambda part, _: part)
    monkeypatch.setattr(fragments, "with_known_positions", lambda part, _: part)
    monkeypatch.setattr(fragments, "false_pairs", lambda *_: [])
    first, again = path_of(100), [] if closely is None else [path_of(*closely)]
    monkeypatch.setattr(fragments, "_closely", lambda *_: again)
    _without_refinement(monkeypatch)
    found = rejoined([first], Path("all"), 100, [CAMERA], 0, lambda *_: None)
    assert (found[0] is not first) == taken


def model_of(pictures: int, points: Iterable[Sequence[int]]) -> Any:
    """A reconstruction of pictures 1, 2 ... and of points that some of them see."""
    images = {
        n: SimpleNamespace(image_id=n, frame_id=100 + n, has_pose=True)
        for n in range(1, pictures + 1)
    }
    tracks = [
        SimpleNamespace(track=SimpleNamespace(elements=[SimpleNamespace(image_id=n) for n in seen]))
        for seen in points
    ]

    def deregister_frame(frame: int) -> None:
        images[frame - 100].has_pose = False

    return SimpleNamespace(
        images=images,
        points3D=dict(enumerate(tracks)),
        deregister_frame=deregister_frame,
        tear_down=lambda: None,
    )


@pytest.mark.parametrize(
    ("between", "kept"),
    [
        ([], {1, 2, 3, 4}),
        ([(4, 5)] * 200, {1, 2, 3, 4}),  # of these 5 has a direction, and no distance
        ([(3, 4, 5)] * 14, {1, 2, 3, 4}),
        ([(3, 4, 5)] * 15, {1, 2, 3, 4, 5}),  # what 6 and 7 see has no scale about 5
        ([(4, 5, 6)] * 15, {1, 2, 3, 4}),
        ([(3, 4, 5)] * 15 + [(3, 4, 6)] * 14, {1, 2, 3, 4, 5}),
        ([(3, 4, 5)] * 15 + [(3, 4, 6)] * 8 + [(2, 3, 7)] * 7, {1, 2, 3, 4, 5, 6, 7}),
        ([(3, 4, 5, 6)] * 15, {1, 2, 3, 4, 5, 6, 7}),
    ],
)
def test_parts_without_a_common_scale_are_not_one(between, kept):
    points = [(1, 2, 3)] * 30 + [(2, 3, 4)] * 20 + [(5, 6, 7)] * 500 + between
    model = firmly_joined(model_of(7, points))
    assert {n for n, image in model.images.items() if image.has_pose} == kept


def test_what_hangs_on_a_single_known_picture_has_no_scale():
    points = [(1, 2, 3)] * 30 + [(5, 6, 7)] * 500 + [(3, 5, 6)] * 90
    for known, kept in (({1, 2, 3}, {1, 2, 3}), ({1, 2, 3, 7}, {1, 2, 3, 5, 6, 7})):
        model = firmly_joined(model_of(7, points), known)
        assert {n for n, image in model.images.items() if image.has_pose} == kept


def test_a_reconstruction_of_nothing_stays_nothing():
    assert not firmly_joined(model_of(0, [])).images


@pytest.mark.system
@pytest.mark.long
def test_each_way_places_a_room(monkeypatch):
    """Incremental mapping is taken to have failed; the others place all by themselves."""
    pytest.importorskip("pycolmap")
    room = render_room(9, 3, 240, 180)
    frames = tuple(Frame(k, k / 10, image) for k, image in enumerate(room.images))
    chosen = ChosenFrames(frames, np.arange(9) / 10)
    truth = room.T_wc[:, :3, 3]
    extent = np.linalg.norm(truth - truth[0], axis=1)

    def check(parts, *given: object) -> list:
        found = {"globally": fragments._globally(given[0], False, 0)}
        arguments = (parts[0], given[0], 9, 0, lambda _: None)
        found["again"] = fragments._with_camera_of(*arguments)
        found["closely"] = fragments._closely(*arguments)
        rest = fragments._without([(1, 2), (4, 9)], given[0], 9, [], 0, lambda _: None)
        found["without"] = rest[0]
        for way in found.values():
            assert way[0].num_reg_images() == 9
            images = sorted(way[0].images.values(), key=lambda image: image.name)
            centres = np.stack([image.projection_center() for image in images])
            off = np.linalg.norm(centres - centres[0], axis=1)
            assert np.abs(off * extent.sum() / off.sum() - extent).max() < 0.03 * extent.max()
        return parts

    monkeypatch.setattr(video, "rejoined", check)
    placed = video.place_frames(chosen, room.camera, False, False, False, 0, lambda *_: None)
    assert placed.numbers == tuple(range(9))


def test_frames_that_few_points_place_have_no_pose():
    images = [Image("b", 15), Image("a", 200), Image("c", 14), Image("d", 90, False)]
    model = type("Model", (), {"images": dict(enumerate(images))})
    assert [image.name for image in placed_images(model)] == ["a", "b"]


@pytest.mark.system
def test_a_reconstruction_of_too_few_points_is_none(monkeypatch):
    pytest.importorskip("pycolmap")
    room = render_room(4, 3, 160, 120)
    frames = tuple(Frame(k, k / 10, image) for k, image in enumerate(room.images))
    chosen = ChosenFrames(frames, np.arange(4) / 10)
    monkeypatch.setattr(incremental_mapping, "LEAST_POINTS", 10**6)
    with pytest.raises(InputError, match="no three tell where they were taken"):
        video.place_frames(chosen, room.camera, True, False, False, 0, lambda *_: None)


def model_at(places: np.ndarray) -> Any:
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
        extent = fragments.extent_of(np.linalg.inv(T_cw))
        known = np.hypot(np.array(own)[[image.image_id for image in images]], 0.01 * extent)
        return known, np.zeros(len(images))

    monkeypatch.setattr(fragments, "pose_deviations", deviations)
    model = with_known_positions(model_at(places), is_known=False)
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
