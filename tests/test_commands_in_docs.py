"""The commands of the README and of the tutorials are taken as they stand, and lead on."""

import importlib
import re
import shlex
from dataclasses import replace
from pathlib import Path

import cv2
import pytest

from geogs.cli import reconstruct, run
from geogs.cli.command import find_command
from geogs.cli.main import main
from geogs.config import Config, ReconstructConfig, preset, reconstruct_preset
from io_samples import write_video

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs" / "tutorials").glob("*.md"))]
COUNT = 20
"""Images of the small video and scene."""


def commands(page: Path) -> list[list[str]]:
    """The commands in the fenced blocks of a page, as a shell splits them."""
    blocks = re.findall(r"^```\w*\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL)
    lines = [line for block in blocks for line in block.splitlines()]
    words = [shlex.split(line, comments=True) for line in lines]
    return [[some[0].removeprefix(".venv/bin/"), *some[1:]] for some in words if some]


def geogs_commands(page: Path) -> list[list[str]]:
    return [words[1:] for words in commands(page) if words[0] == "geogs"]


class Taken(Exception):
    """The options of a command were read."""


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_command_is_taken_without_a_word_on_names(page, monkeypatch, caplog):
    for name, *rest in geogs_commands(page):
        if rest[:1] == ["join"]:  # of geogs fleet, which hands on
            continue
        module = importlib.import_module(find_command(name).module)
        read = module.parse_options

        def parse(*arguments: object, read=read) -> None:
            read(*arguments)
            raise Taken

        monkeypatch.setattr(module, "parse_options", parse)
        with pytest.raises(Taken):
            module.main(rest)
        monkeypatch.undo()
        assert not caplog.messages, (name, rest)


@pytest.fixture
def place(small_room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a video and a scene of the names that the pages use; work is done quickly."""
    names = sorted((small_room / "results").glob("frame*"))[: 2 * COUNT : 2]
    pictures = [cv2.imread(str(name))[..., ::-1] for name in names]
    write_video(tmp_path / "video.mp4", pictures)
    (tmp_path / "project").symlink_to(small_room)

    def quick(name: str, on_gpu: bool = False) -> Config:
        c = preset(name)
        depth = replace(c.mapping.depth, planes=48, engine="classical")
        mapping = replace(c.mapping, render_long_edge=64, final_iterations=10, depth=depth)
        tracking = replace(c.tracking, init_keyframes=5, fine_adjustment=False)
        calibration = replace(c.calibration, refine=False)
        return replace(c, mapping=mapping, tracking=tracking, calibration=calibration)

    def quick_posed(name: str) -> ReconstructConfig:
        c = reconstruct_preset(name)
        reading = replace(c.input, stride=4)
        search = replace(c.search, least_steps=10, most_steps_per_view=2, repeat=False)
        return replace(c, input=reading, search=search)

    monkeypatch.setattr(run, "preset", quick)
    monkeypatch.setattr(reconstruct, "reconstruct_preset", quick_posed)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.system
@pytest.mark.long  # two runs and a reconstruction: a minute
@pytest.mark.parametrize("name", ["README.md", "docs/tutorials/colmap.md"])
def test_a_page_runs_as_it_stands(place: Path, name: str, capsys):
    for command, *words in commands(ROOT / name):
        if command == "xdg-open":
            assert Path(words[0]).is_file(), words
        if command != "geogs" or words[0] == "doctor" or "--sfm" in words:
            continue
        assert main(words) in (0, 3), (words, capsys.readouterr().err)
    assert not list(place.glob("**/*.mp4/"))
