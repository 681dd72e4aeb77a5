"""What a run that lost its camera ends with: one command, that can be typed as it stands."""

import shlex
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from geogs.application import remedy as module
from geogs.application.remedy import RECORD_AGAIN, WITHOUT_STABILISATION, remedy
from geogs.application.results.verdict import Verdict
from geogs.application.run_settings import RunSettings
from geogs.cli.run import parse
from geogs.config import Config, InputConfig, preset
from geogs.extras import install_command
from geogs.geometry.camera import Camera
from geogs.io.sources.frame_source import Source

GOOD = Verdict(True, "Reliable.", 0.0, 0.0, 0.01, 0.1, 0.02)
LOST = replace(GOOD, is_reliable=False, lost=0.3)
VIDEO = RunSettings((Path("my video.mp4"),))


def source(is_live: bool = False, focal_deviation: float = 0.0) -> Source:
    names = {"is_live": is_live, "uses_depth": False, "uses_poses": False}
    made = type("Some", (Source,), names)
    one = made.__new__(made)
    one.length, one.fps = 150, 30.0
    one.calibration = SimpleNamespace(focal_deviation=focal_deviation)
    one.camera = Camera(300.0, 300.0, 159.5, 119.5, 320, 240)
    return one


@pytest.fixture
def photos(monkeypatch):
    return lambda there: monkeypatch.setattr(module, "has_pycolmap", lambda: there)


def test_a_good_result_needs_none(photos):
    photos(False)
    assert remedy(VIDEO, source(), GOOD, 90.0) == ""


def test_where_structure_from_motion_was_not_tried_it_is_named(photos):
    photos(False)
    said = remedy(VIDEO, source(), LOST, 90.0)
    install = install_command("photos")
    assert said.startswith(f"{install} && geogs run 'my video.mp4' --sfm ")
    photos(True)
    said = remedy(replace(VIDEO, fallback=False), source(), LOST, 90.0)
    assert said.startswith("geogs run 'my video.mp4' --sfm locates")
    metric = replace(VIDEO, scale_from="height:1.6")
    assert remedy(metric, source(), None).startswith("geogs run 'my video.mp4' --sfm")


@pytest.mark.parametrize(
    ("settings", "focal_deviation", "said"),
    [
        (
            VIDEO,
            0.09,
            "If you know the focal length: geogs run 'my video.mp4' --intrinsics fx,fy,cx,cy, in a",
        ),
        (VIDEO, 0.0, RECORD_AGAIN),
        (replace(VIDEO, sfm=True), 0.0, RECORD_AGAIN),
        (replace(VIDEO, map=Path("old")), 0.0, " makes a map of its own, in about 1 min 30"),
    ],
)
def test_where_it_was_tried_the_next_is(photos, settings, focal_deviation, said):
    photos(True)
    assert said in remedy(settings, source(focal_deviation=focal_deviation), LOST, 90.0)


def test_structure_from_motion_is_not_named_where_depths_are_what_is_not_known(photos):
    photos(False)
    flat = replace(GOOD, is_reliable=False, depth=0.29)
    assert remedy(VIDEO, source(), flat, 90.0) == RECORD_AGAIN
    assert " --intrinsics fx,fy,cx,cy" in remedy(VIDEO, source(False, 0.09), flat, 90.0)


def test_of_a_camera_the_recording_helps(photos):
    photos(True)
    assert "geogs run RECORDING" in remedy(VIDEO, source(is_live=True), LOST, 90.0)


def test_the_command_keeps_what_was_given(photos):
    photos(True)
    given = InputConfig(intrinsics="500,500,320,240", start=5, stop=90, stride=3)
    settings = replace(VIDEO, config=replace(preset("fast"), input=given))
    command, _, rest = remedy(settings, source(), LOST, 90.0).partition(" takes every")
    assert rest.startswith(" frame, in about 4 min 30 s")
    options = parse(shlex.split(command)[2:])
    assert options.source == VIDEO.source
    assert options.config.mapping == preset("fast").mapping
    assert options.config.input.intrinsics == given.intrinsics
    assert Config().input.stride == 1


def test_a_lens_that_changes_is_not_mended_by_a_setting(photos):
    photos(False)
    stabilised = replace(LOST, lost=0.0, lens_varies=True)
    assert remedy(VIDEO, source(False, 0.09), stabilised, 90.0) == WITHOUT_STABILISATION
    lost = replace(LOST, lens_varies=True)
    assert "--sfm" in remedy(VIDEO, source(False, 0.09), lost, 90.0)
