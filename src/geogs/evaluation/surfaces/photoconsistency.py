"""Photo-consistency of images on a surface: a measure for real scenes without a true surface."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from geogs.errors import InputError
from geogs.evaluation.surfaces.raster import render_mesh
from geogs.evaluation.surfaces.surface import Surface
from geogs.geometry.camera import Camera
from geogs.io.sources.posed.posed_source import PosedImage
from geogs.threads import on_one_torch_thread, thread_map

_LEAST_ANGLE, _BEST_ANGLE, _MOST_ANGLE = 4.0, 12.0, 30.0
_NEIGHBOURS, _WINDOW = 4, 9
"""Largest number of neighbours of a view; side of the correlation window, pixels, odd."""
_TEXTURE = 4.0
_OCCLUSION = 0.005
_NOISE = 1.0


@dataclass(frozen=True)
class PhotoScores:
    """Photometric consistency of a surface."""

    score: float
    """Mean over the textured pixels of the masks of NCC, at least 0, and 0 where not covered, %."""
    ncc_mean: float
    """Mean over covered textured pixels."""
    ncc_median: float
    coverage: float
    """Percentage of the masks that the surface covers and a neighbour sees."""
    views: int
    """Number of evaluated views."""
    pairs: int
    """Number of pairs of a view and a neighbour."""
    textured: float
    """Percentage of the masks with enough texture."""
    window: int
    """Side of the correlation window, pixels."""
    width: int
    """Width of the images, pixels."""

    def rows(self) -> list[tuple[str, str]]:
        """Rows of a table."""
        return [
            ("score, holes count 0 (%)", f"{self.score:.2f}"),
            (
                f"  NCC {self.window}x{self.window}, mean / median",
                f"{self.ncc_mean:.4f} / {self.ncc_median:.4f}",
            ),
            ("  coverage of the masks (%)", f"{self.coverage:.2f}"),
            ("  views / pairs", f"{self.views} / {self.pairs}"),
        ]


class _Agreement(NamedTuple):
    """Agreement of one view with its neighbours."""

    ncc: Float32[np.ndarray, "k"]
    """NCC at the textured pixels of the mask, as the mean over the neighbours that see a pixel; NaN
    where none sees it."""
    covered: int
    """Number of covered pixels of the mask."""
    in_mask: int
    """Number of pixels of the mask."""


@on_one_torch_thread
def evaluate_photoconsistency(
    mesh: Surface, camera: Camera, views: Sequence[PosedImage], held_out: Sequence[int]
) -> PhotoScores:
    """Measure how well a mesh explains held-out photographs by others, without any true surface.

    For a held-out view r and each of its neighbours t (:func:`choose_neighbours`) the mesh's
    depth in r maps a pixel of r to t. It is visible there if it projects into the image
    and lies at most half a percent behind the mesh's depth in t (the largest of the four pixels
    around it). A pixel of r's mask is covered if the mesh has a depth there that is visible in at
    least one t.

    The grey image of t, warped into r by these depths, is compared with that of r by normalised
    cross-correlation over square windows, using only pixels where both are known, at least half
    of the window. NCC = cov / sqrt((var_r + n)(var_t + n)) with n = 1 grey level squared, so that
    noise on plain surfaces does not count. Several neighbours are averaged. Texture is tested in r
    alone (standard deviation in the window above 4 of 255 grey levels), so it is the same for
    every mesh. All pixels of all views have equal weight, and nothing is random.

    ``score`` is the mean of max(NCC, 0) over all textured pixels of the masks, with 0 for those
    without an NCC: neither holes nor extrapolated surfaces can increase it.

    Args:
        mesh: the mesh, in the world of the poses.
        camera: camera of all views.
        views: photographs with true poses, and masks of the object where they have any.
        held_out: indices of the views to evaluate; the neighbours may be any.

    Raises:
        InputError: no view has a neighbour, or there is no textured pixel.
    """
    pairs = {r: choose_neighbours(r, [v.T_cw for v in views], _NEIGHBOURS) for r in held_out}
    pairs = {r: near for r, near in pairs.items() if near}
    if not pairs:
        raise InputError(
            f"No view sees the scene from another side than others ({_LEAST_ANGLE:g} to "
            f"{_MOST_ANGLE:g} degrees), which photoconsistency needs."
        )
    needed = sorted(set(pairs).union(*pairs.values()))
    depths = dict(
        zip(needed, thread_map(lambda i: _depth(mesh, camera, views[i]), needed), strict=True)
    )
    agreements = thread_map(lambda r: _agreement(r, pairs[r], views, depths, camera), sorted(pairs))
    return _scores(agreements, sum(map(len, pairs.values())), camera)


def choose_neighbours(r: int, T_cw: Sequence[Float[np.ndarray, "4 4"]], most: int) -> list[int]:
    """Choose views that see the region of view ``r`` from another side, by their poses alone.

    The optical axes make an angle of 4 to 30 degrees, and come nearest to each other in front of
    both cameras; those nearest to 12 degrees are taken.
    """
    own = np.linalg.inv(T_cw[r])
    found = []
    for t in range(len(T_cw)):
        other = np.linalg.inv(T_cw[t])
        angle = np.degrees(np.arccos(np.clip(own[:3, 2] @ other[:3, 2], -1, 1)))
        if t != r and _LEAST_ANGLE <= angle <= _MOST_ANGLE and _converge(own, other):
            found.append((abs(angle - _BEST_ANGLE), t))
    return [t for _, t in sorted(found)[:most]]


def _converge(a: Float[np.ndarray, "4 4"], b: Float[np.ndarray, "4 4"]) -> bool:
    """Whether the optical axes come nearest in front of both cameras (camera to world)."""
    axes = np.stack([a[:3, 2], -b[:3, 2]], -1)
    along = np.linalg.lstsq(axes, b[:3, 3] - a[:3, 3], rcond=None)[0]
    return bool((along > 0).all())


def _depth(mesh: Surface, camera: Camera, view: PosedImage) -> Float32[np.ndarray, "h w"]:
    return render_mesh(mesh.vertices, mesh.faces, camera, view.T_cw)[0].astype(np.float32)


def _grey(image: UInt8[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w"]:
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)


def _agreement(
    r: int,
    near: list[int],
    views: Sequence[PosedImage],
    depths: dict[int, Float32[np.ndarray, "h w"]],
    camera: Camera,
) -> _Agreement:
    view = views[r]
    depth = depths[r]
    grey = _grey(view.image)
    mask = np.ones(depth.shape, bool) if view.mask is None else view.mask
    known = np.isfinite(depth) & mask
    total = np.zeros_like(depth)
    count = np.zeros_like(depth)
    covered = np.zeros(depth.shape, bool)
    for t in near:
        place, z = _transfer(depth, known, camera, view.T_cw, views[t].T_cw)
        visible = known & _visible(place, z, depths[t])
        warped = cv2.remap(_grey(views[t].image), place[..., 0], place[..., 1], cv2.INTER_LINEAR)
        ncc = _ncc(grey, warped, visible)
        use = visible & np.isfinite(ncc)
        total[use] += ncc[use]
        count[use] += 1
        covered |= visible
    ncc = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    mean = cv2.blur(grey, (_WINDOW, _WINDOW))
    variance = cv2.blur(grey * grey, (_WINDOW, _WINDOW)) - mean * mean
    textured = mask & (variance > _TEXTURE**2)
    return _Agreement(ncc[textured], int((covered & mask).sum()), int(mask.sum()))


def _transfer(
    depth: Float32[np.ndarray, "h w"],
    known: Bool[np.ndarray, "h w"],
    camera: Camera,
    T_rw: Float[np.ndarray, "4 4"],
    T_tw: Float[np.ndarray, "4 4"],
) -> tuple[Float32[np.ndarray, "h w 2"], Float32[np.ndarray, "h w"]]:
    """Position of each known pixel of r in t, and its depth there; far outside where unknown."""
    T = T_tw @ np.linalg.inv(T_rw)
    rays = camera.rays().numpy()[known].astype(np.float64)
    x, y, z = T[:3, :3] @ (rays * depth[known][:, None]).T + T[:3, 3:]
    front = z > 0
    safe = np.where(front, z, 1.0)
    place = np.full((*depth.shape, 2), -10.0, np.float32)
    at = np.stack([camera.fx * x / safe + camera.cx, camera.fy * y / safe + camera.cy], -1)
    place[known] = np.where(front[:, None], at, -10.0).clip(-10, 1e6)
    distance = np.zeros(depth.shape, np.float32)
    distance[known] = z
    return place, distance


def _visible(
    place: Float32[np.ndarray, "h w 2"],
    z: Float32[np.ndarray, "h w"],
    depth: Float32[np.ndarray, "h w"],
) -> Bool[np.ndarray, "h w"]:
    """Whether points are inside the image and not behind the mesh's depth there."""
    height, width = depth.shape
    u, v = place[..., 0], place[..., 1]
    inside = (u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1)
    left = np.where(inside, u, 0).astype(np.int64).clip(0, width - 2)
    top = np.where(inside, v, 0).astype(np.int64).clip(0, height - 2)
    around = [depth[top + i, left + j] for i in (0, 1) for j in (0, 1)]
    return np.asarray(inside & (z <= np.max(around, axis=0) * (1 + _OCCLUSION)))


