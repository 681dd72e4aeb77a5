"""Records of arrays in files for the exchange between jobs of a join, as in checkpoints."""

import json
from pathlib import Path
from typing import TypeVar

from safetensors import safe_open
from safetensors.torch import save_file

from geogs.guard.documents import require_file
from geogs.world.pack import pack, unpack

R = TypeVar("R")


def write_record(path: Path, record: object) -> None:
    """Write a record, see :mod:`geogs.world.pack`."""
    packed = pack(type(record), record)
    save_file(packed.arrays, path, {"values": json.dumps(packed.values)})


def read_record(kind: type[R], path: Path) -> R:
    """Read a record of this kind that ``write_record`` wrote."""
    with safe_open(require_file(path), "pt") as file:
        arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        record: R = unpack(kind, json.loads(file.metadata()["values"]), arrays, {})
    return record
