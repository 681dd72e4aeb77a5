"""Keyframes as mapping sees them: images, depths and constants for losses and depth search."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int32
from torch import Tensor

from geogs.depth.depth_view import DenseDepth, DepthView, PosedDepth, ViewPose, depth_images
from geogs.depth.revision.segment_planes import bare_segments
from geogs.geometry.lie import se3_inverse
from geogs.losses.exposure import identity_exposure
from geogs.losses.multi_view import PhotoView
from geogs.losses.single_view import ViewConstants
from geogs.mapping.view_arrays import ViewArrays
from geogs.world.keyframes import Keyframe
from geogs.world.map import ViewRow

UNKNOWN = 1e3
"""Relative standard deviation of an unmeasured depth."""


@dataclass(eq=False)
class MapView:
    """A keyframe with its row of the map's table, as losses and depth search need it."""

    id: int
    row: ViewRow
    arrays: ViewArrays

    @property
    def keyframe(self) -> Keyframe:
        """The keyframe, with its pose and scale."""
        return self.arrays.keyframes[self.id]

    @property
    def T_cw(self) -> Float[Tensor, "4 4"]:
        """World to camera, float64."""
        return self.keyframe.T_cw

    @property
    def T_wc(self) -> Float[Tensor, "4 4"]:
        """Camera to world, float64."""
        return se3_inverse(self.T_cw)

    @property
    def view_pose(self) -> ViewPose:
        """Its id and pose."""
        return ViewPose(self.id, self.T_cw.numpy())

    @property
    def mask(self) -> Bool[Tensor, "h w"] | None:
        """Pixels of the render size that belong to the scene; None for all."""
        return self.arrays.mask(self.id)

    @property
    def depth_view(self) -> DepthView:
        """The view for the depth estimation."""
        loaded = self.arrays.load(self.id)
        inverse_depth, information = self.keyframe.depth_field()
        if loaded.matched is None:
            loaded.matched = depth_images(loaded.image, self.arrays.cameras.render)
        if (
            search := self.row.search
        ) is not None:  # no tracker: the typical depth, hardly weighted
            inverse_depth = np.full_like(inverse_depth, 1.0 / search.typical)
            information = np.full_like(information, (search.typical / UNKNOWN) ** 2)
        return DepthView(
            self.id, self.T_cw.numpy(), *loaded.matched, loaded.image, inverse_depth, information
        )

    @property
    def bare_segments(self) -> Int32[np.ndarray, "sh sw"]:
        """Numbers of the bare parts of its image."""
        arrays = self.arrays.table.arrays
        return arrays.made(
            "bare segments", self.id, lambda: bare_segments(self.keyframe.straight_image)
        )

    @property
    def photo(self) -> PhotoView:
        """The view for the multi-view losses."""
        return self.arrays.load(self.id).photo.at(self.T_cw)

    @property
    def exposure(self) -> Float[Tensor, "3"]:
        """Gain and offset applied to its photo, and the variance of its noise."""
        known = self.row.exposure
        return identity_exposure(self.arrays.device) if known is None else known

    @property
    def has_depth(self) -> bool:
        """Whether its depth has been estimated."""
        loaded = self.arrays.loaded.peek(self.id)
        return (self.row.depth if loaded is None else loaded.depth) is not None

    @property
    def dense(self) -> DenseDepth:
        """The dense depth, which must exist; read from the file if it is not in memory."""
        return self.arrays.depth(self.id)

    @property
    def posed(self) -> PosedDepth:
        """The dense depth, which must exist, with the view's pose."""
        return PosedDepth(self.T_cw.numpy(), self.dense)

    @property
    def typical_depth(self) -> float:
        """Median of the dense depth, map units."""
        written = self.row.depth
        if self.id not in self.arrays.loaded and written is not None:
            return written.typical_at(self.keyframe.scale)
        return self.dense.typical

    @property
    def constants(self) -> ViewConstants:
        """Constants of the single-view losses; the keyframe must have a depth."""
        return self.arrays.constants(self.id)

    @property
    def rendered_depth(self) -> Float[Tensor, "h w"] | None:
        """The map's last rendering from here, for occlusion tests by others."""
        return self.arrays.load(self.id).rendered_depth

    @rendered_depth.setter
    def rendered_depth(self, depth: Float[Tensor, "h w"] | None) -> None:
        if depth is None:
            self.arrays.table.arrays.drop("rendered depth", self.id)
        if self.id in self.arrays.loaded or depth is not None:
            loaded = self.arrays.load(self.id)
            loaded.rendered_depth = depth
            loaded.is_render_written = False

    def set_depth(self, depth: DenseDepth) -> None:
        """Set the dense depth, and the losses' constants that depend on it."""
        self.arrays.set_depth(self.id, depth)

    def set_exposure(self, exposure: Float[Tensor, "3"]) -> None:
        """Set its exposure and noise, unknown until now, and compensate its photo."""
        self.row.exposure = exposure
        loaded = self.arrays.loaded.peek(self.id)
        if loaded is not None:
            loaded.photo = loaded.photo.with_exposure(exposure)


class KeyframeViews(Mapping[int, MapView]):
    """The views of a map by keyframe, in the order in which they were added."""

    def __init__(self, arrays: ViewArrays) -> None:
        self.arrays = arrays
        self._views = {id: MapView(id, row, arrays) for id, row in arrays.table.views.items()}

    def __getitem__(self, id: int) -> MapView:
        return self._views[id]

    def __iter__(self) -> Iterator[int]:
        return iter(self._views)

    def __len__(self) -> int:
        return len(self._views)

    def add(self, id: int, mask: Bool[np.ndarray, "h w"] | None = None) -> MapView:
        """Add a keyframe; it has no depth outside a mask of the size of its image."""
        if mask is not None:
            self.arrays.put_mask(id, mask)
        row = self.arrays.table.views[id] = ViewRow()
        view = self._views[id] = MapView(id, row, self.arrays)
        self.arrays.load(id)
        return view

    def near(self, view: MapView, ids: Collection[int], count: int) -> list[MapView]:
        """The ``count`` views among ``ids`` nearest to a view's camera, in the order of ``ids``;
        the view may be one of them."""
        if len(ids) > count:
            several = np.fromiter(ids, np.int64, len(ids))
            nearest = self.arrays.keyframes.poses.nearest(view.id, several, count)
            ids = several[np.isin(several, nearest, assume_unique=True)].tolist()
        return [self._views[i] for i in ids]
