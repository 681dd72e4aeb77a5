"""See whether a tag is the version that the files of a release name: check_tag.py v1.2.3."""

import re
import sys
from pathlib import Path

_NAMED = {
    "src/geogs/version.py": r'^__version__ = "(.+)"$',
    "CITATION.cff": r"^version: (.+)$",
    "CHANGELOG.md": r"^## \[(\d.*)\] - \d{4}-\d\d-\d\d$",
}
"""Where the version stands; in the changelog the newest comes first."""


def wrong(tag: str, root: Path) -> list[str]:
    """A sentence for each file that names another version."""
    said = []
    for name, form in _NAMED.items():
        found = re.search(form, (root / name).read_text(encoding="utf-8"), re.M)
        version = found[1] if found else "no version"
        if f"v{version}" != tag:
            said.append(f"{name} has {version}, the tag is {tag}.")
    return said


if __name__ == "__main__":
    sys.exit("\n".join(wrong(sys.argv[1], Path(__file__).parents[1])) or None)
