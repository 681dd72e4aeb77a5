"""Self-calibration before a run: from a source to its intrinsics.json."""

import json
import signal
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from geogs.application.calibrate import (
    lens_sentence,
    refined,
    self_calibrated,
    with_shutter_found,
)
from geogs.application.interrupt import Interruption
from geogs.camera.distortion import distorted_pixels
from geogs.camera.shutter import readout
from geogs.camera.shutter.readout import FoundReadout
from geogs.config import CalibrationConfig, Config, InputConfig
from geogs.io.sources.calibration import GUESS, Calibration
from geogs.io.sources.frame_source import Source
from geogs.io.sources.sniff import open_source
from geogs.io.writers.intrinsics_file import write_intrinsics
from geogs.tracking.calibration import self_calibration, stretch
from geogs.tracking.calibration.degeneracy import Degeneracy
from geogs.tracking.calibration.growing_bundle import PlacedViews
from geogs.tracking.calibration.self_calibration import SelfCalibration
from geogs.types import FoundLens
from progress_listener import Listener
from tracking_scenes import CAMERA, pose, render


@pytest.fixture(autouse=True)
def _few_keyframes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stretch, "START_KEYFRAMES", 8)
    monkeypatch.setattr(stretch, "KEYFRAMES", 12)


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
    assert "warning: the video does not tell its focal length: the camera hardly moves" in message
    assert "give --intrinsics" in message


def test_what_is_given_or_not_wanted_is_left_alone(video, monkeypatch):
    monkeypatch.setattr(self_calibration, "self_calibrate", pytest.fail)
    given = open_source(video, InputConfig(intrinsics="140,140,95.5,71.5"))
    assert self_calibrated(given, Config()) is given
    guessed = open_source(video)
    off = Config(calibration=CalibrationConfig(refine=False))
    assert self_calibrated(guessed, off) is guessed


def test_ctrl_c_goes_on_with_the_guess(video, monkeypatch):
    def interrupted(frames, camera, radial, device, report, *masks):
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
    """A video that tells one lens after the other, each relative to the one that its images were
    straightened by; then nothing."""

    def __init__(self, *lenses: tuple[float, float, float]) -> None:
        self.lenses = iter(lenses)
        self.rows: list[float] = []
        """Pixels by which rows were rectified at most, each time."""
        self.again: list[bool] = []
        """Whether the views of the round before were asked."""

    def __call__(self, frames, camera, radial, device, report, mask, black, before):
        self.rows.append(max(float(f.rows.offset.abs().max()) if f.rows else 0.0 for f in frames))
        self.again.append(before is not None)
        factor, k1, k2 = next(self.lenses, (0.0, 0.0, 0.0))
        if not factor:
            return SelfCalibration(camera, failure="it is a test")
        found = camera.with_focal(factor * camera.fx)
        views = PlacedViews((), [], [], [])
        return SelfCalibration(found, (k1, k2), 0.01, (0.01, 0.01), 12, 14, placed=views)


def asked(video: Path, monkeypatch, lens: Telling, **given) -> tuple[Source, Calibration]:
    """A video that tells so, calibrated, and what was assumed of it before."""
    monkeypatch.setattr(self_calibration, "self_calibrate", lens)
    before = open_source(video, InputConfig(**given))
    return self_calibrated(before, Config()), before.calibration


def test_the_lens_is_asked_of_rows_rectified_by_it_until_it_stays(video, monkeypatch):
    lens = Telling((0.8, -0.2, 0.05), (1.05, 0.04, -0.02), (1.005, 0.0, 0.0))
    found, before = asked(video, monkeypatch, lens, readout=0.03)
    after = found.calibration
    assert lens.again == [False, True, True]
    assert lens.rows[0] > 1
    assert abs(lens.rows[1] / lens.rows[0] - 1) > 0.05  # a lens that bends sees another turn
    assert after.fx == pytest.approx(0.8 * 1.05 * 1.005 * before.fx)
    assert after.focal_deviation == pytest.approx(0.01)
    # A ray that the last images show at x was seen by the first lens where all three put it.
    ray = np.array([[0.3, 0.2], [-0.5, 0.1], [0.0, -0.4]])
    seen = distorted_pixels(ray, after.camera(), after.distortion)
    for factor, k1, k2 in ((1.05 * 1.005, 0.04, -0.02), (1.0, -0.2, 0.05)):
        square = np.square(ray).sum(1, keepdims=True)
        ray = factor * ray * (1 + k1 * square + k2 * square**2)
    camera = before.camera().with_focal(0.8 * before.fx)
    np.testing.assert_allclose(seen, distorted_pixels(ray, camera, ()), atol=0.1)


def test_the_lens_of_a_global_shutter_is_asked_for_once(video, monkeypatch):
    lens = Telling((0.8, -0.2, 0.05))
    found, _ = asked(video, monkeypatch, lens, readout=0.0)
    assert lens.again == [False]
    assert found.calibration.distortion == pytest.approx((-0.2, 0.05, 0, 0), abs=1e-9)
    looked_for = []
    monkeypatch.setattr(
        readout, "find_readout", lambda *_: looked_for.append(0) or FoundReadout(0.0, 0.0, 0.001, 3)
    )
    found, _ = asked(video, monkeypatch, Telling((0.8, -0.2, 0.05)))
    assert len(looked_for) == 2  # by the guess, and by the lens
    assert with_shutter_found(found) is found


