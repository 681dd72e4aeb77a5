"""What programs get wrong is said in a sentence, before anything is computed or written."""

import inspect
from copy import copy
from dataclasses import replace

import numpy as np
import pytest
import torch

import geogs
from geogs.config import preset, reconstruct_preset
from geogs.config.arguments import checks_arguments
from geogs.errors import InputError
from geogs.slam_input import input_frame, require_mask
from geogs.types import MeasuredPose

CAMERA = geogs.Camera(80.0, 80.0, 47.5, 35.5, 96, 72)
IMAGE = np.zeros((72, 96, 3), np.uint8)
NAN = float("nan")

own_input_frame = inspect.unwrap(input_frame)
"""Without the tests' own check of types."""


def altered(record, **fields):
    """A copy of a record with other values in its fields, of whatever type."""
    other = copy(record)
    for name, value in fields.items():
        object.__setattr__(other, name, value)
    return other


CALLS = {
    "a device that is a number": (lambda: geogs.Slam(CAMERA, device=3), "device"),
    "a preset for a configuration": (lambda: geogs.Slam(CAMERA, "fast"), "Config or none"),
    "settings of another command": (lambda: geogs.Slam(CAMERA, geogs.ReconstructConfig()), "Conf"),
    "a matrix for a camera": (lambda: geogs.Slam(np.eye(3)), "give Camera"),
    "a mask of numbers": (lambda: require_mask(np.ones((72, 96)), CAMERA), "bool, 72 x 96"),
    "a mask on its side": (lambda: geogs.Slam(CAMERA, mask=np.ones((96, 72), bool)), "72 x 96"),
    "a dictionary for a world": (lambda: geogs.Slam(CAMERA, world={}), "World or none"),
    "no source": (lambda: geogs.run(None), "source is NoneType"),
    "a source among others that is none": (lambda: geogs.run(["a.mp4", 3]), "source is list"),
    "an unknown preset": (lambda: geogs.run("a.mp4", preset="slow"), "'slow'; give default or"),
    "a preset beside settings": (
        lambda: geogs.run("a.mp4", geogs.Config(), preset="fast"),
        "leave out either config or preset",
    ),
    "a folder that is a number": (lambda: geogs.run("a.mp4", output=3), "output is 3"),
    "a function for a progress": (lambda: geogs.run("a.mp4", progress=print), "RunProgress"),
    "a preset that there is not": (lambda: preset("slow"), "fast or accurate or paper"),
    "a preset in capitals": (lambda: reconstruct_preset("Fast"), "fast or accurate or paper"),
    "a system that is none": (lambda: geogs.track("a.mp4", slam="x"), "Slam or none"),
    "a map from nowhere": (lambda: geogs.load_map(None), "a text or a path"),
    "a result from nowhere": (lambda: geogs.load_result(7), "a text or a path"),
    "a budget in words": (lambda: geogs.reconstruct("a", budget="2m"), "a number or none"),
    "poses in another way": (lambda: geogs.reconstruct("a", poses="found"), "given or auto"),
    "something else to save": (lambda: geogs.save_slam(IMAGE, "map"), "slam is ndarray"),
    "something else with a mesh": (lambda: geogs.slam_mesh(None), "slam is NoneType"),
    "input settings of another kind": (lambda: geogs.open_source("a", {}), "InputConfig or none"),
    "too wide a view": (lambda: CAMERA.with_field_of_view(180.0), "180 degrees"),
}  # fmt: skip


