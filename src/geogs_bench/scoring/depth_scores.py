"""Depth of a result's mesh against the true one in views of its sequence, by kind of region.

The mesh is rendered from the estimated poses, with one scale for the whole sequence, so that errors
of the trajectory, which other benchmarks measure, do not shift its edges. Kinds of region (edges,
thin things, bare walls) follow from the true depth and the image alone; a jump of depth is given as
a fraction of the farther depth: 1 - near / far.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, UInt8

from geogs.errors import InputError
from geogs.evaluation.surfaces.raster import render_mesh
from geogs.geometry.camera import Camera
from geogs_bench.data.benchmark_scene import BenchmarkScene
from geogs_bench.results.record import PLACES, Place, PlaceScore
from geogs_bench.results.result_folder import ResultFolder
from geogs_bench.scoring.true_depths import TrueView, pose_at, read_true_depths

VIEWS = 25
"""Approximate number of compared frames."""
NEAR = 0.02
"""Relative error of the stricter of both ratios."""
FAR = 0.05
"""Relative error of the other one, and of surfaces in front of the true one or behind it."""
JUMP = 0.05
"""Least jump of depth of an edge, and between a thin thing and its background."""
NEAR_EDGE = 5
"""Pixels to either side of a jump that belong to the edge."""
THIN = 13
"""Side of the square that does not fit into a thin thing, pixels."""
LONG = 20
"""Least length of a thin thing, pixels."""
BEHIND = 20
"""Pixels around a thin thing in which farther pixels count as behind it."""
BARE = 1.0
"""Largest gradient of a bare region: grey levels a pixel, root mean square over 9 x 9 pixels of the
smoothed image. Plain walls of photographs have 0.3 to 0.9, from shading and residual noise."""
GRAZING = 75.0
"""Least angle between the normal and the ray of a grazing view, degrees."""
_LONGEST_GAP = 32
"""Most pixels without depth across which a jump is detected: a sensor's shadow at an edge."""
_SMOOTHING = 2.0
"""Standard deviation of the blur that removes noise and JPEG's blocks, pixels."""
_PATCH = 9


