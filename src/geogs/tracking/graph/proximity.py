"""Image-based distances between keyframes, and selection of pairs for edges."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.bundle.device_choice import keyframe_pairs
from geogs.bundle.keyframe_pairs import LEAST_OVERLAP
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_inverse
from geogs.threads import thread_map
from geogs.world.edges import Pair
from geogs.world.keyframes import KeyframeSet

RADIUS = 3
"""Number of preceding keyframes that each is matched with, as in DROID-SLAM."""
PAIRS_TOGETHER = 512, 8192
"""Directed pairs that are projected at a time, on the CPU and on a GPU; bounds memory."""
TILES = 4, 6
"""Rows and columns of tiles into which the cells of a keyframe are grouped."""
LARGEST_ZOOM = 2.5
"""Largest ratio of the image scales at which two keyframes show the same point: matching compares
windows of one size. Two keyframes that face each other from rooms away, through all walls between,
would pass by motion alone, as each sees the other's view far ahead, where little moves."""
STEP = 2
"""Interval of the rows and columns of cells that are used, as for distances of keyframes."""
TARGETS_TOGETHER = 32
"""Keyframes against which all others are tested at a time; bounds memory."""


def frame_distances(
    store: KeyframeSet, directed: Sequence[Pair], rotation_weight: float = 0.3
) -> Float[Tensor, "e"]:
    """Return the distance of directed keyframe pairs in pixels; infinite at little overlap."""
    if not directed:
        return store.grid.pixels.new_zeros(0)
    return keyframe_pairs(store, directed).distances(rotation_weight)


def proximity_pairs(
    store: KeyframeSet,
    later: Sequence[int],
    earlier: Sequence[int],
    existing: Iterable[Pair],
    radius: int,
    suppression: int,
    max_distance: float,
    max_pairs: int,
) -> list[Pair]:
    """Select pairs between ``later`` and ``earlier`` keyframes (DROID-SLAM's proximity factors).

    Every later keyframe is paired with its ``radius`` predecessors. Then pairs of similar image
    scale are taken by growing distance up to ``max_distance`` pixels, each suppressing those within
    ``suppression`` keyframes of it, as the existing pairs do, until there are ``max_pairs``.
    """
    ids = store.ids
    position = {k: n for n, k in enumerate(ids)}
    rows, columns = (np.array(sorted(position[k] for k in part)) for part in (earlier, later))
    # Pairs that end well before the later keyframes suppress none of theirs.
    reach = int(columns.min(initial=len(ids))) - suppression
    taken = {
        (position[i], position[j])
        for i, j in existing
        if i in position and j in position and position[j] >= reach
    }
    found: list[Pair] = []
    for k in later:
        for back in range(1, radius + 1):
            pair = (position[k] - back, position[k])
            if pair[0] >= 0 and pair not in taken:
                taken.add(pair)
                found.append(pair)
    blocked = np.zeros((len(ids), len(ids)), bool)
    for pair in taken:
        _suppress(blocked, pair, suppression)
    free = ~blocked[np.ix_(rows, columns)] & (columns - rows[:, None] > radius)
    for pair in _by_distance(store, rows, columns, free, max_distance):
        if len(found) >= max_pairs:
            break
        if not blocked[pair]:
            found.append(pair)
            _suppress(blocked, pair, suppression)
    return [(ids[a], ids[b]) for a, b in found]


