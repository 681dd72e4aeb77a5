"""The scripts and the notebook in examples/ run as they stand."""

import importlib.util
import json
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest

from geogs.config import Config, preset
from saved_results import make_result

EXAMPLES = Path(__file__).parents[1] / "examples"
NOTEBOOK = json.loads((EXAMPLES / "first_steps.ipynb").read_text())
SCRIPTS = sorted(EXAMPLES.glob("*.py"))


def script(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def quick(name: str) -> Config:
    """In place of a preset: few frames, little training."""
    c = preset(name)
    depth = replace(c.mapping.depth, planes=48)
    mapping = replace(c.mapping, render_long_edge=64, iterations=1, final_iterations=0, depth=depth)
    tracking = replace(c.tracking, init_keyframes=5)
    return replace(c, mapping=mapping, tracking=tracking, input=replace(c.input, stop=20))


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda p: p.stem)
def test_scripts_say_how_they_are_called(path):
    assert f"python examples/{path.name}" in path.read_text().split('"""')[1]
    assert 'if __name__ == "__main__":' in path.read_text()


def test_the_gallery_shows_results_and_nothing_else(tmp_path, monkeypatch, capsys):
    folder = make_result(tmp_path / "a <room>")
    summary = {"frames": 5, "mesh_faces": 12, "seconds": {"total": 3.2}}
    (folder / "summary.json").write_text(json.dumps(summary))
    (folder / "report").mkdir()
    (folder / "report" / "keyframes.png").write_bytes(b"a picture")
    (tmp_path / "no-result").mkdir()
    monkeypatch.setattr("sys.argv", ["gallery.py", str(folder), str(tmp_path / "no-result")])
    script("gallery").main()
    page = capsys.readouterr().out
    assert page.count("<article>") == 1
    assert "a &lt;room&gt;/report/keyframes.png" in page
    assert "5 images, 12 triangles, 3 s" in page
    assert "Poses were given." in page


def test_the_notebook_has_no_outputs():
    cells = [c for c in NOTEBOOK["cells"] if c["cell_type"] == "code"]
    assert all(c["outputs"] == [] and c["execution_count"] is None for c in cells)
    for cell in cells:
        compile("".join(cell["source"]), "first_steps.ipynb", "exec")


@pytest.mark.long
@pytest.mark.system
def test_the_notebook_and_the_scripts_run(small_room, tmp_path, monkeypatch, capsys):
    import matplotlib

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("geogs.config.preset", quick)
    matplotlib.use("Agg")
    (tmp_path / "room").symlink_to(small_room)
    names: dict[str, object] = {}
    for cell in NOTEBOOK["cells"]:
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), "first_steps.ipynb", "exec"), names)
    assert names["trajectory"].tracked.mean() > 0.9
    assert script("depth_of_a_view").main("first-steps") > 0.5
    assert (tmp_path / "depth.png").stat().st_size > 500

    rows = (small_room / "traj.txt").read_text().splitlines()
    write_poses(tmp_path / "poses.txt", rows)
    factor = script("metric_from_poses").main("room", "poses.txt")
    assert 0.5 < factor < 5
    said = capsys.readouterr().out
    assert "'used': True" in said


def write_poses(path: Path, matrices: list[str]) -> None:
    """Rows of TUM from those of Replica."""
    import numpy as np
    import torch

    from geogs.geometry.lie import matrix_to_quaternion

    lines = []
    for k, row in enumerate(matrices):
        T = np.array(row.split(), float).reshape(4, 4)
        w, x, y, z = matrix_to_quaternion(torch.from_numpy(T[:3, :3])).tolist()
        lines.append(" ".join(f"{v:.9f}" for v in (k / 30, *T[:3, 3], x, y, z, w)))
    path.write_text("\n".join(lines) + "\n")
