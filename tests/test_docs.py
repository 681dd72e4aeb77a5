"""What the texts name is there: files, and settings by their options."""

import re
import shlex
from itertools import chain
from pathlib import Path

import pytest

from geogs.application.export.region import read_region
from geogs.application.result_settings import ExportSettings, LocateSettings, RescaleSettings
from geogs.cli.options import parse_options
from geogs.config import Config, ReconstructConfig
from geogs.config.leaves import leaves

ROOT = Path(__file__).parents[1]
PAGES = "*.md", "docs/*.md", "docs/notebook/*.md", "benchmarks/README.md"
TEXTS = sorted(chain.from_iterable(map(ROOT.glob, PAGES)))


@pytest.mark.parametrize("text", TEXTS, ids=lambda text: text.stem)
def test_files_that_a_text_names_exist(text: Path) -> None:
    words = text.read_text()
    code = set(re.findall(r"`([\w./*-]+\.(?:py|cuh?))`", words))
    links = set(re.findall(r"\]\(([\w./-]+\.(?:md|png))", words))
    missing = {name for name in code if not _is_there(name)}
    missing |= {link for link in links if not (text.parent / link).is_file()}
    assert missing == set()


@pytest.mark.parametrize("text", TEXTS, ids=lambda text: text.stem)
def test_headings_that_a_text_leads_to_exist(text: Path) -> None:
    links = re.findall(r"\]\(([\w./-]+\.md|)#([^)\s]+)\)", text.read_text())
    pages = {name: text.parent / name if name else text for name, _ in links}
    missing = {f"{name}#{at}" for name, at in links if at not in _headings(pages[name])}
    assert missing == set()


def _headings(page: Path) -> set[str]:
    """As the links to them are written."""
    titles = re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def _is_there(name: str) -> bool:
    return any(ROOT.glob(name)) or any(
        any((ROOT / folder).glob(f"**/{name}")) for folder in ("src", "benchmarks", "tests")
    )


_COMMANDS = {"export": ExportSettings, "locate": LocateSettings, "scale": RescaleSettings}
LINES = sorted(
    {
        line.split("#")[0].strip()
        for text in (*TEXTS, *(ROOT / "docs/tutorials").glob("*.md"))
        for line in re.findall(r"^geogs (?:export|locate|scale) .*$", text.read_text(), re.M)
    }
)


@pytest.mark.parametrize("line", LINES)
def test_commands_on_results_are_understood_as_they_stand(line: str) -> None:
    _, command, *arguments = shlex.split(line)
    options = parse_options(_COMMANDS[command], arguments, command)
    if command == "export":
        read_region(options.crop)


def test_settings_that_the_texts_name_exist() -> None:
    known = list(chain(leaves(Config, "run"), leaves(ReconstructConfig, "reconstruct")))
    options = {option for leaf in known for option in (*leaf.options, leaf.switch_off)}
    groups = {option.split(".")[0] for option in options if "." in option}
    named = set()
    for text in TEXTS:
        named |= set(re.findall(r"--[a-z]+(?:\.[a-z0-9-]+)+", text.read_text()))
    assert {n for n in named if n.split(".")[0] in groups} <= options
    assert len(named) > 10
