"""Agisoft Metashape: the XML of "Export cameras", beside the images.

A camera's matrix maps its axes (x right, y down, z forward) into the chunk, whose unit and axes
are kept. The first pixel's centre is (0.5, 0.5); cx and cy count from the middle of the image. P1
and P2 are OpenCV's p2 and p1, and B1 is fx - fy.
https://www.agisoft.com/pdf/metashape-pro_2_1_en.pdf, appendix "Camera models".
"""

import math
from collections import Counter
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from jaxtyping import Float64

from geogs.guard.documents import read_xml
from geogs.io.sources.account import Account, named
from geogs.io.sources.calibration import Calibration
from geogs.io.sources.formats.listed_views import (
    SizedCamera,
    View,
    brown_lens,
    check_neglected,
    find_file,
    posed_set,
    refused,
    understood,
)
from geogs.io.sources.posed.posed_set import PosedSet

_OFF = ("", "0", "false", "none", "disabled")
"""Values of what is switched off."""
_FISHEYES = ("fisheye", "equidistant_fisheye")


def find_metashape(path: Path) -> Path | None:
    """The file in a folder, or none; ``path`` may be the file."""
    return find_file(path, ("*.xml",), b"<document", b"<chunk", b"<sensor")


def open_metashape(file: Path) -> PosedSet:
    """Read the aligned and enabled cameras of the chunk, and of its component, that has most.

    Raises:
        InputError: there are none, or the file cannot be understood.
    """
    with understood(file, "export the cameras again"):
        chunks = sorted(read_xml(file).iter("chunk"), key=lambda c: len(_aligned(c)), reverse=True)
        chunk = chunks[0]
        sensors = {sensor.get("id"): _sensor(sensor, file) for sensor in chunk.iter("sensor")}
        aligned = _aligned(chunk)
        parts = Counter(camera.get("component_id") for camera in aligned).most_common()
        used = [c for c in aligned if c.get("component_id") == parts[0][0]] if parts else []
        views = [View(_label(c), _pose(c), sensors[c.get("sensor_id")]) for c in used]
        off = [_label(camera) for camera in _cameras(chunk, is_on=False)]
        without = [_label(c) for c in _cameras(chunk) if c.find("transform") is None]
    smaller = [f"{len(_aligned(other))} images of a chunk" for other in chunks[1:]]
    smaller += [f"{count} images of a component" for _, count in parts[1:]]
    rolls = any("rolling_shutter" in e.tag and _text(e) not in _OFF for e in chunk.iter())
    reasons = (
        (off, f"{len(off)} cameras that are disabled in {file} ({named(off)})"),
        (smaller, f"smaller parts of {file}: {named(smaller)}"),
        (rolls, f"the rolling shutter in {file}: images are taken as exposed at once"),
    )
    account = Account(left=tuple(sentence for found, sentence in reasons if found))
    return posed_set("metashape", file, views, without, account)


def _cameras(chunk: Element, is_on: bool = True) -> list[Element]:
    """The cameras that are switched on, or those that are not."""
    every = chunk.iterfind("cameras//camera")
    return [c for c in every if (c.get("enabled", "true").lower() not in _OFF) == is_on]


def _aligned(chunk: Element) -> list[Element]:
    return [camera for camera in _cameras(chunk) if camera.find("transform") is not None]


def _label(camera: Element) -> str:
    return camera.attrib["label"]


def _text(element: Element | None) -> str:
    return ((element.text or "") if element is not None else "").strip().lower()


def _pose(camera: Element) -> Float64[np.ndarray, "4 4"]:
    numbers = [float(word) for word in _text(camera.find("transform")).split()]
    return np.linalg.inv(np.array(numbers).reshape(4, 4))


def _sensor(sensor: Element, file: Path) -> SizedCamera | None:
    """The camera of a sensor: adjusted, else as it was before; none where nothing is stated."""
    stated = sensor.findall("calibration")
    adjusted = [entry for entry in stated if entry.get("class") == "adjusted"]
    if not stated:
        return None
    entry = (adjusted or stated)[-1]
    kind = entry.get("type", sensor.get("type", "frame"))
    if kind != "frame" and kind not in _FISHEYES:
        return refused(f"a sensor of type {kind}", file)
    if entry.find("fx") is not None:
        return refused("cameras of PhotoScan before 1.2", file)
    resolution = [*entry.iter("resolution"), *sensor.iter("resolution")][0]
    size = int(resolution.attrib["width"]), int(resolution.attrib["height"])
    names = ["f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4"]
    terms = {name: float(entry.findtext(name, "0")) for name in names}
    return lambda width, height: _calibration(terms, size, kind in _FISHEYES, file)


def _calibration(
    terms: dict[str, float], size: tuple[int, int], is_fisheye: bool, file: Path
) -> Calibration:
    f = terms["f"]
    focal = f + terms["b1"], f
    centre = size[0] / 2 + terms["cx"] - 0.5, size[1] / 2 + terms["cy"] - 0.5
    radial = tuple(terms[name] for name in ("k1", "k2", "k3", "k4"))
    corner = math.hypot(*size) / 2 / f if f else math.inf
    tangential = 3 * f * corner**2 * max(abs(terms["p1"]), abs(terms["p2"]))
    shifts = {"b2": terms["b2"] * size[1] / 2 / f}
    if is_fisheye:
        shifts["p1, p2"] = tangential
    else:
        shifts["p3, p4"] = tangential * corner**2 * (abs(terms["p3"]) + abs(terms["p4"]))
    account = check_neglected(shifts, file)
    origin = str(file)
    if is_fisheye:
        return Calibration(
            *focal, *centre, radial, *size, origin=origin, lens="fisheye", account=account
        )
    return brown_lens(focal, centre, radial, (terms["p2"], terms["p1"]), size, origin, account)
