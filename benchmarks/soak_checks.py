"""Checks of the soak on a folder of results."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import load_file

from geogs.application.results.saved_result import load_result
from geogs.errors import GeogsError
from json_schema import faults

SCHEMA = Path(__file__).parents[1] / "docs" / "summary.schema.json"
TABLES = ("trajectory.tum", "keyframes.tum")
MAP, MESH = "map.safetensors", "mesh.ply"


def wrong_in(out: Path) -> Iterator[str]:
    """Yield the faults of the files of a result."""
    for path in out.rglob("*"):
        if path.name.endswith((".part", ".lock")):
            yield f"{path.name} was left behind"
    try:
        summary = json.loads((out / "summary.json").read_text())
    except (OSError, ValueError) as error:
        yield f"no summary ({type(error).__name__})"
        return
    yield from (f"invalid summary: {said}" for said in faults(summary, _schema()))
    for name in TABLES:
        rows = np.loadtxt(out / name, ndmin=2)
        if not np.isfinite(rows).all():
            yield f"NaN in {name}"
    if summary["not_started"] is not None or not summary["disks"]:
        return
    try:
        result = load_result(out)  # fails for a map that is not finite
        mesh = result.mesh
    except GeogsError as error:
        yield str(error)
        return
    if not np.isfinite(result.views.T_cw).all():
        yield f"NaN in the poses of {MAP}"
    if mesh is not None and not (
        np.isfinite(mesh.vertices).all() and np.isfinite(mesh.normals).all()
    ):
        yield f"NaN in {MESH}"


def differences(twin: Path, out: Path) -> Iterator[str]:
    """Yield the differences between the results of an undisturbed and a disturbed run."""
    for name in (*TABLES, MESH, "config.yaml", "intrinsics.json"):
        one, other = (folder / name for folder in (twin, out))
        if one.is_file() != other.is_file():
            yield f"only one of the two has a {name}"
        elif one.is_file() and one.read_bytes() != other.read_bytes():
            yield f"{name} differs from that of the undisturbed run"
    if (twin / MAP).is_file() and (out / MAP).is_file():
        one, other = load_file(twin / MAP), load_file(out / MAP)
        if one.keys() != other.keys() or not all(torch.equal(one[n], other[n]) for n in one):
            yield f"{MAP} differs from that of the undisturbed run"


def _schema() -> object:
    return json.loads(SCHEMA.read_text())
