"""The large parts of one view, in memory and in an archive."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, UInt8
from torch import Tensor

from geogs.depth.view import DenseDepth
from geogs.losses.single_view import ViewConstants
from geogs.world.archive import Archive, Archived
from geogs.world.keyframes import Keyframe


@dataclass(eq=False)
class ViewMaps:
    """What is as large as an image: all but the depths follows from the keyframe's image."""

    image: UInt8[np.ndarray, "wh ww 3"]
    photo: Float[Tensor, "k ph pw"]
    """Planes of the :class:`PhotoView` in the light of all, on the map's device."""
    normal: Float[Tensor, "h w 3"] | None
    """A prior's normals at the render size, on the map's device."""
    depth: DenseDepth | None = None
    scale: float = 1.0
    """Of the keyframe when the depth was as it is here."""
    constants: ViewConstants | None = None
    rendered_depth: Float[Tensor, "h w"] | None = None
    matched: tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "fh fw"]] | None = None
    """Grey images of the :class:`DepthView`, once it was asked for."""
    is_depth_stored: bool = True
    """Whether the archive has the depth."""
    is_render_stored: bool = True


@dataclass(frozen=True, eq=False)
class StoredDepth:
    """A dense depth in an archive."""

    depth: Archived
    confidence: Archived
    typical: float
    """Median depth, map units."""
    scale: float
    """Of the keyframe when its depth was archived."""
    normal: Archived | None = None
    """Half precision; none where the depth came without."""

    @staticmethod
    def of(depth: DenseDepth, scale: float, archive: Archive) -> "StoredDepth":
        """Archive a depth of a keyframe that has a scale."""
        arrays = depth.arrays()
        return StoredDepth(
            archive.put(arrays.depth), archive.put(arrays.confidence), depth.typical, scale,
            None if depth.normal is None else archive.put(depth.normal.half().cpu().numpy()),
        )  # fmt: skip

    def typical_at(self, scale: float) -> float:
        """Median depth at another scale of the keyframe."""
        return self.typical * (scale / self.scale)

    def load(self, scale: float, device: torch.device) -> DenseDepth:
        """The depth at another scale of the keyframe."""
        factor, typical = scale / self.scale, torch.tensor(self.typical_at(scale))
        depth = torch.from_numpy(self.depth.load())
        if factor != 1.0:
            depth = depth * factor
        confidence = torch.from_numpy(self.confidence.load())
        normal = None
        if self.normal is not None:
            normal = torch.from_numpy(self.normal.load()).float().to(device)
        return DenseDepth(depth.to(device), confidence.to(device), typical, normal=normal)


@dataclass(eq=False)
class StoredMaps:
    """Of a view that is not in use: its depths in an archive, the rest can be made again."""

    keyframe: Keyframe
    mask: Bool[Tensor, "h w"] | None
    """Pixels of the render size that belong to the scene; none takes all. On the map's device."""
    depth: StoredDepth | None = None
    rendered_depth: Archived | None = None
    light: Float[Tensor, "2"] | None = None
    """Gain and offset that bring its grey values into the light of all; None until known."""