def test_of_a_lens_that_its_images_do_not_bear_out_any_is_asked(video, monkeypatch):
    lens = Telling((0.8, -0.2, 0.05), (0.0, 0.0, 0.0), (1.1, 0.0, 0.0), (1.0, 0.0, 0.0))
    found, before = asked(video, monkeypatch, lens, readout=0.03)
    assert lens.again == [False, True, False, True]
    assert found.calibration.fx == pytest.approx(0.88 * before.fx)


def test_what_is_told_once_is_kept_where_nothing_is_told_afterwards(video, monkeypatch):
    lens = Telling((0.8, -0.2, 0.05))
    found, before = asked(video, monkeypatch, lens, readout=0.03)
    assert lens.again == [False, True, False]
    assert found.calibration.fx == pytest.approx(0.8 * before.fx)
    assert found.calibration.refinement.failure is None


def test_what_was_found_at_working_size_is_carried_to_the_source():
    nominal = Calibration(
        1500.0, 1500.0, 959.5, 539.5, width=1920, height=1080, origin="EXIF", is_nominal=True
    )
    working = nominal.camera().with_long_edge(512)
    camera = replace(working, fx=1.1 * working.fx, fy=1.1 * working.fy)
    found = SelfCalibration(camera, (-0.08, 0.02), 0.01, (0.004, 0.003), 12, 80)
    after = refined(nominal, working.fx, found)
    assert after.fx == pytest.approx(1650.0)
    assert after.fy == pytest.approx(1650.0)
    assert after.distortion == (-0.08, 0.02, 0.0, 0.0)
    assert after.refinement is not None
    assert after.refinement.deviation == pytest.approx(16.5)
    assert after.refinement.deviations == (0.004, 0.003)
    assert after.is_unknown_lens
    assert not after.is_nominal
    assert "k1 -0.0800 +- 0.0040, k2 0.0200 +- 0.0030 (EXIF says 1500.0)" in after.origin


def test_a_lens_is_found_where_the_video_told_its_focal_length_and_nobody_how_it_bends():
    nominal = Calibration(600.0, 600.0, 319.5, 239.5, width=640, height=480, is_nominal=True)
    camera = replace(nominal.camera(), fx=630.0, fy=630.0)
    pinhole = SelfCalibration(camera, None, 0.01, None, 12, 80)
    nothing = replace(pinhole, failure="the camera stands still")
    bent = replace(nominal, distortion=(-0.1, 0.0, 0.0, 0.0))
    assert refined(nominal, 600.0, pinhole).is_found_lens
    assert not refined(nominal, 600.0, nothing).is_found_lens
    assert not refined(bent, 600.0, pinhole).is_found_lens
    assert not nominal.is_found_lens


def test_what_no_camera_explained_is_known_when_all_matches_found_a_lens():
    guess = Calibration(600.0, 600.0, 319.5, 239.5, width=640, height=480, is_guess=True)
    said = SelfCalibration(guess.camera(), failure=Degeneracy.UNEXPLAINED.value)
    turning = replace(said, failure=Degeneracy.TURNING.value)
    for found, is_explained in ((said, False), (turning, True)):
        before = refined(guess, 600.0, found)
        after = before.with_lens(FoundLens(-0.1, 0.02, 0.01, 0.01, 0.9, 0.05))
        assert after.refinement.failure is None
        assert before.refinement.is_explained == after.refinement.is_explained == is_explained
        moving = before.with_lens(FoundLens(0.0, 0.0, 0.01, 0.01, 0.9, 0.05, varies_centre=0.01))
        assert moving.refinement.is_explained


def test_a_focal_length_is_as_unsure_as_who_said_it():
    given = Calibration(600.0, 600.0, 319.5, 239.5, width=640, height=480)
    camera = replace(given.camera(), fx=630.0, fy=630.0)
    pinhole = SelfCalibration(camera, None, 0.05, None, 12, 80)
    nothing = replace(pinhole, failure="the camera stands still")
    guess = replace(given, is_guess=True)
    assert given.focal_deviation == replace(given, is_nominal=True).focal_deviation == 0
    assert refined(guess, 600.0, pinhole).focal_deviation == pytest.approx(0.05)
    assert refined(guess, 600.0, nothing).focal_deviation == guess.focal_deviation == GUESS


def test_a_focal_length_that_all_matches_find_takes_the_place_of_the_guess():
    guess = Calibration(200.0, 202.0, 159.5, 119.5, (), 320, 240, "auto", is_guess=True)
    found = FoundLens(0.1, -0.2, 0.002, 0.003, focal=0.95, deviation_focal=0.01)
    known = guess.with_lens(found)
    assert (known.fx, known.fy, known.is_guess) == (pytest.approx(190), pytest.approx(191.9), False)
    assert known.distortion == pytest.approx((0.1, -0.2, 0, 0), abs=1e-9)
    assert known.refinement is not None
    assert known.refinement.deviation == pytest.approx(1.9)
    said = lens_sentence(guess, found, known)
    assert "fx 190.0 +- 1.9 instead of 200.0, k1 0.1000 +- 0.0020" in said
    assert "--intrinsics 190,191.9,159.5,119.5,0.1,-0.2," in said
