"""The map: disks, mapping data of each keyframe, and progress of the training."""

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Bool, Float16, Float32, UInt8
from torch import Tensor

from geogs.config.setting import Range
from geogs.errors import InputError
from geogs.limits import AT_LEAST_0, POSITIVE, AtLeast0, KeyframeId, Number, Positive
from geogs.world.arrays import NOT_STORED, ArrayTable
from geogs.world.disks import GaussianMap
from geogs.world.keyframes import KeyframeTable
from geogs.world.tables import check_arrays, check_tables

DEPTH = ("depth", "confidence")
MAP_ARRAYS = {
    "mask": Bool[np.ndarray, "h w"],
    "depth": Annotated[Float32[np.ndarray, "h w"], POSITIVE],
    "confidence": Annotated[Float32[np.ndarray, "h w"], Range(0, 1)],
    "depth normal": Float16[np.ndarray, "h w 3"],
    "sky": Bool[np.ndarray, "h w"],
    "rendered depth": Annotated[Float32[np.ndarray, "h w"], AT_LEAST_0],
}
"""Large arrays of a view, all optional."""


@dataclass(frozen=True, slots=True)
class DepthSearch:
    """Depth range searched for a keyframe without a tracker's depth. Map units."""

    near: Positive
    typical: Positive
    """Median depth: neighbours are chosen for their parallax there."""
    far: Positive


@dataclass(frozen=True, slots=True)
class SearchedDepth:
    """Statistics of a dense depth whose arrays are in the table."""

    typical: Positive
    """Median depth, map units."""
    scale: Positive
    """Scale of the keyframe at which the stored depth holds."""

    def typical_at(self, scale: float) -> float:
        """Return the median depth at another scale of the keyframe."""
        return self.typical * (scale / self.scale)


@dataclass(eq=False)
class ViewRow:
    """Mapping data of a keyframe."""

    partners: list[KeyframeId] = field(default_factory=list)
    """Ids of the keyframes whose images check this one's depth, best first."""
    search: DepthSearch | None = None
    """Searched depth range; None if it follows from the tracker's depth."""
    exposure: Float32[Tensor, "3"] | None = None
    """Gain and offset of the exposure compensation, and the noise variance of the compensated grey
    values; None until known."""
    depth: SearchedDepth | None = None
    """Dense depth; None until it was searched."""


@dataclass(frozen=True, slots=True)
class TrainingPlace:
    """Progress of a long training."""

    steps: Number = 0
    """Steps done."""
    total: Number = 0
    """Steps in total."""
    seconds: AtLeast0 = 0.0
    """Seconds spent."""


@dataclass(eq=False)
class RandomState:
    """State of two random number generators: NumPy's PCG64, and PyTorch's on the CPU.

    The stored state is that of the last ``settle``.
    """

    state: int
    increment: int
    has_half: int
    half: int
    """Unused 32 of the last 64 bits drawn."""
    words: UInt8[Tensor, "n"]
    """State of PyTorch's generator."""
    of_numpy: np.random.Generator = field(init=False, repr=False, metadata=NOT_STORED)
    of_torch: torch.Generator = field(init=False, repr=False, metadata=NOT_STORED)

    @staticmethod
    def seeded(seed: int) -> "RandomState":
        """Return the initial state of a seed."""
        drawn = np.random.default_rng(seed).bit_generator.state
        inner = drawn["state"]
        half = (drawn["has_uint32"], drawn["uinteger"])
        words = torch.Generator().manual_seed(seed).get_state()
        return RandomState(inner["state"], inner["inc"], *half, words)

    def __post_init__(self) -> None:
        """Raises InputError if the numbers are no valid state."""
        self.of_numpy = np.random.default_rng(0)
        self.of_torch = torch.Generator()
        try:
            self.of_numpy.bit_generator.state = {
                "bit_generator": "PCG64",
                "state": {"state": self.state, "inc": self.increment},
                "has_uint32": self.has_half,
                "uinteger": self.half,
            }
            self.of_torch.set_state(self.words)
        except (ValueError, TypeError, OverflowError, RuntimeError) as error:
            raise InputError("the random numbers are in no state that there is") from error

    def settle(self) -> None:
        """Store the present state of the generators."""
        now = self.of_numpy.bit_generator.state
        self.state = now["state"]["state"]
        self.increment = now["state"]["inc"]
        self.has_half = now["has_uint32"]
        self.half = now["uinteger"]
        self.words = self.of_torch.get_state()


@dataclass(eq=False)
class MapTable:
    """The map and all data needed to continue it, except the keyframes."""

    disks: GaussianMap
    random: RandomState
    views: dict[KeyframeId, ViewRow] = field(default_factory=dict)
    """Rows by keyframe, in the order in which mapping got them."""
    arrays: ArrayTable = field(default_factory=ArrayTable)
    """Masks, dense depths with confidences and normals, and depths rendered from the disks."""
    resident: list[KeyframeId] = field(default_factory=list)
    """Keyframes whose arrays were in memory when the table was settled, those used last at the end.
    Their depths have been rounded at each change of scale."""
    mapped: list[KeyframeId] = field(default_factory=list)
    """Keyframes whose depth is part of the map."""
    given: list[KeyframeId] = field(default_factory=list)
    """Keyframes of a saved map, which are fixed."""
    unit: Positive | None = None
    """Median depth of the first keyframe, map units; None until it is mapped."""
    place: TrainingPlace = TrainingPlace()
    """Progress of the training over all keyframes, at its last report."""
    order: list[int] = field(default_factory=list)
    """Keyframes trained next, as indices into ``mapped``."""

    @staticmethod
    def empty(device: torch.device | str, seed: int = 0) -> "MapTable":
        """Return a map without disks."""
        return MapTable(GaussianMap.empty(device), RandomState.seeded(seed))


def check_map(table: MapTable, keyframes: KeyframeTable, size: tuple[int, int]) -> None:
    """Check that a table that was read belongs to these keyframes; ``size``: height and width.

    Raises InputError if it is incomplete, or belongs to other keyframes.
    """
    height, width = size
    check_tables(MapTable, table, {}, {"keyframes": keyframes})
    check_arrays(table.arrays, MAP_ARRAYS, {"h": height, "w": width}, table.views)
    disks = table.disks
    is_turned = disks.parameters.quaternion.detach().any(dim=1)
    if not is_turned.all() or any((part < 0).any() for part in disks.second):
        raise InputError("a disk has no orientation, or has been trained as none can be")
    partners = {i for row in table.views.values() for i in row.partners}
    if not {*table.mapped, *table.given, *table.resident, *partners} <= table.views.keys():
        raise InputError("a view of the map is missing")
    if not all(0 <= n < len(table.mapped) for n in table.order):
        raise InputError("the place in the training is none")
    mapped = {*table.mapped}
    for id, row in table.views.items():
        is_searched = id in mapped or row.depth is not None
        if is_searched and not (row.depth and all(table.arrays.has(n, id) for n in DEPTH)):
            raise InputError(f"the depth of keyframe {id} is missing")
