"""What mapping knows of a keyframe."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.config import DepthSensorConfig
from geogs.depth.view import DenseDepth, DepthSearch, DepthView, Place, PosedDepth
from geogs.geometry.lie import se3_inverse
from geogs.losses.light import same_light
from geogs.losses.multi_view import PhotoView
from geogs.losses.single_view import ViewConstants
from geogs.mapping.view_pool import ViewPool
from geogs.priors.depth_sensor import sensor_depth
from geogs.world.keyframes import Keyframe

UNSURE = 1e3
"""Relative deviation of a depth that is nobody's measurement: it outweighs nothing."""


@dataclass(eq=False)
class MapView:
    """A keyframe with who checks it: pose and scale are the keyframe's, its maps the pool's."""

    keyframe: Keyframe
    pool: ViewPool
    partners: list[int] = field(default_factory=list)
    """Ids of the keyframes whose images check this one's depth, best first."""
    search: DepthSearch | None = None
    """Where its depth is searched; none leaves that to the tracker's depth."""

    @property
    def id(self) -> int:
        """The keyframe's id."""
        return self.keyframe.id

    @property
    def T_cw(self) -> Float[Tensor, "4 4"]:
        """World to camera, float64."""
        return self.keyframe.T_cw

    @property
    def T_wc(self) -> Float[Tensor, "4 4"]:
        """Camera to world, float64."""
        return se3_inverse(self.T_cw)

    @property
    def place(self) -> Place:
        """Where it was taken."""
        return Place(self.id, self.T_cw.numpy())

    @property
    def mask(self) -> Bool[Tensor, "h w"] | None:
        """Pixels of the render size that belong to the scene; none takes all."""
        return self.pool.mask(self.id)

    @property
    def depth_view(self) -> DepthView:
        """What the depth estimation needs."""
        maps, (inverse_depth, information) = self.pool.maps(self.id), self.keyframe.depth_field()
        grey, fine = self.pool.depth_images(self.id)
        if self.search is not None:  # the grid says only what is usual, and next to nothing of that
            inverse_depth = np.full_like(inverse_depth, 1.0 / self.search.typical)
            information = np.full_like(inverse_depth, (self.search.typical / UNSURE) ** 2)
        return DepthView(
            self.id, self.T_cw.numpy(), grey, fine, maps.image, inverse_depth, information
        )

    def sensed(
        self, config: DepthSensorConfig
    ) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]] | None:
        """What a sensor measured at the render size: inverse depth and its information, map units.

        On the map's device; None where it did not.
        """
        if self.keyframe.measured is None or (metres := self.keyframe.sensor_depth) is None:
            return None
        render, scale = self.pool.cameras.render, self.keyframe.scale
        found = sensor_depth(metres, config).resized(render.width, render.height)
        inverse_depth, information = found.tensors(self.pool.device)
        return inverse_depth / scale, information * scale**2

    @property
    def photo(self) -> PhotoView:
        """What the multi-view losses need."""
        return PhotoView.of(self.pool.maps(self.id).photo, self.pool.cameras.photo, self.T_cw)

    @property
    def light(self) -> Float[Tensor, "2"]:
        """Gain and offset that its photo has had."""
        light = self.pool.light(self.id)
        return same_light(self.pool.device) if light is None else light

    @property
    def is_levelled(self) -> bool:
        """Whether its photo has been brought into the light of all."""
        return self.pool.light(self.id) is not None

    @property
    def has_depth(self) -> bool:
        """Whether its depth has been estimated."""
        return self.pool.has_depth(self.id)

    @property
    def dense(self) -> DenseDepth:
        """The dense depth, where there must be one."""
        depth = self.pool.depth(self.id)
        assert depth is not None, f"keyframe {self.id} has no depth yet"
        return depth

    @property
    def posed(self) -> PosedDepth:
        """The dense depth with the view's pose, where there must be one."""
        return PosedDepth(self.T_cw.numpy(), self.dense)

    @property
    def typical_depth(self) -> float:
        """Median of the dense depth, map units."""
        return self.pool.typical_depth(self.id)

    @property
    def tracked_depth(self) -> float:
        """Median depth of the cells that the tracker is fairly sure of, else of all."""
        z = 1 / self.keyframe.inverse_depth.clamp(min=1e-3)
        information = self.keyframe.confident_information
        sure = z / information.clamp(min=1e-12).sqrt() < 0.2
        return float(z[sure].median() if int(sure.sum()) > 8 else z.median())

    @property
    def constants(self) -> ViewConstants | None:
        """What the single-view losses need; None until the keyframe has a depth."""
        return self.pool.constants(self.id)

    @property
    def known(self) -> ViewConstants:
        """The losses' constants, where there must be a depth."""
        constants = self.constants
        assert constants is not None, f"keyframe {self.id} has no depth yet"
        return constants

    @property
    def rendered_depth(self) -> Float[Tensor, "h w"] | None:
        """The map's last rendering from here, for occlusion tests by others."""
        return self.pool.maps(self.id).rendered_depth

    @rendered_depth.setter
    def rendered_depth(self, depth: Float[Tensor, "h w"] | None) -> None:
        self.pool.set_rendered_depth(self.id, depth)
