"""What a checkpoint holds of a mapper."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from geogs.depth.view import DepthSearch
from geogs.errors import InputError
from geogs.mapping.training.base import TrainingPlace
from geogs.mapping.view_pool import PoolState
from geogs.splat.optimizer import DiskState


@dataclass(frozen=True, eq=False)
class RandomState:
    """Where the random numbers are: NumPy's PCG64, and PyTorch's on the CPU."""

    state: int
    increment: int
    has_half: int
    half: int
    """Of 64 bits that were drawn for 32."""
    torch: UInt8[Tensor, "n"]

    @staticmethod
    def of(numpy: np.random.Generator, torch: torch.Generator) -> "RandomState":
        """Of two generators."""
        s = numpy.bit_generator.state
        inner, half = s["state"], (s["has_uint32"], s["uinteger"])
        return RandomState(inner["state"], inner["inc"], *half, torch.get_state())

    def restore(self, numpy: np.random.Generator, torch: torch.Generator) -> None:
        """Let two generators go on from there. Raises InputError if they cannot."""
        try:
            numpy.bit_generator.state = {
                "bit_generator": "PCG64", "state": {"state": self.state, "inc": self.increment},
                "has_uint32": self.has_half, "uinteger": self.half,
            }  # fmt: skip
            torch.set_state(self.torch)
        except (ValueError, TypeError, OverflowError, RuntimeError) as error:
            raise InputError("the random numbers are in no state that there is") from error


@dataclass(frozen=True, eq=False)
class ViewState:
    """Of a view, beside its keyframe and what the pool has of it; the fields are the view's."""

    partners: list[int]
    search: DepthSearch | None


@dataclass(frozen=True, eq=False)
class TrainedState:
    """Of a map that has disks."""

    unit: float
    disks: DiskState


@dataclass(frozen=True, eq=False)
class MapperState:
    """Depths, disks, and how far their training is."""

    views: dict[int, ViewState]
    pool: PoolState
    mapped: list[int]
    training: TrainedState | None
    place: TrainingPlace
    """How far the training over all keyframes is."""
    order: list[int]
    """Of the keyframes that it comes to next."""
    random: RandomState
