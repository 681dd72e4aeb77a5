"""requirements.lock has the versions of constraints.txt, each with the hashes of its files."""

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
_PIN = re.compile(r"^([\w.-]+)==(\S+)", re.M)
_UNLOCKED = {"torch": "its build is chosen at the set-up", "uv": "it makes the lock"}


def _pins(file: str) -> dict[str, str]:
    found = _PIN.findall((ROOT / file).read_text())
    return {re.sub(r"[-_.]+", "-", name).lower(): version for name, version in found}


def test_the_lock_has_what_was_tested_and_nothing_else():
    tested = _pins("constraints.txt")
    assert _pins("requirements.lock") == {n: v for n, v in tested.items() if n not in _UNLOCKED}


def test_every_version_has_a_hash():
    blocks = re.split(r"\n(?=\S)", (ROOT / "requirements.lock").read_text().strip())
    pinned = [block for block in blocks if not block.startswith("#")]
    assert len(pinned) == len(_pins("requirements.lock")) > 50
    for block in pinned:
        assert re.search(r"--hash=sha256:[0-9a-f]{64}\b", block), block


def test_what_geogs_asks_for_is_locked():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    asked = project["dependencies"] + project["optional-dependencies"]["dev"]
    names = {re.match(r"[\w.-]+", one)[0].lower() for one in asked}
    assert names - _UNLOCKED.keys() <= _pins("requirements.lock").keys()
