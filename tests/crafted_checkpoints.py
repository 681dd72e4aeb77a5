"""Checkpoints that a stranger made up: one value is another, and all checksums are right."""

import hashlib
import json
import random
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

NUMBERS = (float("nan"), float("inf"), -float("inf"), 1e30, -1e30, 0.0, -1.0, 1e-30)
WHOLE = (-1, 10**6, 2**31, 2**70, 1.5, "1", None, True)
OTHER_TYPES = (torch.float16, torch.float64, torch.int32, torch.uint8, torch.bool)


@dataclass(frozen=True)
class Crafted:
    """One change of a checkpoint, in words and as what is done to its values and arrays."""

    what: str
    change: Callable[[Any, dict[str, Tensor]], object]

    def write(self, begun: Path, output: Path) -> None:
        """The changed checkpoint of results in a folder of its own."""
        shutil.copytree(begun / "checkpoint", output / "checkpoint")
        (values,) = (output / "checkpoint").glob("state-*.json")
        (arrays,) = (output / "checkpoint").glob("state-*.safetensors")
        document, tensors = json.loads(values.read_text()), load_file(arrays)
        self.change(document["state"], tensors)
        values.write_text(json.dumps(document))
        save_file({name: t.contiguous() for name, t in tensors.items()}, arrays)
        reseal(output)


def reseal(output: Path) -> None:
    """Give the files of a state and the manifest the sizes and checksums that they have now."""
    path = output / "checkpoint" / "manifest.json"
    manifest = json.loads(path.read_text())
    for name in ("checksum", "seal"):  # which only its user could make
        manifest.pop(name, None)
    for entry in manifest["state"]:
        file = output / "checkpoint" / entry[0]
        data = file.read_bytes() if file.is_file() else b""
        entry[1] = {"size": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    checksum = hashlib.sha256(json.dumps(manifest).encode()).hexdigest()
    path.write_text(json.dumps(manifest | {"checksum": checksum}))


def crafted(begun: Path, seed: int, count: int) -> list[Crafted]:
    """So many changes of numbers, of lists, and of types, shapes and values of arrays."""
    (values,) = (begun / "checkpoint").glob("state-*.json")
    (arrays,) = (begun / "checkpoint").glob("state-*.safetensors")
    leaves = list(_leaves(json.loads(values.read_text())["state"]["world"], ("world",)))
    tensors, chance = load_file(arrays), random.Random(seed)
    by_kind: dict[str, list[tuple[Any, ...]]] = {}
    for place, value in leaves:  # as many of what there is little of as of what there is much
        named = ".".join(p for p in place if isinstance(p, str))
        by_kind.setdefault(f"{named}:{type(value).__name__}", []).append((place, value))
    for name in tensors:
        plain = ".".join(p for p in name.split(".") if not p.isdigit() and p[0] != "(")
        by_kind.setdefault(f"tensor {plain}", []).append((name, tensors[name]))
    kinds = sorted(by_kind)
    return [_one(*chance.choice(by_kind[chance.choice(kinds)]), chance) for _ in range(count)]


def _one(place: Any, value: Any, chance: random.Random) -> Crafted:
    if isinstance(place, str):
        return _of_array(place, value, chance)
    if isinstance(value, list):
        longer = chance.random() < 0.5
        return Crafted(f"{place} {'twice' if longer else 'empty'}", _put(place, value * 2 * longer))
    choices = NUMBERS if isinstance(value, float) else WHOLE
    other = chance.choice(choices) if isinstance(value, int | float) else chance.choice(WHOLE)
    return Crafted(f"{place} = {other!r}", _put(place, other))


def _of_array(name: str, tensor: Tensor, chance: random.Random) -> Crafted:
    how = chance.choice(("type", "shape", "value", "value", "all", "gone"))
    if how == "type":
        kind = chance.choice([t for t in OTHER_TYPES if t != tensor.dtype])
        return Crafted(f"{name} as {kind}", lambda _, a: a.update({name: tensor.to(kind)}))
    if how == "shape":
        shorter = tensor[:-1] if tensor.dim() and len(tensor) else tensor[None]
        return Crafted(f"{name} of {tuple(shorter.shape)}", lambda _, a: a.update({name: shorter}))
    if how == "gone":
        return Crafted(f"{name} gone", lambda _, a: a.pop(name))
    changed = tensor.clone()
    number = chance.choice(NUMBERS if tensor.is_floating_point() else (-1, 100, 10**6))
    if tensor.dtype in (torch.uint8, torch.bool, torch.int16):
        number = 1
    if how == "all" or not tensor.numel():
        changed[...] = torch.tensor(number).to(tensor.dtype)
    else:
        changed.view(-1)[chance.randrange(tensor.numel())] = torch.tensor(number).to(tensor.dtype)
    return Crafted(f"{name} {how} = {number}", lambda _, a: a.update({name: changed}))


def _leaves(value: Any, place: tuple[Any, ...]) -> Iterator[tuple[tuple[Any, ...], Any]]:
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _leaves(inner, (*place, name))
    elif isinstance(value, list) and value:
        yield place, value
        for n, inner in enumerate(value):
            yield from _leaves(inner, (*place, n))
    elif value not in ("host", "device"):
        yield place, value


def _put(place: tuple[Any, ...], value: object) -> Callable[[Any, dict[str, Tensor]], None]:
    def change(state: Any, _: object) -> None:
        for part in place[:-1]:
            state = state[part]
        state[place[-1]] = value

    return change
