"""The page on the settings is the one that the code makes."""

from pathlib import Path

from geogs.config import Config, ReconstructConfig
from geogs.config.leaves import leaves
from settings_page import document

PAGE = Path(__file__).parents[2] / "docs" / "configuration.md"


def test_the_page_is_that_of_the_code():
    assert PAGE.read_text() == document(), "python tests/settings_page.py > docs/configuration.md"


def test_every_setting_has_a_row_with_its_default_its_range_and_its_meaning():
    rows = [line for line in document().splitlines() if line.startswith(("| `", "| **`"))]
    known = {leaf.name: leaf for leaf in (*leaves(ReconstructConfig()), *leaves(Config()))}
    text = "\n".join(rows)
    for name, leaf in known.items():
        assert leaf.help, name
        assert f"`{name}`" in text
    assert "| `loop.close-every` | `5` | a whole number from 1 to 1000000 | Keyframes" in text
    assert "| `mapping.photo.per-step` | `2`, `4` in `reconstruct` | a whole number from 1" in text
    assert "| `mapping.final-depth` | `on` | `on` | `off` | `on` | `on` |" in text
    explained = [row for row in rows if " only) |" in row]
    lag = next(row for row in explained if row.startswith("| `mapping.lag`"))
    assert lag.endswith("(`run` only) |")
    opacity = next(row for row in explained if row.startswith("| `mapping.disk.opacity`"))
    assert opacity.endswith("(Python only) |")
