"""The examples of docs/api.md run as they stand."""

import re
from dataclasses import replace
from pathlib import Path

import pytest

from geogs.config import Config, InputConfig

PAGE = Path(__file__).parents[1] / "docs" / "api.md"
EXAMPLES = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
FRAMES = 26


def quick(name: str, on_gpu: bool = False) -> Config:
    """In place of a preset: few frames, little training."""
    c = Config()
    depth = replace(c.mapping.depth, planes=48)
    mapping = replace(
        c.mapping, render_long_edge=64, iterations=1, final_iterations=5, depth=depth,
        final_depth=False,
    )  # fmt: skip
    tracking = replace(c.tracking, init_keyframes=6)
    return replace(c, mapping=mapping, tracking=tracking, input=InputConfig(stop=FRAMES))


@pytest.mark.long
@pytest.mark.system
def test_the_examples_run_as_they_stand(small_room, tmp_path, monkeypatch, capsys):
    for place in ("geogs.config.preset", "geogs.application.run_in_python.preset_config"):
        monkeypatch.setattr(place, quick)
    room = tmp_path / "room"
    (room / "results").mkdir(parents=True)
    (room / "cam_params.json").symlink_to(small_room / "cam_params.json")
    for image in sorted((small_room / "results").glob("frame*.jpg"))[:FRAMES]:
        (room / "results" / image.name).symlink_to(image)
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for example in EXAMPLES:
        exec(compile(example, str(PAGE), "exec"), names)
    said = capsys.readouterr().out
    assert "give uint8 in 0..255" in said
    assert names["trajectory"].tracked.mean() > 0.9
    assert names["again"].trajectory().tracked.mean() > 0.9
    assert names["pose"] is names["live"].pose


def test_every_way_in_has_an_example():
    text = "".join(EXAMPLES)
    for name in (
        "track(",
        "Slam(",
        "process(",
        ".pose",
        "slam_mesh(",
        "render(",
        "save_slam(",
        "load_slam(",
    ):
        assert name in text
