"""The view of each face of a mesh: those that show it best, and the choice among them.

The choice is mostly that of the face's neighbours, for large patches. Its energy is that of
Lempitsky and Ivanov (2007), minimised by iterated conditional modes over each face's candidates.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32, Int64, UInt8

from geogs.mesh.colour import SLACK
from geogs.mesh.triangle_mesh import DepthMapView, Mesh

MAX_VIEWS = 8
"""Most views of a face that are kept, those that show it best."""
LEAST_COSINE = 0.1
"""Least cosine between a face's normal and the ray to a view that shows it."""
MARGIN = 1.5
"""Width of the border of an image that is not used, pixels."""
HIDDEN_CORNER_WEIGHT = 0.05
"""Weight of a face with one hidden corner."""
SMOOTHNESS = 0.35
"""Cost of a neighbour with another view, relative to 1 - score / best score."""
MAX_COLOUR_DISTANCE = 40.0
"""Distance of a view's colour from the median of a face's views above which it is an outlier."""
_ROUNDS = 12


@dataclass(frozen=True, slots=True)
class Candidates:
    """The best views of each face, up to ``MAX_VIEWS``, in no order; -1 where there are no more."""

    view: Int32[np.ndarray, "m k"]
    score: Float32[np.ndarray, "m k"]
    """Pixels that the face covers, counted less in a blurred image; 0 where there is none."""
    colour: Float32[np.ndarray, "m k 3"]
    """Mean of the image over about the face, 0 to 255."""


def find_candidates(mesh: Mesh, views: Sequence[DepthMapView], tolerance: float) -> Candidates:
    """Views that show each face: near ones from the front first, sharp ones before blurred ones.

    A view shows a face that faces it, whose corners project into its image, and of which the middle
    and two corners lie on its depth map within ``tolerance`` map units and 2 % of the depth. A face
    whose third corner is hidden counts less.
    """
    count = len(mesh.faces)
    best = Candidates(
        np.full((count, MAX_VIEWS), -1, np.int32),
        np.zeros((count, MAX_VIEWS), np.float32),
        np.zeros((count, MAX_VIEWS, 3), np.float32),
    )
    sharpness = _sharpness(views)
    for number, view in enumerate(views):
        if view.image is not None:
            faces, score, colour = _seen_faces(mesh, view, tolerance)
            _enter(best, number, faces, score * sharpness[number], colour)
    return best


def image_pixels(
    view: DepthMapView, points: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n"]]:
    """Pixel positions of world points in the image of a view, and their depths."""
    T_cw = view.T_cw.cpu().numpy()
    camera = view.camera
    local = points @ T_cw[:3, :3].T + T_cw[:3, 3]
    z = local[:, 2]
    safe = np.where(np.abs(z) < 1e-9, 1e-9, z)
    pixels = local[:, :2] / safe[:, None] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    height, width = view.rgb().shape[:2]
    scale = np.array([width / camera.width, height / camera.height])
    return (pixels + 0.5) * scale - 0.5, z


def _seen_faces(
    mesh: Mesh, view: DepthMapView, tolerance: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Indices of the faces that a view shows, pixels each covers, colours."""
    image = view.rgb()
    height, width = image.shape[:2]
    pixels, z = image_pixels(view, mesh.vertices.astype(np.float64))
    low, high = MARGIN, np.array([width, height]) - 1 - MARGIN
    inside = (z > 0) & ((pixels >= low) & (pixels <= high)).all(-1)
    faces = np.flatnonzero(inside[mesh.faces].all(1))
    corners = mesh.vertices[mesh.faces[faces]].astype(np.float64)
    middle = corners.mean(1)
    normal = _cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    T_cw = view.T_cw.cpu().numpy()
    ray = middle - (-T_cw[:3, :3].T @ T_cw[:3, 3])
    length = np.linalg.norm(normal, axis=1) * np.linalg.norm(ray, axis=1)
    cosine = -(normal * ray).sum(1) / np.maximum(length, 1e-30)
    seen_corner = np.zeros(len(mesh.vertices), bool)
    index = np.flatnonzero(inside)
    seen_corner[index] = _on_depth(view, pixels[index], z[index], image.shape, tolerance)
    at, depth = image_pixels(view, middle)
    corners_seen = seen_corner[mesh.faces[faces]].sum(1)
    shown = (cosine > LEAST_COSINE) & (corners_seen >= 2)
    shown &= _on_depth(view, at, depth, image.shape, tolerance)
    faces = faces[shown]
    at = at[shown]
    corners_seen = corners_seen[shown]
    p = pixels[mesh.faces[faces]]
    a, b = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    area = 0.5 * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    area = np.where(corners_seen == 3, area, HIDDEN_CORNER_WEIGHT * area)
    return faces, area, sampled(cv2.GaussianBlur(image, (0, 0), 1.5), at)


def _cross(a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Cross products of the rows, several times faster than NumPy's for long arrays."""
    x, y, z = a.T
    u, v, w = b.T
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], -1)


