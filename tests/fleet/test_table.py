"""Rows, their order, the page, and the time that is left."""

import json

import pytest

from geogs_fleet.fleet_progress import Pace
from geogs_fleet.storage import StoragePath
from geogs_fleet.table import Row, read_row, row_text, write_table

ROWS = [
    Row("good", "/s/good.mp4", "done", "Fine.", "d", True, 3.0, 1, "n", {"lost": 0.0}),
    Row("lost", "/s/lost.mp4", "done", "Fine.", "d", True, 3.0, 1, "n", {"lost": 0.1}),
    Row("doubt", "/s/doubt.mp4", "done", "Not sure.", "d", False),
    Row("<b>", '/s/"x".mp4', "failed", "No & no.", "d"),
]


def test_trouble_comes_first_and_all_text_is_escaped(tmp_path):
    write_table(StoragePath(str(tmp_path)), ROWS, 2, 10.0)
    document = json.loads((tmp_path / "fleet.json").read_text())
    assert [row["name"] for row in document["sources"]] == ["<b>", "doubt", "lost", "good"]
    assert (document["done"], document["failed"], document["waiting"]) == (3, 1, 2)
    page = (tmp_path / "index.html").read_text()
    assert "&lt;b&gt;" in page
    assert "<b>" not in page
    assert "No &amp; no." in page
    assert 'title="/s/&quot;x&quot;.mp4"' in page
    assert 'src="good/thumbnail.webp"' in page


@pytest.mark.parametrize("text", [None, "", "[]", "{}", '{"name": 3}'])
def test_a_row_comes_back_and_a_damaged_one_is_none(text):
    assert read_row(row_text(ROWS[0])) == ROWS[0]
    assert read_row(text) is None


def test_time_left_is_that_between_two_ends():
    now = iter([0.0, 10.0, 20.0, 30.0])
    pace = Pace(4, 2, lambda: next(now))
    assert pace.after_one(10.0) == (3, 15.0)  # two at a time, 10 s each
    assert pace.after_one(20.0) == (2, 20.0)
    assert pace.after_one(20.0) == (1, 10.0)
