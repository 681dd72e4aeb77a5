"""A training run on disk: one safetensors file with its settings in the header, no pickles."""

import json
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from geogs.errors import InputError
from geogs.guard.atomic import atomic_file
from geogs.guard.documents import UNUSABLE, in_short
from geogs_train.network_trainer import NetworkTrainer

FILE = "checkpoint.safetensors"
T = TypeVar("T")
_PARTS = ("network", "mean", "first_moment", "second_moment")


def save_checkpoint(trainer: NetworkTrainer, out: Path) -> None:
    """Write the state of the run; the previous checkpoint stays until the new one is complete.

    Raises:
        OutputError: it cannot be written.
    """
    names = [name for name, _ in trainer.network.named_parameters()]
    moments = trainer.optimizer.state_dict()["state"]
    parts = {
        "network": trainer.network.state_dict(),
        "mean": trainer.mean.state_dict(),
        "first_moment": {names[k]: v["exp_avg"] for k, v in moments.items()},
        "second_moment": {names[k]: v["exp_avg_sq"] for k, v in moments.items()},
    }
    tensors = {
        f"{part}/{name}": x.detach().cpu().contiguous()
        for part, some in parts.items()
        for name, x in some.items()
    }
    header = {
        "step": str(trainer.step),
        "progress": repr(trainer.progress),
        "options": json.dumps(asdict(trainer.options)),
    }
    with atomic_file(out / FILE) as stream:
        stream.write(save(tensors, metadata=header))


def read_options(out: Path, kind: type[T]) -> T:
    """Read the settings of the run in a folder. Raises InputError if it has none of this kind."""
    header, _ = _read(out, with_tensors=False)
    try:
        return _revived(kind, json.loads(header["options"]))
    except UNUSABLE as error:
        reason = in_short(error)
        raise InputError(f"The checkpoint in {out} is of another network ({reason}).") from error


def load_checkpoint(trainer: NetworkTrainer, out: Path) -> None:
    """Restore a checkpoint. Raises InputError if there is none or it is damaged."""
    header, tensors = _read(out, with_tensors=True)
    step = int(header["step"])
    names = [name for name, _ in trainer.network.named_parameters()]
    parts = {
        part: {k.partition("/")[2]: x for k, x in tensors.items() if k.startswith(f"{part}/")}
        for part in _PARTS
    }
    trainer.network.load_state_dict(parts["network"])
    trainer.mean.load_state_dict(parts["mean"])
    optimizer = trainer.optimizer.state_dict()
    if parts["first_moment"]:
        optimizer["state"] = {
            k: {
                "step": torch.tensor(float(step)),
                "exp_avg": parts["first_moment"][name],
                "exp_avg_sq": parts["second_moment"][name],
            }
            for k, name in enumerate(names)
        }
    trainer.optimizer.load_state_dict(optimizer)
    trainer.step = step
    trainer.progress = float(header["progress"])


def _revived(kind: type[T], values: dict[str, Any]) -> T:
    """Restore a dataclass from the JSON of its ``asdict``."""
    default: Any = kind()
    found: dict[str, Any] = {}
    for name, value in values.items():
        before = getattr(default, name)
        if is_dataclass(before):
            found[name] = _revived(type(before), value)
        else:
            found[name] = tuple(value) if isinstance(before, tuple) else value
    return kind(**found)


def _read(out: Path, with_tensors: bool) -> tuple[dict[str, str], dict[str, Tensor]]:
    """Read the header of a checkpoint and its tensors by name."""
    path = out / FILE
    if not path.is_file():
        raise InputError(f"There is no checkpoint in {out}; start without --run.resume.")
    try:
        with safe_open(str(path), framework="pt") as file:
            names = file.keys() if with_tensors else ()
            header = file.metadata() or {}
            tensors = {n: file.get_tensor(n) for n in names}
    except (SafetensorError, OSError) as error:
        raise InputError(f"The checkpoint in {out} is damaged ({in_short(error)}).") from error
    if not header.keys() >= {"step", "progress", "options"}:
        raise InputError(f"{path} is no checkpoint of a training run.")
    return header, tensors
