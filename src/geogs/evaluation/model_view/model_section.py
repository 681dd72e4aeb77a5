"""Page section with the interactive model: markup, data, library and script, all inline."""

import base64
import html
from importlib.resources import files

from geogs.evaluation.model_view.packed_model import pack, to_json
from geogs.evaluation.model_view.shown_model import ShownModel

SCRIPTS = (
    "unpack.js",
    "stage.js",
    "room.js",
    "surface.js",
    "disks.js",
    "cameras.js",
    "moving.js",
    "controls.js",
    "player.js",
    "measure.js",
    "main.js",
)
"""Scripts of the page, in the order in which they run; ``three.min.js`` comes before them."""


def model_section(model: ShownModel) -> tuple[str, tuple[str, str]]:
    """HTML of the model, and the scripts in it; it needs no other files, and a page may hold only
    one."""
    own = "\n".join(_file(name) for name in SCRIPTS)
    scripts = _file("three.min.js"), f"(() => {{\n'use strict';\n{own}\n}})();"
    scene, arrays, images = pack(model)
    notes = " ".join(model.notes)
    below = f"<p class=note>{html.escape(notes)}</p>" if notes else ""
    markup = "\n".join([
        f"<style>{_file('model.css')}</style>",
        _file("model.html"),
        below,
        f'<script type="application/json" id="model-scene">{to_json(scene)}</script>',
        _data("model-arrays", arrays),
        _data("model-images", images),
        *(f"<script>{script}</script>" for script in scripts),
    ])  # fmt: skip
    return markup, scripts


def _data(name: str, content: bytes) -> str:
    text = base64.b64encode(content).decode("ascii")
    return f'<script type="application/base64" id="{name}">{text}</script>'


def _file(name: str) -> str:
    place = files("geogs.evaluation.model_view").joinpath("browser", name)
    return place.read_text(encoding="utf-8")
