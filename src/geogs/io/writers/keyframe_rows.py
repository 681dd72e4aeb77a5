"""``keyframes/rows.safetensors``: where and when a rolling shutter saw what keyframes show."""

from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save

from geogs.documents import UNUSABLE
from geogs.errors import InputError
from geogs.io.writers.atomic import atomic_file
from geogs.types import SeenRows


def rows_path(folder: Path) -> Path:
    """Where the rows of keyframes lie in the folder of a result, if any were rectified."""
    return folder / "keyframes" / "rows.safetensors"


def write_rows(path: Path, rows: Mapping[int, SeenRows]) -> None:
    """Write the rows of keyframes, by id; all are of one size. Raises OutputError."""
    seen = list(rows.values())
    tensors = {
        "keyframe_id": torch.tensor(list(rows)),
        "offset": torch.stack([r.offset for r in seen]).cpu().half(),
        "seconds": torch.stack([r.seconds for r in seen]).cpu().half(),
        "doubt": torch.tensor([r.doubt for r in seen], dtype=torch.float64),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(path) as stream:
        stream.write(save(tensors))


def read_rows(path: Path) -> dict[int, SeenRows]:
    """Read what ``write_rows`` wrote; nothing where there is no file.

    Raises:
        InputError: the file is damaged.
    """
    if not path.is_file():
        return {}
    try:
        tensors = load_file(path)
        ids, doubt = tensors["keyframe_id"].long(), tensors["doubt"].double()
        offset, seconds = tensors["offset"].half(), tensors["seconds"].half()
        if seconds.ndim != 3 or offset.shape != (*seconds.shape, 2):
            raise ValueError("it has no rows and columns")
        if not ids.shape == doubt.shape == seconds.shape[:1]:
            raise ValueError("its keyframes differ in number")
        if not all(bool(torch.isfinite(t).all()) for t in (offset, seconds, doubt)):
            raise ValueError("it holds NaN or infinity")
    except (SafetensorError, OSError, *UNUSABLE) as error:
        raise InputError(f"{path} is damaged; delete it to go without.") from error
    return {
        id: SeenRows(offset[n], seconds[n], float(doubt[n])) for n, id in enumerate(ids.tolist())
    }
