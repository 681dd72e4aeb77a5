"""A training run on disk: a few safetensors files and a page of numbers, no pickles."""

import json
import shutil
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors.torch import load_file, save_file

from geogs.errors import InputError
from geogs_train.options import FlowTraining
from geogs_train.trainer import FlowTrainer

FOLDER = "checkpoint"
T = TypeVar("T")
_PARTS = ("network", "mean", "first_moment", "second_moment")


def save_checkpoint(trainer: FlowTrainer, out: Path) -> None:
    """Write all that the run needs to go on; the one before stays until the new one is whole."""
    fresh, final = out / f".{FOLDER}", out / FOLDER
    shutil.rmtree(fresh, ignore_errors=True)
    fresh.mkdir(parents=True)
    names = [name for name, _ in trainer.network.named_parameters()]
    moments = trainer.optimizer.state_dict()["state"]
    parts = {
        "network": trainer.network.state_dict(),
        "mean": trainer.mean.state_dict(),
        "first_moment": {names[k]: v["exp_avg"] for k, v in moments.items()},
        "second_moment": {names[k]: v["exp_avg_sq"] for k, v in moments.items()},
    }
    for name in _PARTS:
        tensors = {k: v.detach().cpu().contiguous() for k, v in parts[name].items()}
        save_file(tensors, fresh / f"{name}.safetensors")
    state = {"step": trainer.step, "options": asdict(trainer.options)}
    (fresh / "state.json").write_text(json.dumps(state, indent=1))
    shutil.rmtree(final, ignore_errors=True)
    fresh.rename(final)


def read_options(out: Path) -> FlowTraining:
    """The settings of the run in a folder; raises InputError where there is none."""
    return _revived(FlowTraining, _read_state(out)["options"])


def load_checkpoint(trainer: FlowTrainer, out: Path) -> None:
    """Go on from a checkpoint; raises InputError where there is none or it is damaged."""
    step = int(_read_state(out)["step"])
    try:
        parts = {name: load_file(out / FOLDER / f"{name}.safetensors") for name in _PARTS}
    except Exception as error:
        raise InputError(f"The checkpoint in {out} is damaged ({error}).") from error
    trainer.network.load_state_dict(parts["network"])
    trainer.mean.load_state_dict(parts["mean"])
    names = [name for name, _ in trainer.network.named_parameters()]
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


def _revived(kind: type[T], values: dict[str, Any]) -> T:
    """A dataclass from what ``asdict`` made of it and JSON kept."""
    default: Any = kind()
    found: dict[str, Any] = {}
    for name, value in values.items():
        before = getattr(default, name)
        if is_dataclass(before):
            found[name] = _revived(type(before), value)
        else:
            found[name] = tuple(value) if isinstance(before, tuple) else value
    return kind(**found)


def _read_state(out: Path) -> dict:
    path = out / FOLDER / "state.json"
    if not path.is_file():
        raise InputError(f"There is no checkpoint in {out}; start without --run.resume.")
    return json.loads(path.read_text())
