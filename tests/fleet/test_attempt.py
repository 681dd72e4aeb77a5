"""One attempt at one source, without Ray: what is fetched, delivered and said."""

import shutil
import sys
import uuid
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pytest

from disk_faults import full_disk
from geogs.application.checkpoints import folder as checkpoint_folder
from geogs.application.run_settings import RunSettings
from geogs_fleet import attempt as attempt_module
from geogs_fleet.attempt import LOG, FleetJob, attempt, judged
from geogs_fleet.child import THUMBNAIL, write_thumbnail
from geogs_fleet.sources import FleetSource
from geogs_fleet.storage import StoragePath
from geogs_fleet.supervise import Limits, ProcessEnd
from geogs_fleet.table import FILE, read_row

FAKE = (sys.executable, str(Path(__file__).with_name("fake_child.py")))


@pytest.fixture(autouse=True)
def scratch(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))


def job(source: str, output: str) -> FleetJob:
    return FleetJob(FleetSource(source, "clip"), output, RunSettings(), "d", Limits(), FAKE)


def test_results_here_have_their_row_last(tmp_path):
    (tmp_path / "clip.mp4").write_text("ok")
    row = attempt(job(str(tmp_path / "clip.mp4"), str(tmp_path / "out")))
    assert (row.state, row.sentence, row.is_reliable) == ("done", "Good: ok.", True)
    assert read_row((tmp_path / "out" / FILE).read_text()) == row


def test_two_attempts_at_a_time_leave_one_result(tmp_path):
    (tmp_path / "clip.mp4").write_text("steps 3")  # a node that was thought to be lost works on
    both = [job(str(tmp_path / "clip.mp4"), str(tmp_path / "out")) for _ in range(2)]
    with ThreadPoolExecutor(2) as pool:
        rows = list(pool.map(attempt, both))
    assert [row.state for row in rows] == ["done", "done"]
    left = read_row((tmp_path / "out" / FILE).read_text())
    assert left is not None
    assert (left.state, left.numbers) == ("done", rows[0].numbers)


def test_source_and_results_may_be_elsewhere(tmp_path):
    pytest.importorskip("fsspec", reason="fsspec is not installed")
    far = StoragePath(f"memory://{uuid.uuid4().hex}")
    (far / "clip.mp4").write("ok")
    row = attempt(job((far / "clip.mp4").address, (far / "out").address))
    assert row.state == "done"
    assert read_row((far / "out" / FILE).read()) == row
    assert {"summary.json", "run.log", FILE} <= set((far / "out").listed())
    assert not list(tmp_path.rglob("clip.mp4"))  # nothing stays on the node


def test_a_former_row_goes_before_the_work_begins(tmp_path):
    (tmp_path / "clip.mp4").write_text("fail Bad.")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / FILE).write_text("{}")
    row = attempt(job(str(tmp_path / "clip.mp4"), str(tmp_path / "out")))
    assert (row.state, row.sentence) == ("failed", "Bad.")
    assert not (tmp_path / "out" / FILE).exists()


def test_on_a_full_disk_no_row_says_that_it_is_done(tmp_path):
    (tmp_path / "clip.mp4").write_text("ok")
    out = tmp_path / "out"
    for n in range(20):
        shutil.rmtree(out, ignore_errors=True)
        with full_disk(out, n):
            row = attempt(job(str(tmp_path / "clip.mp4"), str(out)))
        if row.state == "done":
            break
        assert (row.state, "No space left" in row.sentence) == ("failed", True)
        assert not (out / FILE).exists()
    assert n >= 4
    assert (out / FILE).is_file()


def test_neither_log_nor_picture_is_written_through_a_link(tmp_path):
    (tmp_path / "precious").write_text("mine")
    (tmp_path / "clip.mp4").write_text("ok")
    out = tmp_path / "out"
    (out / "report").mkdir(parents=True)
    cv2.imwrite(str(out / "report" / "keyframes.png"), np.zeros((9, 9, 3), np.uint8))
    for name in (LOG, THUMBNAIL):
        (out / name).symlink_to(tmp_path / "precious")
    assert attempt(job(str(tmp_path / "clip.mp4"), str(out))).state == "failed"
    write_thumbnail(out)
    assert (tmp_path / "precious").read_text() == "mine"
    assert not (out / THUMBNAIL).is_symlink()


def test_a_source_that_is_gone_is_a_row():
    pytest.importorskip("fsspec", reason="fsspec is not installed")
    far = f"memory://{uuid.uuid4().hex}"
    row = attempt(job(f"{far}/none.mp4", f"{far}/out"))
    assert (row.state, "does not exist" in row.sentence) == ("failed", True)


@pytest.mark.parametrize(
    ("ending", "state", "said"),
    [
        (ProcessEnd(0, '{"state": "done", "sentence": ""}'), "done", ""),
        (ProcessEnd(0, '{"state": "failed", "sentence": "No."}'), "failed", "No."),
        (ProcessEnd(-11, ""), "crashed", "SIGSEGV"),
        (ProcessEnd(1, "nonsense"), "failed", "error of the program"),
        (ProcessEnd(-9, "", "time"), "failed", "longer than 1 min 30 s"),
        (ProcessEnd(-9, "", "memory"), "failed", "more than 2 GiB"),
    ],
)
def test_what_an_ending_means(ending, state, said):
    found, sentence = judged(ending, Limits(90.0, 2 << 30), "run.log")
    assert (found, said in sentence) == (state, True)


def test_the_name_of_the_manifest_is_that_of_checkpoints():
    assert attempt_module._MANIFEST == checkpoint_folder.MANIFEST


def test_a_checkpoint_elsewhere_moves_between_nodes_and_its_manifest_comes_last(tmp_path):
    pytest.importorskip("fsspec", reason="fsspec is not installed")
    far = StoragePath(f"memory://{uuid.uuid4().hex}")
    first = attempt_module.WorkFolder(far)
    (first.path / "checkpoint").mkdir()
    for name in ("manifest.json", "state-1.json", ".manifest.json.part"):
        (first.path / "checkpoint" / name).write_text(name)
    first.keep_checkpoint()
    assert set((far / "checkpoint").listed()) == {"manifest.json", "state-1.json"}
    (first.path / "checkpoint" / "state-1.json").unlink()
    second = attempt_module.WorkFolder(far)  # what is here gives way to what is there
    assert (second.path / "checkpoint" / "state-1.json").read_text() == "state-1.json"