def _ncc(
    a: Float32[np.ndarray, "h w"], b: Float32[np.ndarray, "h w"], valid: Bool[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w"]:
    """Normalised cross-correlation over the valid part of each window; NaN where that is small."""
    weight = valid.astype(np.float64)
    # Centred, so that the differences of squares keep their precision.
    a, b = (a.astype(np.float64) - 128) * weight, (b.astype(np.float64) - 128) * weight

    def box(values: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
        return cv2.boxFilter(values, -1, (_WINDOW, _WINDOW), borderType=cv2.BORDER_CONSTANT)

    def mean(values: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
        return box(values) / np.maximum(fraction, 1e-9)

    fraction = box(weight)
    mean_a, mean_b = mean(a), mean(b)
    covariance = mean(a * b) - mean_a * mean_b
    variances = [np.maximum(mean(x * x) - m * m, 0) for x, m in ((a, mean_a), (b, mean_b))]
    ncc = covariance / np.sqrt((variances[0] + _NOISE) * (variances[1] + _NOISE))
    return np.where(fraction >= 0.5, ncc, np.nan).astype(np.float32)


def _scores(agreements: Sequence[_Agreement], pairs: int, camera: Camera) -> PhotoScores:
    textured = np.concatenate([a.ncc for a in agreements])
    in_masks = sum(a.in_mask for a in agreements)
    if not len(textured):
        raise InputError("The masks of the held-out views show no texture to compare.")
    known = textured[np.isfinite(textured)].astype(np.float64)
    return PhotoScores(
        score=100 * float(np.maximum(known, 0).sum() / len(textured)),
        ncc_mean=float(known.mean()) if len(known) else 0.0,
        ncc_median=float(np.median(known)) if len(known) else 0.0,
        coverage=100 * sum(a.covered for a in agreements) / in_masks,
        views=len(agreements),
        pairs=pairs,
        textured=100 * len(textured) / in_masks,
        window=_WINDOW,
        width=camera.width,
    )
