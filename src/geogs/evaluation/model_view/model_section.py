"""Page section with the interactive model: markup, library, script and the packed model, inline.

Its arrays are quantised, differenced and deflated.
The page's own script, ``browser/unpack.js``, undoes this. Lengths lose less than 1 / 65 535 of the
extent of their array; colours and triangles are lossless.
"""

import base64
import html
import json
import zlib
from dataclasses import asdict
from importlib.resources import files
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt

from geogs.evaluation.model_view.room import Room
from geogs.evaluation.model_view.shown_model import DiskModel, ShownModel, SurfaceModel
from geogs.evaluation.model_view.start_view import ASPECT, FIELD
from geogs.geometry.lie import matrix_to_quaternion, quaternion_multiply
from geogs.geometry.morton import morton_codes

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
STEPS = 65_535
"""Steps of a quantised coordinate."""
_STATES = ("tracked", "orientation only", "lost")


def model_section(model: ShownModel) -> tuple[str, tuple[str, str]]:
    """HTML of the model, and the scripts in it; it needs no other files, and a page may hold only
    one."""
    own = "\n".join(_file(name) for name in SCRIPTS)
    scripts = _file("three.min.js"), f"(() => {{\n'use strict';\n{own}\n}})();"
    scene, arrays, images = pack(model)
    notes = " ".join(model.notes)
    below = f"<p class=note>{html.escape(notes)}</p>" if notes else ""
    markup = "\n".join(
        [
            f"<style>{_file('model.css')}</style>",
            _file("model.html"),
            below,
            f'<script type="application/json" id="model-scene">{to_json(scene)}</script>',
            _data("model-arrays", arrays),
            _data("model-images", images),
            *(f"<script>{script}</script>" for script in scripts),
        ]
    )
    return markup, scripts


def _data(name: str, content: bytes) -> str:
    text = base64.b64encode(content).decode("ascii")
    return f'<script type="application/base64" id="{name}">{text}</script>'


def _file(name: str) -> str:
    place = files("geogs.evaluation.model_view").joinpath("browser", name)
    return place.read_text(encoding="utf-8")


def pack(model: ShownModel) -> tuple[dict[str, Any], bytes, bytes]:
    """Pack a model for a page: its directory (for JSON), the deflated arrays, and the JPEG images.

    All is in the axes of WebGL: x right, y up, z backward.
    """
    R = webgl_axes(model.axes)
    arrays = _Arrays()
    images = bytearray()
    scene: dict[str, Any] = {
        "start": {
            "eye": (R @ model.start.eye).tolist(),
            "target": (R @ model.start.target).tolist(),
            "field": FIELD,
            "aspect": ASPECT,
        },
        "lens": asdict(model.lens),
        "room": model.room and _room(model.room),
        "lengths": asdict(model.lengths),
    }
    if model.surface is not None:
        scene["surface"] = _surface(model.surface, R, arrays)
        if model.surface.texture is not None:
            scene["surface"]["texture"] = [0, len(model.surface.texture.jpeg)]
            images += model.surface.texture.jpeg
    scene["paths"] = [
        {
            "name": path.name,
            "points": arrays.add((path.points @ R.T).astype(np.float32).view(np.uint32)),
            "states": path.states
            and arrays.add(np.array([[_STATES.index(s)] for s in path.states], np.uint8)),
        }
        for path in model.paths
    ]
    scene["keyframes"] = []
    for keyframe in model.keyframes:
        T = np.eye(4)
        T[:3] = R @ keyframe.T_wc[:3]
        entry: dict[str, Any] = {"name": keyframe.name, "T_wc": T[:3].round(6).ravel().tolist()}
        if keyframe.jpeg is not None:
            entry["image"] = [len(images), len(keyframe.jpeg)]
            images += keyframe.jpeg
        scene["keyframes"].append(entry)
    if model.disks is not None:
        scene["disks"] = _disks(model.disks, R, arrays)
    return scene, zlib.compress(bytes(arrays.content), 6), bytes(images)


def _room(room: Room) -> dict[str, Any]:
    """Bounds in the axes of WebGL, whose z is backward; far away where there is none."""
    low, high = (np.clip(bound, -1e30, 1e30).tolist() for bound in (room.low, room.high))
    return {
        "low": [low[0], low[2], -high[1]],
        "high": [high[0], high[2], -low[1]],
        "ground": room.ground,
    }


