"""Posed training images."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, UInt8
from torch import Tensor

from geogs.geometry.camera import Camera
from geogs.io.sources.posed.posed_source import PosedSource


@dataclass(frozen=True)
class TrainingView:
    """An image with its mask and its pose."""

    image: UInt8[np.ndarray, "h w 3"]
    """RGB."""
    mask: Bool[np.ndarray, "h w"] | None
    """Pixels that show the object; none where all count."""
    camera: Camera
    T_cw: Float64[np.ndarray, "4 4"]
    """World to camera."""


def training_views(source: PosedSource) -> list[TrainingView]:
    """All images of a source."""
    return [TrainingView(v.image, v.mask, source.camera, v.T_cw) for v in source]


def scene_scale(views: Sequence[TrainingView], margin: float) -> float:
    """Largest distance of a camera from the middle of the cameras, times ``margin``."""
    T_cw = np.stack([view.T_cw for view in views])
    centres = -np.einsum("nji,nj->ni", T_cw[:, :3, :3], T_cw[:, :3, 3])
    return float(margin * np.linalg.norm(centres - centres.mean(0), axis=1).max())


class DeviceView:
    """A view on the training device, prepared once for all iterations."""

    def __init__(self, view: TrainingView, device: torch.device) -> None:
        self.camera = view.camera
        self.T_cw: Float[Tensor, "4 4"] = torch.from_numpy(view.T_cw).float().to(device)
        """World to camera, float32."""
        self.image: Float[Tensor, "h w 3"] = torch.from_numpy(view.image).to(device).float() / 255
        """RGB in [0, 1]."""
        self.mask: Bool[Tensor, "h w 1"] | None = None
        """Pixels that count; none where all do."""
        if view.mask is not None:
            self.mask = torch.from_numpy(view.mask).to(device)[..., None]

    def target(self, background: Float[Tensor, "3"] | None) -> Float[Tensor, "h w 3"]:
        """The image with the background outside the mask."""
        if self.mask is None or background is None:
            return self.image
        return torch.where(self.mask, self.image, background)