def _by_distance(
    store: KeyframeSet,
    rows: Int[np.ndarray, "r"],
    columns: Int[np.ndarray, "c"],
    wanted: Bool[np.ndarray, "r c"],
    max_distance: float,
) -> list[Pair]:
    """Return the wanted pairs of positions that are near enough, by growing distance."""
    ids = store.ids
    first, second = ([ids[k] for k in part.tolist()] for part in (rows, columns))
    if wanted.any():
        wanted = wanted & alike_in_size(store, first, second)
    if int(wanted.sum()) > PAIRS_TOGETHER[0]:
        wanted = wanted & may_overlap(store, first, second, LEAST_OVERLAP)
        wanted &= may_overlap(store, second, first, LEAST_OVERLAP).T
    at = np.stack(np.nonzero(wanted), 1)
    pairs = np.stack([rows[at[:, 0]], columns[at[:, 1]]], 1)

    def distances(part: Int[np.ndarray, "k 2"]) -> Float[np.ndarray, "k"]:
        directed = [(ids[a], ids[b]) for a, b in part.tolist()]
        both = frame_distances(store, directed + [(j, i) for i, j in directed])
        forward, backward = both.chunk(2)
        return ((forward + backward) / 2).cpu().numpy()

    if not len(pairs):
        return []
    size = PAIRS_TOGETHER[store.grid.on_gpu] // 2
    parts = [pairs[k : k + size] for k in range(0, len(pairs), size)]
    found = [distances(p) for p in parts] if store.grid.on_gpu else thread_map(distances, parts)
    distance = np.concatenate(found)
    near = np.nonzero(distance <= max_distance)[0]
    order = near[np.argsort(distance[near], kind="stable")]
    return [(a, b) for a, b in pairs[order].tolist()]


def _suppress(blocked: Bool[np.ndarray, "n n"], pair: Pair, reach: int) -> None:
    """Block the pairs around an existing one: those with |da| + |db| up to the reach."""
    a, b = pair
    limit = max(min(abs(a - b) - 2, reach), 0)
    for row in range(max(a - limit, 0), min(a + limit + 1, len(blocked))):
        rest = limit - abs(row - a)
        blocked[row, max(b - rest, 0) : b + rest + 1] = True


@dataclass(frozen=True)
class _Spheres:
    """Bounding spheres of the points seen by each tile of each keyframe, in world coordinates."""

    centre: Float[Tensor, "n t 3"]
    radius: Float[Tensor, "n t"]
    fraction: Float[Tensor, "t"]
    """Fraction of the cells in each tile."""

    def around(self) -> "_Spheres":
        """Return one sphere around all points of each keyframe."""
        centre = self.centre.mean(1, keepdim=True)
        reach = (self.centre - centre).norm(dim=-1) + self.radius
        return _Spheres(centre, 1.001 * reach.amax(1, keepdim=True), torch.ones(1))

    def of(self, rows: Int[Tensor, "m"]) -> "_Spheres":
        """Return the spheres of some of the keyframes."""
        return _Spheres(self.centre[rows], self.radius[rows], self.fraction)

    def reach(
        self, normal: Float[Tensor, "m k 3"], offset: Float[Tensor, "m k"]
    ) -> Bool[Tensor, "n m t"]:
        """Whether each sphere reaches into the frustum of each view."""
        distance = torch.einsum("ntd,mkd->nmtk", self.centre, normal) + offset[:, None]
        return (distance >= -self.radius[:, None, :, None]).all(-1)


def may_overlap(
    store: KeyframeSet, source: Sequence[int], target: Sequence[int], least: float
) -> Bool[np.ndarray, "n m"]:
    """Return False where at most a fraction ``least`` of a source's cells falls into a target.

    A tile whose bounding sphere reaches into the target's view counts with all its cells, so False
    is certain, but True is not.
    """
    spheres = _spheres(store, source)
    whole = spheres.around()
    out = np.full((len(source), len(target)), least <= 1e-6)
    for begin in range(0, len(target), TARGETS_TOGETHER):
        part = target[begin : begin + TARGETS_TOGETHER]
        planes = _view_planes(store.grid.camera, store.poses(part))
        # On a long walk most keyframes are nowhere near these few.
        near = torch.nonzero(whole.reach(*planes)[..., 0].any(1))[:, 0]
        fraction = spheres.of(near).reach(*planes).float() @ spheres.fraction
        out[near.numpy(), begin : begin + len(part)] = (fraction > least - 1e-6).numpy()
    return out


