"""``map.safetensors``: the disks, ten numbers each, and what is needed to look at them again."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from geogs.errors import InputError
from geogs.io.writers.atomic import atomic_file
from geogs.types import MapSnapshot

FORMAT_VERSION = 1
"""Raised when older programs could not read the file any more."""

_SHAPES = {"position": (3,), "quaternion": (4,), "scale": (2,), "opacity": ()}


@dataclass(frozen=True)
class MapFile:
    """All that a map's file holds."""

    disks: MapSnapshot
    tensors: dict[str, Tensor]
    """What else there is, on the CPU."""
    metadata: dict[str, Any]


def save_map(
    path: str | Path,
    disks: MapSnapshot,
    metadata: Mapping[str, Any] = {},
    tensors: Mapping[str, Tensor] = {},
) -> None:
    """Write the disks in float32.

    Args:
        path: the file.
        disks: the map.
        metadata: anything JSON can hold, kept beside the disks.
        tensors: more to keep beside them, by names that the disks do not use.
    """
    own = {name: getattr(disks, name).detach().cpu().float().contiguous() for name in _SHAPES}
    more = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    header = {
        "format": "geogs-map",
        "version": str(FORMAT_VERSION),
        "metadata": json.dumps(dict(metadata)),
    }
    with atomic_file(path) as stream:
        stream.write(save({**more, **own}, metadata=header))


def load_map(path: str | Path, device: torch.device | str = "cpu") -> MapSnapshot:
    """Read the disks of a map.

    Raises:
        InputError: the file is missing, damaged, no map, of a newer version, or holds NaN.
    """
    return load_map_file(path, device).disks


def load_map_file(path: str | Path, device: torch.device | str = "cpu") -> MapFile:
    """Read the disks of a map and what lies beside them.

    Raises:
        InputError: as of ``load_map``.
    """
    with _open(path) as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        metadata = _metadata(path, (file.metadata() or {}).get("metadata", "{}"))
    count = len(tensors["position"]) if "position" in tensors else 0
    for name, shape in _SHAPES.items():
        if name not in tensors or tensors[name].shape != (count, *shape):
            raise InputError(f"{path} is no map of geogs: its {name} is missing or misshapen.")
    disks = MapSnapshot(**{name: tensors.pop(name).to(device) for name in _SHAPES})
    if not disks.is_finite():
        raise InputError(f"{path} holds NaN or infinity; the map is damaged.")
    return MapFile(disks, tensors, metadata)


def _metadata(path: str | Path, text: str) -> dict[str, Any]:
    try:
        said = json.loads(text)
    except (ValueError, RecursionError):
        said = None
    if not isinstance(said, dict):
        raise InputError(f"{path} is damaged: what it says of itself cannot be understood.")
    return said


def _open(path: str | Path) -> "safe_open":
    if not Path(path).is_file():
        raise InputError(f"The map {path} does not exist.")
    try:
        file = safe_open(str(path), framework="pt")
    except (SafetensorError, OSError) as error:
        raise InputError(f"{path} is no map of geogs, or is damaged.") from error
    header = file.metadata() or {}
    if header.get("format") != "geogs-map":
        raise InputError(f"{path} is no map of geogs.")
    version = header.get("version", "")
    if not (version.isascii() and version.isdigit() and len(version) < 9):
        raise InputError(f"{path} is damaged: it does not say of which version it is.")
    if int(version) > FORMAT_VERSION:
        raise InputError(f"{path} was written by a newer geogs; update this one to read it.")
    return file