@dataclass(frozen=True)
class PlaneFits:
    """The plane around every pixel, as its inverse depth: linear in the pixel's position."""

    value: Float64[np.ndarray, "h w"]
    """Inverse depth at the pixel; 1 where there is no plane."""
    right: Float64[np.ndarray, "h w"]
    """Growth of inverse depth to the next column; 0 where there is no plane."""
    down: Float64[np.ndarray, "h w"]
    """Growth of inverse depth to the next row; 0 where there is no plane."""
    is_known: Bool[np.ndarray, "h w"]
    """Mask: enough of the neighbourhood has depth."""
    is_good: Bool[np.ndarray, "h w"]
    """Mask: the neighbourhood is also planar."""

    def normals(self, camera: Camera) -> Float64[np.ndarray, "h w 3"]:
        """Unit normals in the camera's frame, away from it.

        With n . X = 1 on the plane, 1 / z = n . r on the ray r, so its slopes are n_x / f_x and
        n_y / f_y.
        """
        v, u = np.indices(self.value.shape)
        forward = self.value - self.right * (u - camera.cx) - self.down * (v - camera.cy)
        normal = np.stack([camera.fx * self.right, camera.fy * self.down, forward], -1)
        return np.asarray(normal / np.linalg.norm(normal, axis=-1, keepdims=True))

    def slant(self, camera: Camera) -> Float64[np.ndarray, "h w"]:
        """Angle between the normal and the pixel's ray, degrees."""
        rays = camera.rays().double().numpy()
        cosine = (self.normals(camera) * rays).sum(-1) / np.linalg.norm(rays, axis=-1)
        return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def fit_planes(depth: Float[np.ndarray, "h w"], side: int, tolerance: float) -> PlaneFits:
    """Fit planes by least squares over ``side`` x ``side`` pixels around each pixel.

    Args:
        depth: z; 0 or infinite where there is none.
        side: of the neighbourhood, odd, pixels.
        tolerance: largest RMS residual of a plane, as a fraction of the depth.
    """
    known = (depth > 0) & np.isfinite(depth)
    weight = known.astype(np.float64)
    w = np.where(known, 1 / np.where(known, depth, 1.0).astype(np.float64), 0.0)
    height, width = depth.shape
    u = np.tile(np.arange(width, dtype=np.float64), (height, 1))
    v = np.tile(np.arange(height, dtype=np.float64)[:, None], (1, width))

    def total(values: np.ndarray) -> np.ndarray:
        border = cv2.BORDER_CONSTANT
        return cv2.boxFilter(values, -1, (side, side), normalize=False, borderType=border)

    n = total(weight)
    safe = np.maximum(n, 1)
    mean_u, mean_v, mean_w = (total(weight * x) / safe for x in (u, v, w))

    def covariance(x: np.ndarray, y: np.ndarray, of_x: np.ndarray, of_y: np.ndarray) -> np.ndarray:
        return total(weight * x * y) / safe - of_x * of_y

    uu = covariance(u, u, mean_u, mean_u)
    vv = covariance(v, v, mean_v, mean_v)
    uv = covariance(u, v, mean_u, mean_v)
    uw = covariance(u, w, mean_u, mean_w)
    vw = covariance(v, w, mean_v, mean_w)
    determinant = uu * vv - uv * uv
    is_mostly_known = n >= 0.8 * side * side
    enough = known & is_mostly_known & (determinant > 0.01)
    safe_determinant = np.where(enough, determinant, 1.0)
    right = np.where(enough, (uw * vv - vw * uv) / safe_determinant, 0.0)
    down = np.where(enough, (vw * uu - uw * uv) / safe_determinant, 0.0)
    value = mean_w + right * (u - mean_u) + down * (v - mean_v)
    enough &= value > 0
    rest = covariance(w, w, mean_w, mean_w) - right * uw - down * vw
    good = enough & (rest < (tolerance * value) ** 2)
    return PlaneFits(
        np.where(enough, value, 1.0),
        np.where(enough, right, 0.0),
        np.where(enough, down, 0.0),
        enough,
        good,
    )


@dataclass(frozen=True)
class ComparedView:
    """A view with its true depth, the estimated depth, and the kinds of its regions."""

    view: TrueView
    found: Float32[np.ndarray, "h w"]
    """Estimated z in metres; infinite where the mesh has a hole."""
    places: dict[Place, Bool[np.ndarray, "h w"]]
    angle: Float32[np.ndarray, "h w"]
    """Angle between the normals, degrees; NaN where either is unknown."""


def score_depth(
    scene: BenchmarkScene, result: ResultFolder
) -> tuple[tuple[PlaceScore, ...], list[ComparedView]]:
    """The scores of every kind of region that occurs, and the compared views.

    Raises:
        InputError: the result has no mesh or no poses, or the sequence no true depth.
    """
    mesh = result.mesh()
    poses = result.poses()
    if mesh is None or not mesh.is_mesh or poses is None:
        raise InputError(f"{result.path} holds no mesh with a trajectory to score.")
    poses = poses.of("tracked")
    camera = result.camera
    truth = read_true_depths(scene, result, poses, VIEWS)
    depths = [
        render_mesh(mesh.vertices, mesh.faces, camera, np.linalg.inv(pose_at(poses, v.timestamp)))
        for v in truth.views
    ]
    found = one_scale([view.depth for view in truth.views], [depth for depth, _ in depths])
    # A sensor's noise needs larger planes for the normals that are compared.
    window, tolerance = (7, 0.003) if truth.is_exact else (21, 0.006)
    views = [
        compare_view(view, depth, (truth.camera, camera), window, tolerance)
        for view, depth in zip(truth.views, found, strict=True)
    ]
    return place_scores(views), views


