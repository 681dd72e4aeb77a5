"""What the mapper keeps of a keyframe."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor

from geogs.config import LossConfig, MappingConfig
from geogs.depth.view import DenseDepth, DepthSearch, DepthView, Place, PosedDepth
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_inverse
from geogs.keyframes.archive import Archive
from geogs.losses.multi_view import PhotoView
from geogs.losses.single_view import OUTSIDE, ViewConstants
from geogs.mapping.view_maps import ParkedMaps, ResidentViews, ViewMaps
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


class MapView:
    """A keyframe with everything its losses need; the pose and the depths change over time.

    Of the views of one ``resident`` pool only those used last have their images and depths in
    memory; those of another come back when they are asked for. Pose, partners and where it is are
    always there.
    """

    def __init__(
        self,
        keyframe: Keyframe,
        cameras: MapCameras,
        loss: LossConfig,
        device: torch.device | str = "cpu",
        resident: ResidentViews | None = None,
    ) -> None:
        self.keyframe = keyframe
        self.partners: list[int] = []
        """Ids of the keyframes whose images check this one's depth, best first."""
        self.mask: Bool[Tensor, "h w"] | None = None
        """Pixels of the render size that belong to the scene; none takes all. On the map's device.
        """
        self.search: DepthSearch | None = None
        """Where its depth is searched; none leaves that to the tracker's depth."""
        self._cameras, self._loss, self.device = cameras, loss, torch.device(device)
        self._resident = resident
        self._parked = ParkedMaps()
        self._is_depth_parked = self._is_render_parked = True
        self._maps: ViewMaps | None = None
        self._grid = self._take_grid(keyframe)
        self._held()

    @staticmethod
    def of(
        keyframe: Keyframe,
        cameras: MapCameras,
        loss: LossConfig,
        device: torch.device | str = "cpu",
        resident: ResidentViews | None = None,
    ) -> "MapView":
        """The view of a keyframe that the tracker settled, for a map on ``device``."""
        return MapView(keyframe, cameras, loss, device, resident)

    @property
    def id(self) -> int:
        """The keyframe's id."""
        return self.keyframe.id

    @property
    def is_resident(self) -> bool:
        """Whether its images are in memory."""
        return self._maps is not None

    @property
    def has_depth(self) -> bool:
        """Whether its depth has been estimated."""
        maps = self._maps
        return (self._parked.depth if maps is None else maps.depth) is not None

    @property
    def depth_view(self) -> DepthView:
        """What the depth estimation needs."""
        maps, place, (inverse_depth, information) = self._held(), self.place, self._grid
        return DepthView(
            place.id, place.T_cw, maps.grey, maps.fine, maps.image, inverse_depth, information
        )

    @property
    def photo(self) -> PhotoView:
        """What the multi-view losses need."""
        T_cw = self.keyframe.T_cw.detach().double()
        return PhotoView(self._held().photo, self._cameras.photo, T_cw)

    @property
    def normal(self) -> Float[Tensor, "h w 3"] | None:
        """A monocular prior's normals N_f at the render size, where there are any and the losses
        count them; on the map's device."""
        return self._held().normal

    @property
    def depth(self) -> DenseDepth | None:
        """The dense depth, once estimated; a parked view stays parked."""
        if self._maps is not None:
            return self._maps.depth
        return self._parked.load_depth(self.device) if self.has_depth else None

    @property
    def dense(self) -> DenseDepth:
        """The dense depth, where there must be one."""
        depth = self.depth
        assert depth is not None, f"keyframe {self.id} has no depth yet"
        return depth

    @property
    def constants(self) -> ViewConstants | None:
        """What the single-view losses need; None until the keyframe has a depth."""
        maps = self._held()
        if maps.constants is None and maps.depth is not None:
            render, confidence = self._cameras.render, maps.depth.confidence
            maps.constants = ViewConstants.prepare(
                maps.image, render, self._prior_depth(maps.depth), confidence, maps.normal
            )
        return maps.constants

    @constants.setter
    def constants(self, constants: ViewConstants | None) -> None:
        self._held().constants = constants

    @property
    def known(self) -> ViewConstants:
        """The losses' constants, where there must be a depth."""
        constants = self.constants
        assert constants is not None, f"keyframe {self.id} has no depth yet"
        return constants

    @property
    def rendered_depth(self) -> Float[Tensor, "h w"] | None:
        """The map's last rendering from here, for occlusion tests by others."""
        return self._held().rendered_depth

    @rendered_depth.setter
    def rendered_depth(self, depth: Float[Tensor, "h w"] | None) -> None:
        self._is_render_parked = False
        if depth is None:
            self._parked.rendered_depth = None
        if self._maps is not None or depth is not None:
            self._held().rendered_depth = depth

    @property
    def typical_depth(self) -> float:
        """Median of the dense depth, map units."""
        return self._parked.typical if self._maps is None else self.dense.typical

    @property
    def tracked_depth(self) -> float:
        """Median depth of the cells that the tracker is fairly sure of, else of all."""
        inverse, information = self.keyframe.inverse_depth, self.keyframe.information
        z = 1 / inverse.clamp(min=1e-3)
        sure = z / information.clamp(min=1e-12).sqrt() < 0.2
        return float(z[sure].median() if int(sure.sum()) > 8 else z.median())

    @property
    def posed(self) -> PosedDepth:
        """The dense depth with the view's pose, where there must be one."""
        return PosedDepth(self.place.T_cw, self.dense)

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
        # The image that an archive already has for us is the one to keep.
        keyframe = replace(
            keyframe,
            stored_image=self.keyframe.stored_image,
            stored_normal=self.keyframe.stored_normal,
        )
        self.keyframe = keyframe
        self._grid = self._take_grid(keyframe)

    def keep_within(self, mask: Bool[np.ndarray, "h w"]) -> None:
        """No depth outside a mask of the size of the image: pixels that lie mostly outside it."""
        render = self._cameras.render
        size = (render.width, render.height)
        share = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        self.mask = torch.from_numpy(share > 0.5).to(self.device)

    def move(self, T_cw: Float[Tensor, "4 4"]) -> None:
        """Take over a new pose alone."""
        self.follow(replace(self.keyframe, T_cw=T_cw))

    def expect(self, search: DepthSearch) -> None:
        """Search the depth there; the grid says only what is usual, and next to nothing of that."""
        self.search = search
        grid = np.full_like(self._grid[0], 1.0 / search.typical)
        self._grid = (grid, np.full_like(grid, (search.typical / UNSURE) ** 2))

    def set_depth(self, depth: DenseDepth, cameras: MapCameras) -> None:
        """Take over a dense depth, on which the losses' constants then live."""
        if self.mask is not None:
            depth = depth.within(self.mask)
        maps = self._maps
        if maps is None and self._resident is not None:
            self._parked.keep_depth(depth, self._resident.archive)
            return
        self._is_depth_parked = False
        maps = self._held()
        maps.depth = depth
        if maps.constants is not None:
            prior = self._prior_depth(depth).float()
            maps.constants = replace(
                maps.constants, prior_depth=prior, confidence=depth.confidence.float()
            )

    def rescale(self, factor: float, cameras: MapCameras) -> None:
        """Multiply the dense depth, after the map's unit changed around this keyframe."""
        if factor == 1.0 or not self.has_depth:
            return
        if self._maps is None:
            self._parked.factor *= factor
            self._parked.typical *= factor
        else:
            self.set_depth(self.dense.scaled(factor), cameras)

    def park(self, archive: Archive) -> None:
        """Leave the memory; what has changed since the last time is archived."""
        self._store(archive)
        self._maps = None

    def keep(self) -> None:
        """Archive what has changed, as for a checkpoint; the view stays in memory."""
        assert self._resident is not None, "a view without a pool has no archive"
        self._store(self._resident.archive)

    def __getstate__(self) -> dict[str, object]:
        """What a checkpoint holds of a view that is kept; its maps come back when asked for."""
        return {**self.__dict__, "_maps": None}

    def _store(self, archive: Archive) -> None:
        maps = self._maps
        if maps is None:
            return
        if not self._is_depth_parked and maps.depth is not None:
            self._parked.keep_depth(maps.depth, archive)
        if not self._is_render_parked and maps.rendered_depth is not None:
            self._parked.rendered_depth = archive.put(maps.rendered_depth.cpu().numpy())
        self._is_depth_parked = self._is_render_parked = True

    def _held(self) -> ViewMaps:
        """The maps in memory, which were brought back if need be."""
        maps = self._maps
        if maps is None:
            c = self._cameras
            maps = ViewMaps.of(self.keyframe, c.render, c.photo, self._loss, self.device)
            if self._parked.depth is not None:
                maps.depth = self._parked.load_depth(self.device)
            if self._parked.rendered_depth is not None:
                rendered = torch.from_numpy(self._parked.rendered_depth.load())
                maps.rendered_depth = rendered.to(self.device)
            # A factor has been multiplied in; the archived depth stays as it is.
            self._is_depth_parked = self._is_render_parked = True
            self._maps = maps
        if self._resident is not None:
            self._resident.use(self)
        return maps

    def _take_grid(
        self, keyframe: Keyframe
    ) -> tuple[Float32[np.ndarray, "gh gw"], Float32[np.ndarray, "gh gw"]]:
        """Note where the view is; returns the tracker's inverse depth and its information."""
        self.place = Place(keyframe.id, keyframe.T_cw.detach().cpu().numpy().astype(np.float64))
        """Where it was taken; always in memory."""
        return (
            keyframe.inverse_depth.detach().cpu().numpy().astype(np.float32, copy=False),
            keyframe.information.detach().cpu().numpy().astype(np.float32, copy=False),
        )

    def _prior_depth(self, depth: DenseDepth) -> Float[Tensor, "h w"]:
        return depth.depth if self.mask is None else torch.where(self.mask, depth.depth, OUTSIDE)
