"""Which clock true poses have: that of their own file, of a file beside them, or a count."""

from pathlib import Path

import numpy as np
import pytest

from geogs.evaluation.true_scene import read_true_scene

COUNT = 12
TIMES = np.arange(COUNT) * 0.1037 + 0.5


def matrices(columns: int) -> str:
    rows = np.tile(np.eye(4).ravel(), (COUNT, 1))
    rows[:, 3] = np.linspace(0, 2, COUNT)
    return "\n".join(" ".join(f"{x:.6f}" for x in row[:columns]) for row in rows)


def tum() -> str:
    return "\n".join(f"{t + 7:.4f} {k} 0 0 0 0 0 1" for k, t in enumerate(TIMES))


@pytest.mark.parametrize("columns", [12, 16])
@pytest.mark.parametrize("name", ["poses.txt", "00.txt", "truth.txt"])
def test_matrices_take_the_times_in_their_folder(tmp_path: Path, name: str, columns: int):
    (tmp_path / name).write_text(matrices(columns))
    counted = read_true_scene(tmp_path / name)
    assert np.allclose(counted.trajectory.timestamps, np.arange(COUNT) / 30)
    assert counted.clock.startswith("row k at k / 30 s")
    (tmp_path / "times.txt").write_text("\n".join(f"{t:e}" for t in TIMES))
    timed = read_true_scene(tmp_path / name)
    assert np.allclose(timed.trajectory.timestamps, TIMES)
    assert timed.clock == "times.txt of the sequence"
    assert np.allclose(timed.trajectory.T_wc, counted.trajectory.T_wc)


def test_the_sequence_of_that_name_comes_before_the_folder(tmp_path: Path):
    """A file of several sequences' poses lies beside the times of another one."""
    (tmp_path / "07.txt").write_text(matrices(12))
    (tmp_path / "times.txt").write_text("\n".join(f"{t + 100:e}" for t in TIMES))
    (tmp_path / "07").mkdir()
    (tmp_path / "07" / "times.txt").write_text("\n".join(f"{t:e}" for t in TIMES))
    assert np.allclose(read_true_scene(tmp_path / "07.txt").trajectory.timestamps, TIMES)


def test_rows_with_times_keep_their_own(tmp_path: Path):
    (tmp_path / "groundtruth.txt").write_text(tum())
    (tmp_path / "times.txt").write_text("\n".join(map(str, TIMES)))
    for path, clock in (
        (tmp_path / "groundtruth.txt", "its own times"),
        (tmp_path, "its own times (groundtruth.txt)"),
    ):
        scene = read_true_scene(path)
        assert np.allclose(scene.trajectory.timestamps, TIMES + 7)
        assert scene.clock == clock