def one_scale(
    true: Sequence[Float[np.ndarray, "h w"]], found: Sequence[Float[np.ndarray, "h w"]]
) -> list[Float32[np.ndarray, "h w"]]:
    """Scale the estimated depths to metres, by the median of true over estimated in all views.

    Raises:
        InputError: there is no pixel where both are known.
    """
    ratios = []
    for z, own in zip(true, found, strict=True):
        both = (z > 0) & np.isfinite(z) & np.isfinite(own)
        ratios.append(z[both] / own[both])
    every = np.concatenate(ratios) if ratios else np.zeros(0)
    if not len(every):
        raise InputError("The mesh is in no view where the true depth is known.")
    scale = float(np.median(every))
    return [(scale * own).astype(np.float32) for own in found]


def compare_view(
    view: TrueView,
    found: Float32[np.ndarray, "h w"],
    cameras: tuple[Camera, Camera],
    window: int,
    tolerance: float,
) -> ComparedView:
    """The kinds of a view's regions, and the error of its normals where they are known.

    ``cameras`` are the true one and the result's, of the same pixels. Both normals are of planes of
    ``window`` x ``window`` pixels; the true plane has to fit to ``tolerance``, the estimated one
    need not.
    """
    true_fits, own_fits = (fit_planes(depth, window, tolerance) for depth in (view.depth, found))
    cosine = (true_fits.normals(cameras[0]) * own_fits.normals(cameras[1])).sum(-1)
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    angle = np.where(true_fits.is_good & own_fits.is_known, angle, np.nan).astype(np.float32)
    places = places_of(view.depth, view.image, cameras[0], true_fits)
    return ComparedView(view, found, places, angle)


def place_scores(views: Sequence[ComparedView]) -> tuple[PlaceScore, ...]:
    """The scores of each kind of region over all views; kinds that no view has are left out."""
    true, found, angle = (
        np.concatenate([a.ravel() for a in arrays])
        for arrays in (
            [v.view.depth for v in views],
            [v.found for v in views],
            [v.angle for v in views],
        )
    )
    judged = int((true > 0).sum())
    scores = []
    for place in PLACES:
        mask = np.concatenate([v.places[place].ravel() for v in views])
        if mask.any():
            scores.append(_score(place, true[mask], found[mask], angle[mask], judged))
    return tuple(scores)


def _score(
    place: Place,
    true: Float32[np.ndarray, "n"],
    found: Float32[np.ndarray, "n"],
    angle: Float32[np.ndarray, "n"],
    judged: int,
) -> PlaceScore:
    share = 100 * len(true) / judged
    covered = np.isfinite(found)
    if place == "sky":
        return PlaceScore(place, share, 100 * float(covered.mean()))
    error = found / true - 1  # infinite where there is a hole
    known = angle[np.isfinite(angle)]
    return PlaceScore(
        place,
        share,
        100 * float(covered.mean()),
        100 * float(np.median(np.abs(error[covered]))) if covered.any() else None,
        100 * float((np.abs(error) <= NEAR).mean()),
        100 * float((np.abs(error) <= FAR).mean()),
        100 * float((error < -FAR).mean()),
        100 * float((covered & (error > FAR)).mean()),
        float(np.median(known)) if len(known) else None,
    )


def places_of(
    depth: Float[np.ndarray, "h w"],
    image: UInt8[np.ndarray, "h w 3"],
    camera: Camera,
    fits: PlaneFits,
) -> dict[Place, Bool[np.ndarray, "h w"]]:
    """Masks of the pixels of each kind.

    Args:
        depth: true z; 0 where it is unknown, infinite in the sky.
        image: RGB.
        camera: of both.
        fits: planes of ``depth``.
    """
    inverse = inverse_depth(depth)
    known = inverse > 0
    thin = thin_things(inverse)
    special: dict[Place, np.ndarray] = {
        "edge": _widened(edges(inverse).astype(np.uint8), NEAR_EDGE - 1) > 0,
        "thin": thin,
        "behind thin": _behind(inverse, thin),
        "bare": bare(image),
        "grazing": fits.is_good & (fits.slant(camera) > GRAZING),
    }
    special = {name: known & mask for name, mask in special.items()}
    plain = known & ~np.logical_or.reduce([*special.values()])
    return {"all": known, "open": plain, **special, "sky": inverse == 0}