def alike_in_size(
    store: KeyframeSet, first: Sequence[int], second: Sequence[int]
) -> Bool[np.ndarray, "n m"]:
    """Whether the image scales of two keyframes differ by a ratio up to ``LARGEST_ZOOM``.

    They are compared at the point on the optical axis of each, at its median depth.
    """
    ids = sorted({*first, *second})
    row = {id: n for n, id in enumerate(ids)}
    T_wc = se3_inverse(store.poses(ids)).float()
    depth = torch.cat(
        [
            1 / store.inverse_depths(ids[n : n + 64]).median(1).values.cpu()
            for n in range(0, len(ids), 64)
        ]
    )
    centre = T_wc[:, :3, 3]
    point = T_wc[:, :3, 2] * depth[:, None] + T_wc[:, :3, 3]
    i, j = ([row[id] for id in part] for part in (first, second))

    def fits(seeing: list[int], other: list[int]) -> Bool[Tensor, "a b"]:
        zoom = torch.cdist(point[seeing], centre[other]) / depth[seeing, None]
        return (zoom <= LARGEST_ZOOM) & (zoom >= 1 / LARGEST_ZOOM)

    alike: Bool[np.ndarray, "n m"] = (fits(i, j) & fits(j, i).mT).numpy()
    return alike


def _spheres(store: KeyframeSet, ids: Sequence[int]) -> _Spheres:
    grid = store.grid
    rows, columns = torch.arange(0, grid.height, STEP), torch.arange(0, grid.width, STEP)
    tile = (rows * TILES[0] // grid.height)[:, None] * TILES[1] + columns * TILES[1] // grid.width
    cells = (rows[:, None] * grid.width + columns).reshape(-1)
    rays = grid.rays.cpu()[cells]
    groups = [torch.nonzero(tile.reshape(-1) == t)[:, 0] for t in tile.unique().tolist()]
    T_wc = se3_inverse(store.poses(ids)).float()
    centres = []
    radii = []
    for begin in range(0, len(ids), 64):
        part = slice(begin, begin + 64)
        depth = 1 / store.inverse_depths(ids[part]).cpu()[:, cells, None]
        points = (rays * depth) @ T_wc[part, :3, :3].mT + T_wc[part, None, :3, 3]
        grouped = [points[:, g] for g in groups]
        middle = [(p.amin(1) + p.amax(1)) / 2 for p in grouped]
        far = [(p - c[:, None]).norm(dim=-1).amax(1) for p, c in zip(grouped, middle, strict=True)]
        centres.append(torch.stack(middle, 1))
        radii.append(torch.stack(far, 1))
    centre = torch.cat(centres)
    radius = torch.cat(radii)
    slack = 1e-5 * (centre.norm(dim=-1) + T_wc[:, :3, 3].norm(dim=-1).max())
    count = torch.tensor([len(g) for g in groups], dtype=torch.float32)
    return _Spheres(centre, 1.001 * radius + slack, count / len(cells))


def _view_planes(
    camera: Camera, T_cw: Float[Tensor, "m 4 4"]
) -> tuple[Float[Tensor, "m 5 3"], Float[Tensor, "m 5"]]:
    """Return inward normals n and offsets o of each view's frustum: n . x + o >= 0 within."""
    c = camera
    right, bottom = c.width - 1, c.height - 1
    border = [[0, 0], [c.cx, 0], [right, 0], [0, c.cy], [right, c.cy], [0, bottom], [c.cx, bottom],
              [right, bottom]]  # fmt: skip
    seen = c.plane(torch.tensor(border, dtype=torch.float64))
    (left, up), (far_right, down) = seen.amin(0).tolist(), seen.amax(0).tolist()
    planes = torch.tensor(
        [[1, 0, -left], [-1, 0, far_right], [0, 1, -up], [0, -1, down], [0, 0, 1]],
        dtype=torch.float64,
    )
    planes = planes / planes.norm(dim=1, keepdim=True)
    normal = planes @ T_cw[:, :3, :3]
    offset = (planes @ T_cw[:, :3, 3:])[..., 0]
    return normal.float(), offset.float()
