"""Selection of the photometric partners of keyframes, and compensation of their exposure."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import grid_sample

from geogs.config import PhotoConfig
from geogs.depth.sweep_neighbors import view_pairs
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_inverse
from geogs.gpu.transfer import to_device
from geogs.losses.exposure import identity_exposure, noise_between, relative_exposure
from geogs.mapping.keyframe_views import KeyframeViews, MapView
from geogs.world.map import MapTable

BEST_PARALLAX_DEG = 8.0
"""Preferred parallax: smaller ones constrain depth less, larger ones change appearance more."""
MIN_PARALLAX_DEG, MAX_PARALLAX_DEG = 2.0, 25.0
"""Least and largest parallax of partners."""
CANDIDATES = 128
"""Nearest keyframes among which neighbours and partners are chosen."""
_STRIDE = 4
"""Stride over the compared pixels of a dense depth, in both directions."""
_CONFIDENT = 0.3
"""Least confidence of its depth."""
_DARK, _BRIGHT = 0.02, 0.98
"""Grey values beyond which a sensor is saturated."""


class Partners:
    """Chooses the photometric partners of mapped views and compensates their exposure."""

    def __init__(self, views: KeyframeViews, table: MapTable, config: PhotoConfig) -> None:
        self._views = views
        self._table = table
        self._config = config

    def choose(self, views: Sequence[MapView]) -> None:
        """Partners of some mapped views, then their exposures."""
        for view in views:
            self._choose(view)
        for view in views:
            self._compensate(view)

    def _choose(self, view: MapView) -> None:
        """Choose the partners of a view, which becomes a candidate of theirs."""
        near = self._views.near(view, self._table.mapped, CANDIDATES)
        view.row.partners = choose_partners(view, near, self._config)
        for i in view.row.partners:
            other = self._views[i]
            ids = {*other.row.partners, view.id}
            pool = [self._views[j] for j in ids if j in self._views]
            other.row.partners = choose_partners(other, pool, self._config)

    def _compensate(self, view: MapView) -> None:
        """Bring a view to the exposure of those partners whose exposure is known."""
        if view.row.exposure is not None or not self._config.compensate_exposure:
            return
        partners = [self._views[i] for i in view.row.partners]
        known = [other for other in partners if other.row.exposure is not None]
        view.set_exposure(exposure_of(view, known))


def choose_partners(view: MapView, others: list[MapView], config: PhotoConfig) -> list[int]:
    """Ids of the keyframes best placed to check a view's depth by photo-consistency, best first."""
    others = [o for o in others if o.id != view.id]
    if not others:
        return []
    poses = [o.view_pose for o in others]
    camera = view.arrays.cameras.render
    pairs = view_pairs(view.view_pose, poses, view.typical_depth, camera)
    usable = pairs.usable(MIN_PARALLAX_DEG, MAX_PARALLAX_DEG, config.max_view_angle)
    scores = pairs.misfit(BEST_PARALLAX_DEG)
    scored = sorted((scores[i], o.id) for i, o in enumerate(others) if usable[i])
    return [i for _, i in scored[: config.candidates]]


def exposure_of(view: MapView, others: Sequence[MapView]) -> Float[Tensor, "3"]:
    """Gain and offset that bring the grey values of a view to those of others, and its noise.

    The others' exposure is already compensated. The view's dense depth gives the positions of its
    pixels in them. Without others: gain 1, offset 0 and the default noise.
    """
    if not others:
        return identity_exposure(view.dense.depth.device)
    points, confident = _sparse_points(view)
    (mine, texture), (inside, _) = _sampled(
        torch.stack([view.photo.grey, view.photo.texture]),
        view.photo.camera,
        points.expand(2, -1, -1),
    )
    usable = confident & inside & _is_exposed(mine)
    T_cw = torch.stack([other.T_cw for other in others]).cpu()
    T = to_device((T_cw @ se3_inverse(view.T_cw).to(T_cw)).to(points.dtype), points.device)
    greys = torch.stack([other.photo.grey for other in others])
    there = points @ T[:, :3, :3].mT + T[:, None, :3, 3]
    theirs, inside = _sampled(greys, view.photo.camera, there)
    gain, offset, _ = torch.stack([other.exposure for other in others])[..., None].unbind(1)
    common = (usable & inside & _is_exposed((theirs - offset) / gain)).flatten()
    mine = mine.repeat(len(others))
    texture = texture.repeat(len(others))
    gain, offset = relative_exposure(mine, theirs.flatten(), common)
    noise = noise_between(gain * mine + offset, theirs.flatten(), texture, common)
    return torch.stack([gain, offset, noise])


def _sparse_points(view: MapView) -> tuple[Float[Tensor, "n 3"], Bool[Tensor, "n"]]:
    """Points in a view's camera of every ``_STRIDE``-th pixel, and whether each is confident."""
    depth = view.dense
    rays = view.arrays.cameras.render.rays(device=depth.depth.device)[::_STRIDE, ::_STRIDE]
    points = rays * depth.depth[::_STRIDE, ::_STRIDE, None]
    confident = depth.confidence[::_STRIDE, ::_STRIDE] > _CONFIDENT
    return points.reshape(-1, 3), confident.reshape(-1)


def _sampled(
    greys: Float[Tensor, "k h w"], camera: Camera, points: Float[Tensor, "k n 3"]
) -> tuple[Float[Tensor, "k n"], Bool[Tensor, "k n"]]:
    """Grey value of each image at points in its camera, and whether they are inside."""
    ahead = points[..., 2] > 1e-6
    pixels, _ = camera.project(points)
    edges = (camera.width - 1, camera.height - 1)
    place = torch.stack([pixels[..., k] * (2 / edges[k]) - 1 for k in (0, 1)], -1)
    inside = ahead & (place.abs() <= 1).all(-1)
    place = torch.where(inside[..., None], place, 0.0)
    shown = grid_sample(greys[:, None], place[:, None], align_corners=True)
    return shown[:, 0, 0], inside


def _is_exposed(grey: Float[Tensor, "*n"]) -> Bool[Tensor, "*n"]:
    return (grey > _DARK) & (grey < _BRIGHT)