def inverse_depth(depth: Float[np.ndarray, "h w"]) -> Float64[np.ndarray, "h w"]:
    """1 / z; 0 in the sky, NaN where it is unknown."""
    with np.errstate(divide="ignore"):
        return np.where(depth > 0, 1 / depth.astype(np.float64), np.nan)


def edges(inverse: Float64[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Mask of the pixels at either end of a jump, along a row or column, that no plane explains."""
    found = np.zeros(inverse.shape, bool)
    for line, marks in (*zip(inverse, found, strict=True), *zip(inverse.T, found.T, strict=True)):
        _mark_jumps(line, marks)
    return found


def _mark_jumps(line: Float64[np.ndarray, "n"], marks: Bool[np.ndarray, "n"]) -> None:
    """Mark neighbours of one line whose step fits the slope neither before nor after it.

    Inverse depth is linear along a plane, so the slope on either side predicts the plane's step.
    """
    at = np.flatnonzero(~np.isnan(line))
    if len(at) < 2:
        return
    gap = np.diff(at)
    step = np.diff(line[at])
    slope = step / gap
    left = np.abs(step - np.append(np.inf, slope[:-1]) * gap)
    right = np.abs(step - np.append(slope[1:], np.inf) * gap)
    unexplained = np.minimum(np.minimum(left, right), np.abs(step))
    nearest = np.maximum(line[at[:-1]], line[at[1:]])
    jump = (unexplained > JUMP * nearest) & (gap <= _LONGEST_GAP)
    marks[at[:-1][jump]] = True
    marks[at[1:][jump]] = True


def thin_things(inverse: Float64[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Mask of the long regions that an opening of the inverse depth removes.

    Surfaces are assumed to continue beyond the border and where the depth is unknown.
    """
    square = np.ones((THIN, THIN), np.uint8)
    half = THIN // 2
    unknown = np.isnan(inverse)
    padded = np.pad(np.where(unknown, np.inf, inverse), half, constant_values=np.inf)
    opened = cv2.dilate(cv2.erode(padded, square), square)[half:-half, half:-half]
    narrow = ~unknown & (np.nan_to_num(inverse) * (1 - JUMP) > opened)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(narrow.astype(np.uint8))
    length = np.maximum(stats[:, cv2.CC_STAT_WIDTH], stats[:, cv2.CC_STAT_HEIGHT])
    is_long = length >= LONG
    is_long[0] = False  # the background
    return np.asarray(is_long[labels])


def _behind(
    inverse: Float64[np.ndarray, "h w"], thin: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Mask of the pixels that are farther than a thin thing nearby."""
    nearest = _widened(np.where(thin, inverse, 0.0), BEHIND)
    return np.asarray(~thin & (inverse < (1 - JUMP) * nearest))


def bare(image: UInt8[np.ndarray, "h w 3"]) -> Bool[np.ndarray, "h w"]:
    """Mask of the pixels around which the image hardly changes."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float64)
    smooth = cv2.GaussianBlur(grey, (0, 0), _SMOOTHING)
    down, across = np.gradient(smooth)
    energy = cv2.boxFilter(across**2 + down**2, -1, (_PATCH, _PATCH))
    return np.asarray(energy < BARE**2)


def _widened(values: np.ndarray, pixels: int) -> np.ndarray:
    """Values, dilated by ``pixels`` along rows and columns."""
    side = 2 * pixels + 1
    return cv2.dilate(values, np.ones((side, side), np.uint8))