@pytest.mark.parametrize("call", CALLS)
def test_wrong_calls_are_a_sentence(call, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    wrong, words = CALLS[call]
    with pytest.raises(InputError, match=words) as error:
        wrong()
    assert "\n" not in str(error.value)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("field", ["fx", "fy", "cx", "cy", "k1", "k2", "width", "height"])
@pytest.mark.parametrize("value", [0, -67.0, NAN, float("inf"), None, "525"])
def test_there_is_no_camera_with_numbers_that_are_none(field, value):
    if field in ("cx", "cy", "k1", "k2") and value in (0, -67.0):
        assert getattr(replace(CAMERA, **{field: float(value)}), field) == value
        return
    with pytest.raises(InputError, match=f"There is no camera with .*{value}"):
        altered(CAMERA, **{field: value}).__post_init__()


@pytest.mark.parametrize(
    "numbers",
    [{"fx": 1e-9, "fy": 1e-9}, {"fx": 1e12, "fy": 1e12}, {"fx": 1.0}, {"fy": 1e5}, {"cx": -1e4}],
)
def test_a_camera_that_no_lens_makes_is_refused(numbers):
    with pytest.raises(InputError, match=r"No lens|far outside"):
        geogs.Slam(replace(CAMERA, **numbers), device="cpu")


IMAGES = {
    "float": IMAGE / 255,
    "grey": IMAGE[..., 0],
    "four channels": np.zeros((72, 96, 4), np.uint8),
    "channels first": np.zeros((3, 72, 96), np.uint8),
    "another size": np.zeros((96, 72, 3), np.uint8),
    "a list": IMAGE.tolist(),
    "none": None,
    "a path": "image.png",
    "a float tensor": torch.zeros(72, 96, 3, requires_grad=True),
}
FRAMES = {
    "an index in words": {"index": "first"},
    "a time that is no number": {"timestamp": NAN},
    "a time in words": {"timestamp": "1.0"},
    "a matrix for a pose": {"pose": np.eye(4)},
    "a pose that is none": {"pose": MeasuredPose(torch.full((4, 4), NAN).double())},
    "an array for a depth": {"depth": np.zeros((72, 96))},
    "a mask of another size": {"mask": np.ones((36, 48), bool)},
    "a number for rows": {"rows": 3},
}


@pytest.mark.parametrize("image", IMAGES.values(), ids=IMAGES)
@pytest.mark.parametrize("in_a_frame", [False, True])
def test_other_images_are_refused_also_in_frames(image, in_a_frame):
    given = altered(geogs.Frame(0, 0.0, IMAGE), image=image) if in_a_frame else image
    with pytest.raises(InputError):
        own_input_frame(given, None, CAMERA, 0, None)


@pytest.mark.parametrize("fields", FRAMES.values(), ids=FRAMES)
def test_other_fields_of_frames_are_refused(fields):
    with pytest.raises(InputError):
        own_input_frame(altered(geogs.Frame(0, 0.0, IMAGE), **fields), None, CAMERA, 0, None)


@pytest.mark.parametrize("time", [NAN, float("-inf"), "2", [2.0], 1.0, 0.5, True])
@pytest.mark.parametrize("in_a_frame", [False, True])
def test_times_are_numbers_and_increase(time, in_a_frame):
    given = altered(geogs.Frame(1, 2.0, IMAGE), timestamp=time) if in_a_frame else IMAGE
    with pytest.raises(InputError, match="time"):
        own_input_frame(given, None if in_a_frame else time, CAMERA, 1, 1.0)


@pytest.mark.parametrize("time", [np.float32(2), np.int64(2), 2])
def test_numbers_of_other_kinds_are_times(time):
    assert own_input_frame(IMAGE, time, CAMERA, 1, 1.0).timestamp == 2.0
    given = altered(geogs.Frame(1, 2.0, IMAGE), index=np.int64(1), timestamp=time)
    frame = own_input_frame(given, None, CAMERA, 1, 1.0)
    assert type(frame.timestamp) is float


@checks_arguments
def called(path: str | None, *, number: float = 1.0, count: int = 1, more: object = None) -> str:
    """Do nothing."""
    return f"{path} {number} {count} {more}"


def test_what_fits_is_handed_on_and_the_signature_stays():
    assert called(None, number=np.float64(2), count=np.int16(3), more={}) == "None 2.0 3 {}"
    assert list(inspect.signature(called).parameters) == ["path", "number", "count", "more"]
    assert called.__doc__ == "Do nothing."
    with pytest.raises(InputError, match=r"called: count is True; give a whole number\."):
        called("a", count=True)
    with pytest.raises(TypeError, match="missing a required argument: 'path'"):
        called()
