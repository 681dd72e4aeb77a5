"""Reading tensors from weights files, without running what may be hidden in them."""

import json
import pickle
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file
from torch import Tensor, nn

from geogs.errors import InputError
from geogs.guard.documents import in_short, open_file, require_file
from geogs.networks.weights_files import require_intact

N = TypeVar("N", bound=nn.Module)


def read_tensors(path: Path) -> dict[str, Tensor]:
    """All tensors of a safetensors file or of a PyTorch checkpoint, by name, on the CPU.

    A checkpoint is a pickle, which could run anything; it is read by PyTorch's restricted reader,
    which takes tensors and nothing else.

    Raises InputError if the file is missing, damaged, not the published one of its name, or holds
    something else.
    """
    require_intact(path)
    content = _safetensors(path) if path.suffix == ".safetensors" else _checkpoint(path)
    if not isinstance(content, Mapping) or not content:
        raise InputError(f"{path} holds no named tensors.")
    other = [name for name, value in content.items() if not isinstance(value, Tensor)]
    if other:
        such = ascii(other[0])[1:-1][:40]
        raise InputError(f"{path} holds more than named tensors (such as {such}).")
    return dict(content)


def load_trained(
    path: Path, kind: Literal["flow", "depth"], build: Callable[[dict[str, Any]], N]
) -> N:
    """Load a network written by ``geogs train``, in single precision and ready to run.

    ``build`` makes it from the file's metadata: the fields of dataclasses, by name.
    Raises InputError if the file is missing or another's.
    """
    if not path.is_file():
        option = "--tracking.operator" if kind == "flow" else "--mapping.depth.engine"
        raise InputError(
            f"There are no weights of the {kind} network at {path}; train some with geogs train "
            f"{kind}, or take {option} classical."
        )
    try:
        with safe_open(require_file(path), "pt") as file:
            about = {name: json.loads(text) for name, text in (file.metadata() or {}).items()}
            tensors = {key: file.get_tensor(key).float() for key in file.keys()}  # noqa: SIM118
        options = about["options"].items()
        about["options"] = {k: tuple(v) if isinstance(v, list) else v for k, v in options}
        network = build(about)
        network.load_state_dict(tensors)
    except Exception as error:  # any error of the reader on another file
        raise InputError(
            f"{path} does not hold weights of our {kind} network ({in_short(error)})."
        ) from error
    network.eval().requires_grad_(False)
    return network


def _safetensors(path: Path) -> object:
    try:
        return load_file(require_file(path))
    except (SafetensorError, OSError) as error:
        raise InputError(f"{path} is damaged, or no safetensors file.") from error


def _checkpoint(path: Path) -> object:
    try:
        with open_file(path) as file:
            return torch.load(file, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        # Also raised for files that are no pickle at all.
        if "Unsupported global" in str(error):
            raise InputError(
                f"{path} holds more than tensors, and reading the rest could run any program; "
                "save its tensors alone (as safetensors) where you trust it."
            ) from error
        raise InputError(f"{path} is damaged, or no PyTorch checkpoint.") from error
    except Exception as error:  # any error of the reader on a damaged file
        raise InputError(f"{path} is damaged, or no PyTorch checkpoint.") from error
