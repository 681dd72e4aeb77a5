"""The soak itself: what it does to processes, and what it finds in results."""

import argparse
import random
import shutil
import signal
import sys
import time

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

import soak
from soak_checks import differences
from soak_process import Ending, TimeIsUp, ended

SLEEPS = [sys.executable, "-c", "import time; print('begun', flush=True); time.sleep(900)"]
ENDS = [sys.executable, "-c", "import os, sys; sys.exit(int(os.environ['OMP_NUM_THREADS']))"]


def test_a_process_that_ends_by_itself_is_not_hit():
    ending = ended(ENDS, time.monotonic() + 600, signal.SIGKILL, 500.0, "3")
    assert (ending.code, ending.was_hit) == (3, False)


def test_a_process_is_hit_after_a_while():
    ending = ended(SLEEPS, time.monotonic() + 600, signal.SIGTERM, 0.1)
    assert (ending.code, ending.was_hit, ending.hangs) == (-signal.SIGTERM, True, False)
    assert ending.seconds < 500


def test_a_process_at_the_end_of_the_soak_is_ended():
    begin = time.monotonic()
    with pytest.raises(TimeIsUp):
        ended(SLEEPS, begin + 0.2)
    assert time.monotonic() - begin < 500


@pytest.mark.parametrize(
    ("ending", "wrong"),
    [
        (Ending(0, "", 1.0), []),
        (Ending(2, "error: no.", 1.0), []),
        (Ending(3, "a\nb", 1.0), ["ended with 3: b"]),
        (Ending(0, "Traceback\nKeyError", 1.0), ["ended with 0: KeyError"]),
        (Ending(-9, "", 1.0, hangs=True), ["it hangs"]),
    ],
)
def test_what_is_wrong_with_an_ending(ending, wrong):
    assert list(ending.wrong((0, 2))) == wrong


def test_two_results_are_compared_to_the_last_bit(tmp_path):
    one, other = tmp_path / "one", tmp_path / "other"
    one.mkdir()
    for name in ("trajectory.tum", "keyframes.tum", "config.yaml", "intrinsics.json", "mesh.ply"):
        (one / name).write_text("1 2 3\n")
    save_file({"position": torch.zeros(2, 3)}, one / "map.safetensors", {"seconds": "1"})
    shutil.copytree(one, other)
    save_file({"position": torch.zeros(2, 3)}, other / "map.safetensors", {"seconds": "2"})
    assert list(differences(one, other)) == []
    save_file({"position": torch.full((2, 3), 1e-7)}, other / "map.safetensors")
    (other / "keyframes.tum").write_text("1 2 4\n")
    (other / "mesh.ply").unlink()
    said = " ".join(differences(one, other))
    assert "keyframes.tum differs" in said
    assert "map.safetensors differs" in said
    assert "only one of the two has a mesh.ply" in said


def test_a_round_whose_disturbed_run_is_another_is_a_fault(tmp_path, monkeypatch):
    """With processes that only pretend."""

    def pretended(command, end, number=None, after=0.0, threads="1"):
        words = [str(word) for word in command]
        if "run" in words:
            out = tmp_path / "round-0" / ("twin" if words[-1].endswith("twin") else "out")
            out.mkdir(exist_ok=True)
            np.savetxt(out / "trajectory.tum", [[float(out.name == "out")]])
        return Ending(0, "", 1.0)

    monkeypatch.setattr(soak, "ended", pretended)
    monkeypatch.setattr(soak, "wrong_in", lambda out: [])
    monkeypatch.setattr(
        soak, "differences",
        lambda a, b: ["differs"] * (
            (a / "trajectory.tum").read_bytes() != (b / "trajectory.tum").read_bytes()
        ),
    )  # fmt: skip
    options = argparse.Namespace(minutes=1.0, seed=0, workers=1, size=(16, 12), frames=(3, 4))
    one = soak.Soak(options, tmp_path)
    assert one._round(tmp_path / "round-0", random.Random(0)) == ["differs"]
    assert one.report.compared == 1
    assert one.report.runs == 3
