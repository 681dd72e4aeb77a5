"""Reading tensors from weights files, without running what may be hidden in them."""

import pickle
from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from geogs.errors import InputError
from geogs.networks.weights_files import require_intact


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


def _safetensors(path: Path) -> object:
    try:
        return load_file(path)
    except (SafetensorError, OSError) as error:
        raise InputError(f"{path} is damaged, or no safetensors file.") from error


def _checkpoint(path: Path) -> object:
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        # Also raised for what is no pickle at all.
        if "Unsupported global" in str(error):
            raise InputError(
                f"{path} holds more than tensors, and reading the rest could run any program; "
                "save its tensors alone (as safetensors) where you trust it."
            ) from error
        raise InputError(f"{path} is damaged, or no PyTorch checkpoint.") from error
    except Exception as error:  # whatever a damaged file makes the reader stumble over
        raise InputError(f"{path} is damaged, or no PyTorch checkpoint.") from error
