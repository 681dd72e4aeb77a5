"""Report pages as a browser would read them."""

import base64
import hashlib
import re
from html.parser import HTMLParser

import pytest

from geogs.evaluation.pages.page import (
    HtmlSection,
    PictureSection,
    TableSection,
    TextSection,
    write_page,
)
from io_samples import empty_png


class Elements(HTMLParser):
    """Open tags in order, every attribute, and the text of each kind of element."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.stack: list[str] = []
        self.texts: list[tuple[str, str]] = []
        self.attributes: list[tuple[str, str | None]] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs) -> None:
        self.attributes += attrs
        if tag not in ("meta", "img"):
            self.stack.append(tag)

    def handle_endtag(self, tag) -> None:
        assert self.stack.pop() == tag

    def handle_data(self, data) -> None:
        if data.strip():
            self.texts.append((self.stack[-1], data))


def test_page_holds_everything_escaped_and_in_order(tmp_path):
    (tmp_path / "a b.png").write_bytes(b"png")
    (tmp_path / "runs").mkdir()
    page = tmp_path / "runs" / "index.html"
    write_page(
        page,
        "results of <room> & @body",
        [
            TableSection(
                "errors", ("scene", "Acc (cm)"), [("a<b", "1.25"), ("  c", "x")], "a note"
            ),
            PictureSection('mesh "from above"', tmp_path / "a b.png"),
            PictureSection("gone", tmp_path / "gone.png"),
            TextSection("settings", '{\n  "seed": 0\n}'),
        ],
        "one line",
    )
    text = page.read_text(encoding="utf-8")
    found = Elements(text)
    assert found.stack == []
    assert [t for tag, t in found.texts if tag == "h2"] == [
        "errors",
        'mesh "from above"',
        "settings",
    ]
    assert [t for tag, t in found.texts if tag == "td"] == ["a<b", "1.25", "  c", "x"]
    assert [t for tag, t in found.texts if tag == "th"] == ["scene", "Acc (cm)"]
    assert ("h1", "results of <room> & @body") in found.texts
    assert ("pre", '{\n  "seed": 0\n}') in found.texts
    assert ("p", "a note") in found.texts
    assert ("src", "../a%20b.png") in found.attributes
    assert ("alt", 'mesh "from above"') in found.attributes
    assert "gone" not in text
    assert "<script" not in text
    assert "http" not in text


def test_a_sentence_in_a_table_wraps_and_a_number_does_not(tmp_path):
    """Else it pushes the numbers of all other rows out of the page."""
    said = "the video: 437.8 +- 5.1 pixels, of 120 images and 3 rounds; the readout is 0.2 ms"
    write_page(tmp_path / "p.html", "t", [TableSection("", (), [("a", said), ("b", "1 234")])])
    text = (tmp_path / "p.html").read_text()
    assert f"<td class=long>{said}</td>" in text
    assert "<td>1 234</td>" in text
    (style,) = re.findall(r"td\.long \{(.*?)\}", text)
    assert "white-space: pre-wrap" in style
    assert "max-width" in style


def test_table_without_titles_has_no_head(tmp_path):
    write_page(tmp_path / "p.html", "t", [TableSection("", (), [("a", "1")])])
    text = (tmp_path / "p.html").read_text()
    assert "<thead>" not in text
    assert "<h2>" not in text


@pytest.mark.parametrize("size", [(40_000, 40_000), (12_000, 12_000)])
def test_a_picture_that_promises_more_than_it_holds_is_left_out_in_silence(tmp_path, capfd, size):
    (tmp_path / "bomb.png").write_bytes(empty_png(*size))
    page = tmp_path / "p.html"
    sections = [PictureSection("bomb", tmp_path / "bomb.png"), TextSection("rest", "here")]
    write_page(page, "t", sections, is_whole=True)
    text = page.read_text()
    assert "bomb" not in text
    assert "here" in text
    assert capfd.readouterr() == ("", "")


def test_a_whole_page_allows_its_own_scripts_and_nothing_else(tmp_path):
    script = "document.title = '<ü>'"
    sections = [
        HtmlSection(f"<script>{script}</script>", (script,)),
        TextSection("said", "<script>alert(1)</script>"),
    ]
    write_page(tmp_path / "p.html", "t", sections, is_whole=True)
    text = (tmp_path / "p.html").read_text(encoding="utf-8")
    (policy,) = re.findall(r'<meta http-equiv="Content-Security-Policy" content="([^"]*)">', text)
    assert policy.startswith("default-src 'none';")
    assert "http" not in policy
    assert text.index("<meta http-equiv") < text.index("<style")
    (found,) = re.findall(r"<script>(.*?)</script>", text, re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(found.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}';" in policy
    write_page(tmp_path / "p.html", "t", sections[1:], is_whole=True)
    assert "script-src 'none';" in (tmp_path / "p.html").read_text()