def webgl_axes(axes: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """Rows right, up, backward, from rows right, forward, up."""
    return np.stack([axes[0], axes[2], -axes[1]])


def _surface(surface: SurfaceModel, R: np.ndarray, arrays: "_Arrays") -> dict[str, Any]:
    """Vertices in the order of a space-filling curve, and triangles in that of the vertices."""
    steps, box = quantised(surface.vertices @ R.T)
    order = np.argsort(morton_codes(steps, 16), kind="stable")
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    return {
        "box": box,
        "vertices": arrays.add(steps[order]),
        "faces": arrays.add(_face_differences(rank[surface.faces])),
        "normals": arrays.add(in_bytes(surface.normals @ R.T)[order]),
        "uv": surface.texture and arrays.add(_in_steps(surface.texture.uv)[order]),
        "colourings": [
            {
                "name": colouring.name,
                "colours": arrays.add(colouring.colours[order]),
                "legend": colouring.legend and asdict(colouring.legend),
            }
            for colouring in surface.colourings
        ],
    }


def _disks(disks: DiskModel, R: np.ndarray, arrays: "_Arrays") -> dict[str, Any]:
    steps, box = quantised(disks.position @ R.T)
    order = np.argsort(morton_codes(steps, 16), kind="stable")
    own = torch.from_numpy(disks.quaternion / _norm(disks.quaternion)).double()
    world = matrix_to_quaternion(torch.from_numpy(R)).expand_as(own)
    rotation = quaternion_multiply(world, own).numpy()
    rotation = np.where(rotation[:, :1] < 0, -rotation, rotation)
    logs = np.log(np.maximum(disks.scale, 1e-12))
    low, high = (float(f(logs)) if len(logs) else 0.0 for f in (np.min, np.max))
    scale = np.rint((logs - low) / max(high - low, 1e-9) * 255)
    return {
        "box": box,
        "position": arrays.add(steps[order]),
        "quaternion": arrays.add(in_bytes(rotation)[order]),
        "scale": arrays.add(scale.astype(np.uint8)[order]),
        "logs": [low, high],
    }


def in_bytes(units: Float[np.ndarray, "n k"]) -> UInt[np.ndarray, "n k"]:
    """Numbers from -1 to 1 as bytes, of which 128 is zero."""
    return np.rint(units * 127 + 128).astype(np.uint8)


def _in_steps(fractions: Float[np.ndarray, "n 2"]) -> UInt[np.ndarray, "n 2"]:
    """Numbers from 0 to 1 in steps of 1 / 65 535."""
    return np.rint(fractions.clip(0, 1) * STEPS).astype(np.uint16)


def quantised(
    points: Float[np.ndarray, "n 3"],
) -> tuple[UInt[np.ndarray, "n 3"], list[list[float]]]:
    """Points as steps of their box (uint16), and the box: least coordinates, length of a step."""
    if not len(points):
        return np.zeros((0, 3), np.uint16), [[0.0] * 3, [1.0] * 3]
    low, high = points.min(0).astype(np.float64), points.max(0).astype(np.float64)
    step = np.maximum(high - low, 1e-12) / STEPS
    steps = np.rint((points - low) / step).clip(0, STEPS).astype(np.uint16)
    return steps, [low.tolist(), step.tolist()]


def _face_differences(faces: Int[np.ndarray, "m 3"]) -> UInt[np.ndarray, "m 3"]:
    """Sort triangles by their first vertex; the other two become differences to it.

    The first is the least of the three, so that no difference is negative; the winding stays.
    """
    if not len(faces):
        return np.zeros((0, 3), np.uint32)
    first = faces.argmin(1)
    turned = faces[np.arange(len(faces))[:, None], (first[:, None] + np.arange(3)) % 3]
    turned = turned[np.lexsort((turned[:, 1], turned[:, 0]))]
    turned[:, 1:] -= turned[:, :1]
    return turned.astype(np.uint32)


class _Arrays:
    """Concatenated arrays: row differences, column by column, and for each column all lowest bytes
    first, then the next, for best compression."""

    def __init__(self) -> None:
        self.content = bytearray()

    def add(self, values: UInt[np.ndarray, "n c"]) -> list[int]:
        """Append an array of unsigned integers. Returns offset, rows, columns, bytes per number."""
        size = values.dtype.itemsize
        place = [len(self.content), *values.shape, size]
        kind = values.dtype.newbyteorder("<")
        for column in values.T:
            difference = np.diff(column, prepend=column.dtype.type(0)).astype(kind)
            # Zigzag: small negative steps become small numbers, too.
            signed = difference.view(kind.str.replace("u", "i")).astype(np.int64)
            zigzag = ((signed << 1) ^ (signed >> 63)).astype(kind)
            self.content += zigzag.view(np.uint8).reshape(-1, size).T.tobytes()
        return place


def _norm(rows: np.ndarray) -> np.ndarray:
    return np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-12)


def to_json(scene: dict[str, Any]) -> str:
    """The directory as JSON that is safe in a script element."""
    return json.dumps(scene, separators=(",", ":")).replace("<", "\\u003c")
