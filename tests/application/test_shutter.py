"""The shutter before a run: found, given or not to be told, and where it is written."""

import json
import signal
from pathlib import Path

import pytest

from geogs.application.calibrate import with_shutter_found
from geogs.application.checkpoints.run_state import RunMetadata, SavedRun
from geogs.application.interrupt import Interruption
from geogs.application.results.summary import source_summary
from geogs.application.run_settings import RunSettings
from geogs.camera.shutter import readout
from geogs.camera.shutter.readout import FoundReadout
from geogs.camera.shutter.shutter import Shutter
from geogs.config import Config, InputConfig
from geogs.io.sources.sniff import open_source
from geogs.io.writers.intrinsics_file import write_intrinsics
from io_samples import write_images
from progress_listener import Listener

INTRINSICS = "50,50,31.5,23.5"
FOUND = FoundReadout(0.0276, 0.0276, 0.0011, 12)


@pytest.fixture
def folder(tmp_path) -> Path:
    return write_images(tmp_path / "images", [f"{k}.png" for k in range(4)])


def finding(monkeypatch, found: FoundReadout) -> None:
    monkeypatch.setattr(readout, "find_readout", lambda clips, camera, report, lens: found)


def test_a_readout_that_is_found_is_said_and_written(folder, tmp_path, monkeypatch):
    finding(monkeypatch, FOUND)
    listener = Listener()
    source = with_shutter_found(open_source(folder, InputConfig(INTRINSICS)), listener)
    assert (source.shutter.readout, source.shutter.error) == (0.0276, 0.0011)
    assert listener.said == [
        "Rolling shutter: 27.6 ms from the first to the last row (12 clips say 27.6 ms, "
        "standard error 1.1 ms); rows are rectified."
    ]
    write_intrinsics(tmp_path / "i.json", source.camera, source.calibration, source.shutter)
    said = json.loads((tmp_path / "i.json").read_text())["shutter"]
    assert said["readout"] == 0.0276
    assert said["origin"].startswith("found in the video: 12 clips")
    assert source_summary(source)["shutter"] == said


def test_what_is_not_believed_leaves_the_shutter_global(folder, monkeypatch):
    finding(monkeypatch, FoundReadout(0.0, 0.012, 0.009, 8))
    listener = Listener()
    source = with_shutter_found(open_source(folder, InputConfig(INTRINSICS)), listener)
    assert listener.said == []
    assert source.shutter.readout == 0.0
    assert source.shutter.error == FoundReadout(0.0, 0.012, 0.009, 8).left_open
    assert not source.is_shutter_open
    finding(monkeypatch, FoundReadout())
    source = with_shutter_found(open_source(folder, InputConfig(INTRINSICS)))
    assert source.shutter.origin == "the video does not tell"


def test_what_is_given_is_not_looked_for(folder, monkeypatch):
    monkeypatch.setattr(readout, "find_readout", pytest.fail)
    for given in (0.0, 0.02):
        source = open_source(folder, InputConfig(INTRINSICS, readout=given))
        assert with_shutter_found(source) is source


def test_several_videos_share_what_the_first_shows(folder, monkeypatch):
    finding(monkeypatch, FOUND)
    several = with_shutter_found(open_source([folder, folder], InputConfig(INTRINSICS)))
    assert several.shutter.readout == 0.0276
    assert several.calibration == open_source(folder, InputConfig(INTRINSICS)).calibration


def test_ctrl_c_goes_on_with_a_global_shutter(folder, monkeypatch):
    def interrupted(clips, camera, report, lens_is_known):
        signal.raise_signal(signal.SIGINT)
        report(0.1)
        pytest.fail("the request was not heard")

    monkeypatch.setattr(readout, "find_readout", interrupted)
    source, listener = open_source(folder, InputConfig(INTRINSICS)), Listener()
    assert with_shutter_found(source, listener, Interruption()) is source
    assert "global shutter" in listener.said[0]


def test_a_resumed_run_has_the_shutter_it_began_with(folder):
    source = open_source(folder, InputConfig(INTRINSICS))
    settings = RunSettings((folder,), Config(input=InputConfig(INTRINSICS)))
    saved = SavedRun.__new__(SavedRun)
    saved.metadata = RunMetadata(
        settings, "cpu", source.fingerprint(), None, shutter=Shutter(0.02, "found")
    )
    assert saved.calibrated(source).shutter == Shutter(0.02, "found")
