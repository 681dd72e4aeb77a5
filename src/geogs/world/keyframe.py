"""A keyframe: what was seen, from where, and how far it is."""

import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, UInt8
from torch import Tensor

from geogs.geometry.lie import scaled
from geogs.priors.base import DepthKind
from geogs.types import MeasuredPose
from geogs.world.archive import Archived
from geogs.world.grid import SampleGrid
from geogs.world.pictures import Picture
from geogs.world.poses import PoseTable

KNOWN = 0.3
"""Relative deviation up to which a depth helps to tell where a camera is."""
RELATIVE_FLOOR = 0.004
"""Relative depth deviation that no amount of matches removes."""


@dataclass
class KeyframePrior:
    """What a monocular prior said of a keyframe's depth, and how it is scaled; mutable."""

    kind: DepthKind
    values: Float[Tensor, "p"]
    """As the prior gave them, on the grid."""
    inverse_depth: Float[Tensor, "p"]
    """Aligned to the tracker's; 0 where unknown, and everywhere before the first alignment."""
    scale: Float[Tensor, "k"]
    """Factors of the aligned inverse depth at the nodes of a coarse grid, row by row."""
    information: Float[Tensor, "p"]
    """What it adds to the inverse variance of the keyframe's inverse depth."""
    is_aligned: bool = False

    def rescale(self, factor: float) -> None:
        """Multiply every length by ``factor``."""
        self.scale = self.scale / factor
        self.information = self.information * factor**2


@dataclass
class MeasuredCells:
    """What a depth sensor says of a keyframe's cells, in the lengths of the map; mutable."""

    inverse_depth: Float[Tensor, "p"]
    information: Float[Tensor, "p"]
    """Inverse variance of inverse depth; 0 where it says nothing."""

    def rescale(self, factor: float) -> None:
        """Multiply every length by ``factor``."""
        self.inverse_depth = self.inverse_depth / factor
        self.information = self.information * factor**2


@dataclass(frozen=True, eq=False)
class KeyframeState:
    """What a checkpoint holds of a keyframe; the fields are the keyframe's."""

    id: int
    frame_index: int
    timestamp: float
    image: Archived
    normal: Archived | None
    T_cw: Float64[Tensor, "4 4"]
    inverse_depth: Float32[Tensor, "p"]
    information: Float32[Tensor, "p"]
    prior: KeyframePrior | None
    scale: float
    moving: Bool[Tensor, "p"] | None
    depth: Archived | None
    measured: MeasuredCells | None
    pose: MeasuredPose | None


@dataclass(eq=False)
class Keyframe:
    """The one record of a keyframe's pose, depth and scale; mutable, and owned by its store.

    A pose or a field is replaced, never changed in place: who keeps a reference sees what it was.
    """

    id: int
    """Stable: never reused, increasing in time."""
    frame_index: int
    timestamp: float
    """Seconds."""
    grid: SampleGrid
    """Where depth is kept."""
    picture: Picture
    """Image, its encoded form and normals, in memory or not."""
    poses: PoseTable
    """Which has its pose, by its id."""
    inverse_depth: Float[Tensor, "p"]
    information: Float[Tensor, "p"]
    """Of the matches, sum over edges of w |dp/dd|^2, and of a depth sensor; not of a prior."""
    prior: KeyframePrior | None = None
    scale: float = 1.0
    """Factor by which corrections have multiplied the lengths around it; what was measured from it
    at another scale is to be multiplied by the ratio of the two."""
    moving: Bool[Tensor, "p"] | None = None
    """Cells that are held for showing something that moves; none where nobody has judged yet."""
    measured: MeasuredCells | None = None
    """Of a depth sensor; none without, or where the map is not metric."""
    pose: MeasuredPose | None = None
    """By another tracker, in its own world; none where there is none."""

    @property
    def T_cw(self) -> Float[Tensor, "4 4"]:
        """World to camera, float64, on the CPU whatever the device of the grid."""
        return self.poses[self.id]

    @T_cw.setter
    def T_cw(self, T_cw: Float[Tensor, "4 4"]) -> None:
        self.poses[self.id] = T_cw

    @property
    def image(self) -> UInt8[np.ndarray, "h w 3"]:
        """RGB at working resolution; not to be changed in place."""
        return self.picture.image

    @property
    def encoded(self) -> Any:
        """The flow operator's form of the image."""
        return self.picture.encoded

    def as_it_is(self) -> "Keyframe":
        """A copy that stays what this one is now; it has no place in any store."""
        twin = copy.copy(self)
        twin.prior, twin.measured = copy.copy(self.prior), copy.copy(self.measured)
        twin.poses = PoseTable()
        twin.T_cw = self.T_cw
        return twin

    def state(self) -> KeyframeState:
        """What a checkpoint holds."""
        picture = self.picture
        return KeyframeState(
            self.id, self.frame_index, self.timestamp, picture.archived, picture.archived_normal,
            self.T_cw, self.inverse_depth, self.information, self.prior, self.scale, self.moving,
            picture.archived_depth, self.measured, self.pose,
        )  # fmt: skip

    def rescale(self, factor: float) -> None:
        """Multiply every length that the camera sees by ``factor``; the pose stays."""
        if factor == 1.0:
            return
        self.inverse_depth = self.inverse_depth / factor
        self.information = self.information * factor**2
        self.scale = self.scale * factor
        if self.prior is not None:
            self.prior.rescale(factor)
        if self.measured is not None:
            self.measured.rescale(factor)

    def at_present_scale(self, T: Float[Tensor, "4 4"], scale: float) -> Float[Tensor, "4 4"]:
        """A motion measured from here when the keyframe had that scale, in its lengths of now."""
        factor = self.scale / scale
        return T if factor == 1.0 else scaled(T, factor)

    @property
    def has_known_depth(self) -> Bool[Tensor, "p"]:
        """Where matches tell the depth to ``KNOWN``, if the poses are right."""
        return KNOWN**2 * self.inverse_depth.square() * self.information > 1

    @property
    def sure_information(self) -> Float[Tensor, "p"]:
        """Information less the error that no match removes: what others may trust depth by.

        The relative deviation of depth is z / sqrt of this. What a prior adds is only told of where
        depth has been adjusted with it.
        """
        # What matches agree on is still wrong by a common error of poses and scale.
        floor = (RELATIVE_FLOOR * self.inverse_depth).square()
        known = self.information
        if self.prior is not None:
            known = known + self.prior.information
        return known / (1 + known * floor)

    def depth_field(
        self,
    ) -> tuple[Float32[np.ndarray, "gh gw"], Float32[np.ndarray, "gh gw"]]:
        """Inverse depth and its ``sure_information`` as images of cells, on the CPU."""
        shape = (self.grid.height, self.grid.width)
        return (
            self.inverse_depth.reshape(shape).cpu().numpy(),
            self.sure_information.reshape(shape).cpu().numpy(),
        )
