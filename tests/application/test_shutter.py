"""The shutter before a run: found, given or not to be told, and where it is written."""

import json
import signal
from pathlib import Path

import pytest

from geogs.application.calibrate import self_calibrated
from geogs.application.checkpoints.run_state import RunMetadata, SavedRun
from geogs.application.interrupt import Interruption
from geogs.application.results.summary import source_summary
from geogs.application.run_settings import RunSettings
from geogs.camera.shutter.shutter import FoundReadout, Shutter
from geogs.config import CalibrationConfig, Config, InputConfig
from geogs.io.sources.sniff import open_source
from geogs.io.writers.intrinsics_file import write_intrinsics
from geogs.tracking.calibration import self_calibration
from geogs.tracking.calibration.self_calibration import SelfCalibration
from geogs.tracking.calibration.unknowns import Unknowns
from io_samples import write_images
from progress_listener import Listener

INTRINSICS = "50,50,31.5,23.5"
FOUND = FoundReadout(0.0276, 0.0011)


@pytest.fixture
def folder(tmp_path) -> Path:
    return write_images(tmp_path / "images", [f"{k}.png" for k in range(4)])


def finding(monkeypatch, found: FoundReadout) -> list[Unknowns]:
    """A video that says this of its readout; what it is asked for."""
    asked = []

    def answer(frames, camera, unknowns, *rest):
        asked.append(unknowns)
        return SelfCalibration(camera, deviation=0.0, readout=found)

    monkeypatch.setattr(self_calibration, "self_calibrate", answer)
    return asked


def test_a_readout_that_is_found_is_said_and_written(folder, tmp_path, monkeypatch):
    asked = finding(monkeypatch, FOUND)
    listener = Listener()
    before = open_source(folder, InputConfig(INTRINSICS))
    source = self_calibrated(before, progress=listener)
    assert asked == [Unknowns(focal=False, rolling=before.rolling_camera)]
    assert (source.shutter.readout, source.shutter.error) == (0.0276, 0.0011)
    assert source.calibration == before.calibration
    assert listener.said == [
        "Rolling shutter: 27.6 +- 1.1 ms from the first to the last row; rows are rectified."
    ]
    write_intrinsics(tmp_path / "i.json", source.camera, source.calibration, source.shutter)
    said = json.loads((tmp_path / "i.json").read_text())["shutter"]
    assert said["readout"] == 0.0276
    assert said["origin"] == "the video says 27.6 +- 1.1 ms"
    assert source_summary(source)["shutter"] == said


def test_what_is_not_believed_leaves_the_shutter_global(folder, monkeypatch):
    finding(monkeypatch, FoundReadout(0.012, 0.009))
    listener = Listener()
    source = self_calibrated(open_source(folder, InputConfig(INTRINSICS)), progress=listener)
    assert listener.said == []
    assert source.shutter.readout == 0.0
    assert source.shutter.error == FoundReadout(0.012, 0.009).left_open
    assert not source.is_shutter_open
    finding(monkeypatch, FoundReadout())
    source = self_calibrated(open_source(folder, InputConfig(INTRINSICS)))
    assert source.shutter.origin == "could not be estimated from the video"


def test_what_is_given_is_not_looked_for(folder, monkeypatch):
    monkeypatch.setattr(self_calibration, "self_calibrate", pytest.fail)
    for given in (0.0, 0.02):
        source = open_source(folder, InputConfig(INTRINSICS, readout=given))
        assert self_calibrated(source) is source


def test_a_readout_that_nobody_uses_is_not_looked_for(folder, monkeypatch):
    asked = finding(monkeypatch, FOUND)
    given = open_source(folder, InputConfig(INTRINSICS))
    assert self_calibrated(given, finds_readout=False) is given
    assert not asked
    guessed = self_calibrated(open_source(folder), finds_readout=False)
    assert [(a.focal, a.readout) for a in asked] == [(True, None)]  # it would pass for a lens
    assert guessed.is_shutter_open


def test_a_lens_that_is_not_refined_is_unknown_while_the_readout_is_found(folder, monkeypatch):
    asked = finding(monkeypatch, FOUND)
    off = Config(calibration=CalibrationConfig(refine=False))
    listener = Listener()
    before = open_source(folder)
    source = self_calibrated(before, off, progress=listener)
    assert [(a.focal, a.radial, a.readout) for a in asked] == [(True, True, None)]
    assert source.calibration == before.calibration
    assert source.shutter.readout == 0.0276
    assert listener.said[0].startswith("warning: the intrinsics are unknown")


def test_several_videos_share_what_the_first_shows(folder, monkeypatch):
    finding(monkeypatch, FOUND)
    several = self_calibrated(open_source([folder, folder], InputConfig(INTRINSICS)))
    assert several.shutter.readout == 0.0276
    assert several.calibration == open_source(folder, InputConfig(INTRINSICS)).calibration


def test_ctrl_c_goes_on_with_a_global_shutter(folder, monkeypatch):
    def interrupted(frames, camera, unknowns, device, report, *masks):
        signal.raise_signal(signal.SIGINT)
        report(0.1)
        pytest.fail("the request was not heard")

    monkeypatch.setattr(self_calibration, "self_calibrate", interrupted)
    source, listener = open_source(folder, InputConfig(INTRINSICS)), Listener()
    assert self_calibrated(source, progress=listener, stop=Interruption()) is source
    assert "global shutter" in listener.said[0]


def test_a_resumed_run_has_the_shutter_it_began_with(folder):
    source = open_source(folder, InputConfig(INTRINSICS))
    settings = RunSettings((folder,), Config(input=InputConfig(INTRINSICS)))
    saved = SavedRun.__new__(SavedRun)
    saved.metadata = RunMetadata(
        settings, "cpu", source.fingerprint(), None, shutter=Shutter(0.02, "found")
    )
    assert saved.calibrated(source).shutter == Shutter(0.02, "found")
