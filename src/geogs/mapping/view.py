"""What the mapper keeps of a keyframe."""

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.config import LossConfig, MappingConfig
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_inverse
from geogs.losses.multi_view import PhotoView
from geogs.losses.single_view import OUTSIDE, ViewConstants
from geogs.mapping.depth_view import DenseDepth, DepthSearch, DepthView, PosedDepth, depth_view
from geogs.types import Keyframe

UNSURE = 1e3
"""Relative deviation of a depth that is nobody's measurement: it outweighs nothing."""


@dataclass(frozen=True)
class MapCameras:
    """One camera at the three sizes that mapping works with."""

    working: Camera
    """Of the images as the tracker sees them."""
    render: Camera
    """Of the rendered maps and keyframe depths."""
    photo: Camera
    """Of the images that L_mv compares."""

    @staticmethod
    def of(camera: Camera, config: MappingConfig) -> "MapCameras":
        """The sizes that the settings ask for, none above the working image."""
        working = max(camera.width, camera.height)
        long_edge = min(config.render_long_edge, working)
        photo = min(round(config.photo_scale * long_edge), working)
        return MapCameras(camera, camera.with_long_edge(long_edge), camera.with_long_edge(photo))


@dataclass
class MapView:
    """A keyframe with everything its losses need; the pose and the depths change over time."""

    keyframe: Keyframe
    depth_view: DepthView
    photo: PhotoView
    depth: DenseDepth | None = None
    constants: ViewConstants | None = None
    """None until the keyframe has a depth."""
    rendered_depth: Float[Tensor, "h w"] | None = None
    """The map's last rendering from here, for occlusion tests by others."""
    partners: list[int] = field(default_factory=list)
    """Ids of the keyframes whose images check this one's depth, best first."""
    mask: Bool[Tensor, "h w"] | None = None
    """Pixels of the render size that belong to the scene; none takes all. On the map's device."""
    search: DepthSearch | None = None
    """Where its depth is searched; none leaves that to the tracker's depth."""
    normal: Float[Tensor, "h w 3"] | None = None
    """A monocular prior's normals N_f at the render size, where there are any and the losses count
    them; on the map's device."""

    @staticmethod
    def of(
        keyframe: Keyframe,
        cameras: MapCameras,
        loss: LossConfig,
        device: torch.device | str = "cpu",
    ) -> "MapView":
        """The view of a keyframe that the tracker settled, for a map on ``device``."""
        image, T_cw = keyframe.image, keyframe.T_cw
        return MapView(
            keyframe,
            depth_view(keyframe, cameras.render),
            PhotoView.prepare(image, cameras.photo, T_cw, loss.photo_blur, device),
            normal=_shrunk_normal(keyframe, cameras.render, device) if loss.normal_weight else None,
        )

    @property
    def id(self) -> int:
        """The keyframe's id."""
        return self.keyframe.id

    @property
    def dense(self) -> DenseDepth:
        """The dense depth, where there must be one."""
        assert self.depth is not None, f"keyframe {self.id} has no depth yet"
        return self.depth

    @property
    def known(self) -> ViewConstants:
        """The losses' constants, where there must be a depth."""
        assert self.constants is not None, f"keyframe {self.id} has no depth yet"
        return self.constants

    @property
    def typical_depth(self) -> float:
        """Median of the dense depth, map units."""
        return self.dense.typical

    @property
    def posed(self) -> PosedDepth:
        """The dense depth with the view's pose, where there must be one."""
        return PosedDepth(self.depth_view.T_cw, self.dense)

    @property
    def T_cw(self) -> Float[Tensor, "4 4"]:
        """World to camera, float64."""
        return self.keyframe.T_cw

    @property
    def T_wc(self) -> Float[Tensor, "4 4"]:
        """Camera to world, float64."""
        return se3_inverse(self.keyframe.T_cw)

    def follow(self, keyframe: Keyframe) -> None:
        """Take over the tracker's new pose and grid depth."""
        if keyframe is self.keyframe:
            return
        self.keyframe = keyframe
        self.depth_view = replace(
            self.depth_view,
            T_cw=keyframe.T_cw.cpu().numpy(),
            inverse_depth=keyframe.inverse_depth.cpu().numpy(),
            information=keyframe.information.cpu().numpy(),
        )
        self.photo = self.photo.at(keyframe.T_cw)

    def move(self, T_cw: Float[Tensor, "4 4"]) -> None:
        """Take over a new pose alone."""
        self.follow(replace(self.keyframe, T_cw=T_cw))

    def expect(self, search: DepthSearch) -> None:
        """Search the depth there; the grid says only what is usual, and next to nothing of that."""
        self.search = search
        grid = np.full_like(self.depth_view.inverse_depth, 1.0 / search.typical)
        information = np.full_like(grid, (search.typical / UNSURE) ** 2)
        self.depth_view = replace(self.depth_view, inverse_depth=grid, information=information)

    def set_depth(self, depth: DenseDepth, cameras: MapCameras) -> None:
        """Take over a dense depth, on which the losses' constants then live."""
        if self.mask is not None:
            depth = depth.within(self.mask)
        self.depth = depth
        prior = depth.depth
        if self.mask is not None:
            prior = torch.where(self.mask, prior, OUTSIDE)
        if self.constants is None:
            self.constants = ViewConstants.prepare(
                self.keyframe.image, cameras.render, prior, depth.confidence, self.normal
            )
        else:
            self.constants = replace(self.constants, prior_depth=prior, confidence=depth.confidence)

    def rescale(self, factor: float, cameras: MapCameras) -> None:
        """Multiply the dense depth, after the map's unit changed around this keyframe."""
        if self.depth is not None and factor != 1.0:
            self.set_depth(self.depth.scaled(factor), cameras)


def _shrunk_normal(
    keyframe: Keyframe, render: Camera, device: torch.device | str
) -> Float[Tensor, "h w 3"] | None:
    """A keyframe's prior normals, averaged over the pixels of the render; zero where they differ.

    An average shorter than a half comes from an edge or from pixels that are not known.
    """
    if keyframe.normal is None:
        return None
    size = (render.width, render.height)
    full = keyframe.normal.detach().cpu().float().numpy()
    mean = cv2.resize(full, size, interpolation=cv2.INTER_AREA)
    length = np.linalg.norm(mean, axis=-1, keepdims=True)
    unit = np.where(length > 0.5, mean / np.maximum(length, 1e-6), 0.0)
    return torch.from_numpy(unit.astype(np.float32)).to(device)
