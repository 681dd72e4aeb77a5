"""Renderings of the keyframes of a long video, which do not fit into memory all at once."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from geogs.geometry.camera import Camera
from geogs.keyframes.archive import Archive, Archived
from geogs.types import RenderedKeyframe

RESIDENT_BYTES = 1 << 26
"""Maps of the first keyframes that stay in the memory of the CPU."""
RESIDENT_BYTES_GPU = 1 << 32
"""Maps of the first keyframes that stay in the memory of a GPU that made them."""


@dataclass(frozen=True, eq=False, slots=True)
class StoredRender:
    """A rendering whose maps and image may lie in archives."""

    keyframe_id: int
    camera: Camera
    T_cw: Float[Tensor, "4 4"]
    depth: Tensor | Archived
    normal: Tensor | Archived
    """In an archive with half the digits; nobody measures with them."""
    weight: Tensor | Archived
    image: UInt8[np.ndarray, "h w 3"] | Archived
    device: torch.device
    """Of the maps that were rendered."""

    def load(self) -> RenderedKeyframe:
        """The rendering with all that belongs to it in memory."""
        image = self.image.load() if isinstance(self.image, Archived) else self.image
        return RenderedKeyframe(
            self.keyframe_id, self.camera, self.T_cw,
            self._map(self.depth), self._map(self.normal), self._map(self.weight), image,
        )  # fmt: skip

    def _map(self, stored: Tensor | Archived) -> Tensor:
        if not isinstance(stored, Archived):
            return stored
        return torch.from_numpy(stored.load()).to(self.device).float()


class RenderStore:
    """Keeps renderings: some in memory where they are, those that come later in a temporary file.

    ``resident_bytes`` are those of the maps in memory; of images there are none but where an image
    has no archive of its own.
    """

    def __init__(self, resident_bytes: int | None = None) -> None:
        self._limit = resident_bytes
        self._bytes = 0
        self._archive: Archive | None = None

    def put(
        self, render: RenderedKeyframe, image: UInt8[np.ndarray, "h w 3"] | Archived
    ) -> StoredRender:
        """Keep a rendering; its image is read from ``image``.

        Raises:
            OutputError: the disk is full, or cannot be written.
        """
        maps = render.depth, render.normal, render.weight
        device, size = render.depth.device, sum(m.numel() * m.element_size() for m in maps)
        limit = self._limit
        if limit is None:
            limit = RESIDENT_BYTES if device.type == "cpu" else RESIDENT_BYTES_GPU
        depth: Tensor | Archived = render.depth
        normal: Tensor | Archived = render.normal
        weight: Tensor | Archived = render.weight
        if self._bytes + size <= limit:
            self._bytes += size
        else:
            depth, weight = self._archived(render.depth), self._archived(render.weight)
            normal = self._archived(render.normal.half())
        return StoredRender(
            render.keyframe_id, render.camera, render.T_cw, depth, normal, weight, image, device
        )

    def _archived(self, array: Tensor) -> Archived:
        if self._archive is None:
            self._archive = Archive()
        return self._archive.put(array.cpu().numpy())
