"""Renderings of keyframes in a file, as those of a long video do not fit into memory."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.geometry.camera import Camera
from geogs.types import RenderedKeyframe
from geogs.world.archive import Archive, Archived


@dataclass(frozen=True, eq=False, slots=True)
class StoredRender:
    """A rendering whose maps and image lie in archives."""

    keyframe_id: int
    camera: Camera
    T_cw: Float[Tensor, "4 4"]
    depth: Archived
    normal: Archived
    """Normals, in half precision."""
    weight: Archived
    image: Archived
    timestamp: float
    mask: Bool[Tensor, "h w"] | None
    device: torch.device
    """Device on which the maps were rendered."""

    def load(self) -> RenderedKeyframe:
        """Read the rendering into memory."""
        depth, normal, weight = (
            torch.from_numpy(maps.load()).to(self.device).float()
            for maps in (self.depth, self.normal, self.weight)
        )
        return RenderedKeyframe(
            self.keyframe_id, self.camera, self.T_cw, depth, normal, weight, self.image.load(),
            self.timestamp, self.mask,
        )  # fmt: skip


def stored_render(render: RenderedKeyframe, image: Archived, archive: Archive) -> StoredRender:
    """Put a rendering into an archive; its image is read from ``image``.

    Raises:
        OutputError: the disk is full, or cannot be written.
    """
    depth, normal, weight = (
        archive.put(maps.cpu().numpy())
        for maps in (render.depth, render.normal.half(), render.weight)
    )
    return StoredRender(
        render.keyframe_id, render.camera, render.T_cw, depth, normal, weight, image,
        render.timestamp, render.mask, render.depth.device,
    )  # fmt: skip