def _on_depth(
    view: DepthMapView,
    pixels: Float[np.ndarray, "n 2"],
    z: Float[np.ndarray, "n"],
    shape: tuple[int, ...],
    tolerance: float,
) -> Bool[np.ndarray, "n"]:
    """Whether points at image pixels lie on the depth map."""
    camera = view.camera
    depth = np.where(view.valid().cpu().numpy(), view.depth.cpu().numpy(), np.inf)
    scale = np.array([camera.width / shape[1], camera.height / shape[0]])
    place = np.round((pixels + 0.5) * scale - 0.5).astype(int)
    column = place[:, 0].clip(0, camera.width - 1)
    row = place[:, 1].clip(0, camera.height - 1)
    return np.abs(depth[row, column] - z) < tolerance + SLACK * z


def sampled(image: UInt8[np.ndarray, "h w 3"], at: Float[np.ndarray, "n 2"]) -> np.ndarray:
    """Colours, 0 to 255, of the pixels of an image nearest to positions."""
    column, row = np.round(at).astype(int).T
    return image[row.clip(0, image.shape[0] - 1), column.clip(0, image.shape[1] - 1)].astype(float)


def _sharpness(views: Sequence[DepthMapView]) -> Float[np.ndarray, "v"]:
    """Root of the ratio of each image's fine structure to the median image's, at most 1."""
    strength = np.array(
        [
            0.0
            if view.image is None
            else cv2.Laplacian(cv2.cvtColor(view.image, cv2.COLOR_RGB2GRAY), cv2.CV_32F).std()
            for view in views
        ]
    )
    usual = np.median(strength[strength > 0]) if (strength > 0).any() else 1.0
    return np.minimum(strength / usual, 1.0) ** 0.5


def _enter(
    best: Candidates, view: int, faces: np.ndarray, score: np.ndarray, colour: np.ndarray
) -> None:
    """Insert a view among the candidates of the faces where it is good enough."""
    worst = best.score[faces].argmin(1)
    better = score > best.score[faces, worst]
    faces = faces[better]
    worst = worst[better]
    best.view[faces, worst] = view
    best.score[faces, worst] = score[better]
    best.colour[faces, worst] = colour[better]


def face_neighbours(faces: Int[np.ndarray, "m 3"]) -> Int64[np.ndarray, "k 2"]:
    """Pairs of faces that share an edge; of an edge with more than two, successive ones."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    owner = np.tile(np.arange(len(faces)), 3)
    order = np.lexsort((owner, edges[:, 1], edges[:, 0]))
    same = (edges[order[1:]] == edges[order[:-1]]).all(1)
    return np.stack([owner[order[:-1]][same], owner[order[1:]][same]], -1).astype(np.int64)


def without_colour_outliers(
    candidates: Candidates, gains: Float32[np.ndarray, "v 3"]
) -> Float32[np.ndarray, "m k"]:
    """Scores, zero for views that show another colour than most do: something hides the face.

    Faces with fewer than three views, or only outliers, keep theirs.
    """
    has_view = candidates.view >= 0
    colour = candidates.colour * gains[candidates.view.clip(0)]
    masked = np.where(has_view[..., None], colour, np.nan)
    enough = np.flatnonzero(has_view.sum(1) >= 3)
    median = np.zeros((len(colour), 3), np.float32)
    median[enough] = np.nanmedian(masked[enough], axis=1)
    distance = np.linalg.norm(colour - median[:, None], axis=-1)
    kept = candidates.score.copy()
    kept[enough] *= distance[enough] <= MAX_COLOUR_DISTANCE
    any_left = np.any(kept > 0, axis=1, keepdims=True)
    return np.where(any_left, kept, candidates.score).astype(np.float32)


def choose_views(
    candidates: Candidates, score: Float32[np.ndarray, "m k"], neighbours: Int64[np.ndarray, "e 2"]
) -> Int32[np.ndarray, "m"]:
    """The view of each face; -1 for faces that none shows."""
    best = score.max(1)
    cost = np.where(score > 0, 1 - score / np.maximum(best, 1e-12)[:, None], np.inf)
    label = np.where(best > 0, candidates.view[np.arange(len(score)), score.argmax(1)], -1)
    random = np.random.default_rng(0)
    one, other = neighbours.T
    rows = np.arange(len(score))
    for _ in range(_ROUNDS):
        agreeing = np.zeros(score.shape)
        for here, there in ((one, other), (other, one)):
            same = candidates.view[here] == label[there][:, None]
            np.add.at(agreeing, here, same)
        total = cost - SMOOTHNESS * agreeing
        choice = np.where(np.isfinite(cost).any(1), total.argmin(1), 0)
        wanted = np.where(best > 0, candidates.view[rows, choice], -1)
        # Neighbours that change at once might swap their views for ever.
        changes = (wanted != label) & (random.random(len(label)) < 0.6)
        if not (wanted != label).any():
            break
        label = np.where(changes, wanted, label)
    return label.astype(np.int32)
