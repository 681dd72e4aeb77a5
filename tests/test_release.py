"""A tag is let through where all files of a release name its version."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture
def release(tmp_path: Path) -> Path:
    """What a release of version 1.2.3 has."""
    for name, text in {
        ".github/check_tag.py": (ROOT / ".github/check_tag.py").read_text(),
        "src/geogs/version.py": '"""Doc."""\n\n__version__ = "1.2.3"\n',
        "CITATION.cff": "cff-version: 1.2.0\nversion: 1.2.3\n",
        "CHANGELOG.md": "## [Unreleased]\n\n## [1.2.3] - 2030-01-31\n\n## [1.2.2] - 2030-01-30\n",
    }.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path


def said(release: Path, tag: str) -> tuple[int, list[str]]:
    done = subprocess.run(
        [sys.executable, release / ".github/check_tag.py", tag], capture_output=True, text=True
    )
    return done.returncode, done.stderr.splitlines()


def test_a_tag_of_another_version_is_refused(release):
    assert said(release, "v1.2.3") == (0, [])
    code, lines = said(release, "v1.2.2")
    assert code == 1
    assert lines[-1] == "CHANGELOG.md has 1.2.3, the tag is v1.2.2."
    assert len(lines) == 3


def test_a_changelog_that_was_forgotten_is_told(release):
    (release / "CHANGELOG.md").write_text("## [Unreleased]\n")
    assert said(release, "v1.2.3") == (1, ["CHANGELOG.md has no version, the tag is v1.2.3."])


def test_the_sources_and_the_citation_have_one_version():
    code, lines = said(ROOT, "v0")
    assert code == 1
    assert lines[0].split()[2] == lines[1].split()[2]
