"""Input of scale estimation: a map that can be rendered, and its keyframes' images."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64, UInt8

from geogs.geometry.camera import Camera
from geogs.mapping.rendered import MapRenderer
from geogs.types import MetricScale, Trajectory

Surface = Callable[[Float64[np.ndarray, "4 4"]], Float64[np.ndarray, "h w"]]
"""Depth of the map seen from a pose (world to camera), 0 where unknown, map units."""


@dataclass(frozen=True, eq=False)
class SeenKeyframe:
    """One image of the map."""

    T_cw: Float64[np.ndarray, "4 4"]
    image: UInt8[np.ndarray, "h w 3"] | None
    """RGB, at the size of the scene's camera."""


@dataclass(frozen=True, eq=False)
class MeasurableScene:
    """A map whose unit is to be estimated."""

    camera: Camera
    """Camera of the images."""
    depth_camera: Camera
    """Camera of the depths."""
    keyframes: Sequence[SeenKeyframe]
    trajectory: Trajectory
    """Poses of all frames."""
    surface: Surface

    def points(
        self, T_cw: Float64[np.ndarray, "4 4"]
    ) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"]]:
        """World points of the surface seen from a pose, and their rays in the camera."""
        depth = self.surface(T_cw)
        rays = self.depth_camera.rays(torch.float64).numpy()[depth > 0]
        points = rays * depth[depth > 0][:, None]
        return (points - T_cw[:3, 3]) @ T_cw[:3, :3], rays


def measurable(
    camera: Camera, renderer: MapRenderer, keyframes: Sequence[SeenKeyframe], trajectory: Trajectory
) -> MeasurableScene:
    """Make a scene of ``renderer``'s map and its keyframes, whose images are of ``camera``."""

    def surface(T_cw: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, "h w"]:
        return renderer.surface(torch.from_numpy(T_cw)).depth.double().cpu().numpy()

    return MeasurableScene(camera, renderer.camera, keyframes, trajectory, surface)


def scale_sentence(found: MetricScale) -> str:
    """A sentence on the estimated scale."""
    metres = f"{found.factor:.5g} metres to the map unit (+- {found.deviation:.1%})"
    return f"Scale: {metres}, by {found.origin}."
