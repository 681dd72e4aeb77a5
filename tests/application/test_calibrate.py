"""Self-calibration before a run: from a source to its intrinsics.json."""

import json
import signal
from pathlib import Path

import cv2
import numpy as np
import pytest

from geogs.application.calibrate import self_calibrated
from geogs.application.interrupt import Interruption
from geogs.config import CalibrationConfig, Config, InputConfig
from geogs.io.sources.sniff import open_source
from geogs.io.writers.intrinsics_file import write_intrinsics
from geogs.tracking.calibration import self_calibration
from geogs.tracking.calibration.self_calibration import SelfCalibration
from geogs.tracking.calibration.unknowns import Unknowns
from progress_listener import Listener
from tracking_scenes import CAMERA, pose, render


@pytest.fixture(autouse=True)
def _few_keyframes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(self_calibration, "START_KEYFRAMES", 8)
    monkeypatch.setattr(self_calibration, "KEYFRAMES", 12)


def write_images(folder: Path, poses: list[np.ndarray]) -> Path:
    """A folder of images of the rendered room, about which nothing else is known."""
    folder.mkdir()
    for k, T in enumerate(poses):
        cv2.imwrite(str(folder / f"{k:03d}.png"), render(T)[0][..., ::-1])
    return folder


@pytest.fixture(scope="module")
def video(tmp_path_factory) -> Path:
    path = [pose(-0.5 + 0.04 * k, 0.05 * np.sin(0.5 * k), 0.0, 0.35 * np.sin(0.3 * k))
            for k in range(14)]  # fmt: skip
    return write_images(tmp_path_factory.mktemp("calibration") / "video", path)


def written(source, folder: Path) -> dict:
    write_intrinsics(folder / "intrinsics.json", source.camera, source.calibration)
    return json.loads((folder / "intrinsics.json").read_text())


def test_intrinsics_json_holds_the_deviation(video, tmp_path, capfd):
    listener = Listener()
    source = self_calibrated(open_source(video), Config(), progress=listener)
    document = written(source, tmp_path)
    of_source = document["source"]
    deviation = of_source["focal_deviation"]
    assert abs(of_source["fx"] - CAMERA.fx) < 2.5 * deviation
    assert 0.002 * CAMERA.fx < deviation < 0.05 * CAMERA.fx
    assert of_source["is_guess"] is False
    assert of_source["self_calibration"]["failure"] is None
    assert document["fx"] == pytest.approx(of_source["fx"])
    said = f"refined from the video: {of_source['fx']:.1f} +- {deviation:.1f} pixels"
    for name, k in zip(("k1", "k2"), of_source["distortion"], strict=False):
        assert abs(k) < 2.5 * of_source[f"{name}_deviation"]  # a pinhole
        said += f", {name} {k:.4f} +- {of_source[f'{name}_deviation']:.4f}"
    assert of_source["origin"] == f"{said} (a field of view of 60 degrees was assumed)"
    assert source.intrinsics_origin == of_source["origin"]
    assert listener.said == [f"Intrinsics: {source.intrinsics_origin}."]
    assert listener.stages == {"calibration"}
    assert capfd.readouterr() == ("", "")
    frames = list(source)
    assert [f.index for f in frames] == list(range(14))


def test_a_camera_that_stands_still_leaves_the_guess(tmp_path):
    before = open_source(write_images(tmp_path / "still", [pose(0.0)] * 4))
    listener = Listener()
    source = self_calibrated(before, Config(), progress=listener)
    of_source = written(source, tmp_path)["source"]
    assert source.camera == before.camera
    assert of_source["is_guess"] is True
    assert of_source["focal_deviation"] is None
    assert of_source["self_calibration"]["failure"] == "the camera hardly moves"
    assert "the camera hardly moves" in source.intrinsics_origin
    (message,) = listener.said
    assert (
        "warning: the focal length could not be estimated before the run: the camera hardly"
        in message
    )
    assert "give --intrinsics" in message


def test_what_is_given_or_not_wanted_is_left_alone(video, monkeypatch):
    monkeypatch.setattr(self_calibration, "self_calibrate", pytest.fail)
    given = open_source(video, InputConfig(intrinsics="140,140,95.5,71.5", readout=0.0))
    assert self_calibrated(given, Config()) is given
    guessed = open_source(video, InputConfig(readout=0.0))
    off = Config(calibration=CalibrationConfig(refine=False))
    assert self_calibrated(guessed, off) is guessed


def test_ctrl_c_goes_on_with_the_guess(video, monkeypatch):
    def interrupted(frames, camera, unknowns, device, report, *masks):
        signal.raise_signal(signal.SIGINT)
        report(0.1)
        pytest.fail("the request was not heard")

    monkeypatch.setattr(self_calibration, "self_calibrate", interrupted)
    source = open_source(video)
    listener = Listener()
    assert self_calibrated(source, Config(), progress=listener, stop=Interruption()) is source
    (said,) = listener.said
    assert said.startswith("Calibration stopped")
    with pytest.raises(KeyboardInterrupt):  # of a caller who has no way to stop
        self_calibrated(source, Config())


class Telling:
    """A video that tells a lens, or nothing."""

    def __init__(self, *lens: float) -> None:
        self.lens = lens
        self.squeeze = 1.0
        self.asked: list[Unknowns] = []
        self.rectified: list[bool] = []
        """Whether rows were rectified before."""

    def __call__(self, frames, camera, unknowns, *rest):
        self.rectified.append(any(frame.rows is not None for frame in frames))
        self.asked.append(unknowns)
        if not self.lens:
            return SelfCalibration(camera, failure="it is a test")
        factor, *bend = self.lens
        found = camera.with_focal(factor * camera.fx)
        return SelfCalibration(found, tuple(bend), 0.01, (0.01, 0.01), 12, 14, squeeze=self.squeeze)


@pytest.mark.parametrize(
    ("given", "rolls", "readout"),
    [({}, True, None), ({"readout": 0.03}, True, 0.03), ({"readout": 0.0}, False, 0.0)],
)
def test_the_lens_is_asked_once_of_rows_as_they_came(video, monkeypatch, given, rolls, readout):
    lens = Telling(0.8, -0.2, 0.05)
    monkeypatch.setattr(self_calibration, "self_calibrate", lens)
    before = open_source(video, InputConfig(**given))
    found = self_calibrated(before, Config())
    rolling = before.rolling_camera if rolls else None
    assert lens.asked == [Unknowns(True, True, rolling, readout)]
    assert lens.rectified == [False]
    assert found.calibration.fx == pytest.approx(0.8 * before.calibration.fx)
    assert found.calibration.distortion == pytest.approx((-0.2, 0.05, 0, 0), abs=1e-9)
    assert found.calibration.focal_deviation == pytest.approx(0.01)
    assert found.shutter.readout == (readout or 0.0)
    assert found.is_shutter_open is False
    lens.squeeze = 0.75
    squeezed = self_calibrated(before, Config()).calibration
    assert squeezed.fx == found.calibration.fx
    assert squeezed.fy == pytest.approx(0.75 * found.calibration.fy)
    assert "fy / fx 0.750" in squeezed.origin
    lens.lens = ()
    failed = self_calibrated(before, Config())
    assert failed.calibration.fx == before.calibration.fx
    assert failed.calibration.refinement.failure == "it is a test"
