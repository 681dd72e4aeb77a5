"""The large parts of a mapper's view: in memory while they are used, else in a file."""

from collections import OrderedDict
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from torch import Tensor

from geogs.config import LossConfig
from geogs.depth.view import DenseDepth, depth_view
from geogs.geometry.camera import Camera
from geogs.keyframes.archive import Archive, Archived
from geogs.losses.multi_view import PhotoView
from geogs.losses.single_view import ViewConstants
from geogs.types import Keyframe


@dataclass(eq=False)
class ViewMaps:
    """What is as large as an image: all but the depths follows from the keyframe's image."""

    image: UInt8[np.ndarray, "wh ww 3"]
    grey: Float32[np.ndarray, "h w"]
    fine: Float32[np.ndarray, "fh fw"]
    """Of the :class:`DepthView`."""
    photo: Float[Tensor, "ph pw"]
    """Smoothed grey image of the :class:`PhotoView`, on the map's device."""
    normal: Float[Tensor, "h w 3"] | None
    """A prior's normals at the render size, on the map's device."""
    depth: DenseDepth | None = None
    constants: ViewConstants | None = None
    rendered_depth: Float[Tensor, "h w"] | None = None

    @staticmethod
    def of(
        keyframe: Keyframe,
        render: Camera,
        photo: Camera,
        loss: LossConfig,
        device: torch.device | str,
    ) -> "ViewMaps":
        """What follows from a keyframe's image and a prior's normals of it."""
        image = keyframe.image
        view = depth_view(keyframe, render, image)
        grey = PhotoView.prepare(image, photo, keyframe.T_cw, loss.photo_blur, device).grey
        normal = _shrunk_normal(keyframe, render, device) if loss.normal_weight else None
        return ViewMaps(image, view.grey, view.fine, grey, normal)


@dataclass(eq=False)
class ParkedMaps:
    """Of a view that is not in use: its depths in an archive, the rest can be made again."""

    depth: Archived | None = None
    confidence: Archived | None = None
    rendered_depth: Archived | None = None
    typical: float = 0.0
    """Median depth, map units."""
    factor: float = 1.0
    """What the archived depth is to be multiplied with."""
    held: DenseDepth | None = None
    """The archived depth, where it can also stay: on a GPU it is small beside all else there, and
    bringing it there again takes longer than using it."""

    def __getstate__(self) -> dict[str, object]:
        """What a checkpoint holds: the archive has it."""
        return {**self.__dict__, "held": None}

    @staticmethod
    def of(depth: DenseDepth, archive: Archive) -> "ParkedMaps":
        """A depth alone."""
        parked = ParkedMaps()
        parked.keep_depth(depth, archive)
        return parked

    def keep_depth(self, depth: DenseDepth, archive: Archive) -> None:
        """Archive a depth."""
        self.factor = 1.0
        arrays = depth.arrays()
        self.depth, self.confidence = archive.put(arrays.depth), archive.put(arrays.confidence)
        self.typical = depth.typical
        self.held = depth if depth.depth.is_cuda else None

    def load_depth(self, device: torch.device | str) -> DenseDepth:
        """The depth, as it was but for the factor."""
        if self.held is not None:
            typical = torch.tensor(self.typical)
            return DenseDepth(self.held.depth * self.factor, self.held.confidence, typical)
        assert self.depth is not None, "no depth was parked"
        assert self.confidence is not None, "no confidence was parked"
        depth = torch.from_numpy(self.depth.load())
        confidence = torch.from_numpy(self.confidence.load())
        if self.factor != 1.0:
            depth = depth * self.factor
        typical = torch.tensor(self.typical)
        return DenseDepth(depth.to(device), confidence.to(device), typical)


@runtime_checkable
class Parkable(Protocol):
    """Something large that can leave the memory."""

    def park(self, archive: Archive) -> None:
        """Leave the memory, but for what is needed to come back."""
        ...


class ResidentViews:
    """Holds the views used last in memory, at most ``count``, and parks the others."""

    def __init__(self, count: int) -> None:
        self.count = max(count, 1)
        self.archive = Archive()
        self._views: OrderedDict[Parkable, None] = OrderedDict()

    def __len__(self) -> int:
        return len(self._views)

    def __getstate__(self) -> dict[str, object]:
        """What a checkpoint holds: no view is in memory when it is read."""
        return {**self.__dict__, "_views": OrderedDict()}

    def use(self, view: Parkable) -> None:
        """A view is in memory and in use: the one not used for longest may leave."""
        self._views[view] = None
        self._views.move_to_end(view)
        while len(self._views) > self.count:
            oldest, _ = self._views.popitem(last=False)
            oldest.park(self.archive)


def _shrunk_normal(
    keyframe: Keyframe, render: Camera, device: torch.device | str
) -> Float[Tensor, "h w 3"] | None:
    """A keyframe's prior normals, averaged over the pixels of the render; zero where they differ.

    An average shorter than a half comes from an edge or from pixels that are not known.
    """
    normal = keyframe.normal
    if normal is None:
        return None
    size = (render.width, render.height)
    full = normal.detach().cpu().float().numpy()
    mean = cv2.resize(full, size, interpolation=cv2.INTER_AREA)
    length = np.linalg.norm(mean, axis=-1, keepdims=True)
    unit = np.where(length > 0.5, mean / np.maximum(length, 1e-6), 0.0)
    return torch.from_numpy(unit.astype(np.float32)).to(device)
