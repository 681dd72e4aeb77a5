"""Dynamic objects: cells whose matches no depth explains, although the scene's poses are known.

Matches on a moving object agree with each other, not with the scene. Over the measured pairs of a
keyframe, the residuals of a cell's matches at their best depth are several times those elsewhere.
Such regions are *dynamic*: their matches, and those that end in them, are not used.
"""

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from geogs.bundle.device_choice import grid_fields
from geogs.bundle.problem import source_chunks
from geogs.bundle.projection import project, relative_motion
from geogs.bundle.rigidity import best_residuals
from geogs.world.edges import Edge, Pair, edge_matches
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeSet

MIN_RESIDUAL = 0.2
"""Least median residual of an edge, in deviations of a match."""
MAX_EDGE_RATIO = 3.0
"""Largest ratio of one edge's median residual to that of all edges."""
MAX_RATIO = 10.0
"""Largest ratio to the median residual that a single match contributes."""
MAX_STANDING_PARALLAX = 0.25
"""Fraction of the scene's median parallax below which a cell stands still in the image, like points
at infinity: an object that moves with the camera does, too, and stays dynamic."""
MIN_MATCHES = 0.7
"""Least mean number of matches per cell around one for a decision."""
MAX_DYNAMIC = 0.8
"""Fraction of a keyframe's cells above which the keyframe itself is inconsistent with others."""
MIN_DYNAMIC_AROUND = 0.4
"""Fraction of dynamic cells around a cell above which it is dynamic itself."""
EDGES_TOGETHER = 128
"""Directed edges, of some ten keyframes, processed at a time; bounds memory."""


def static_weight(
    keyframes: KeyframeSet,
    directed: Sequence[Pair],
    pixels: Float[Tensor, "e p 2"],
    weight: Float[Tensor, "e p 2"],
) -> Float[Tensor, "e p 2"]:
    """Return the weights of matches, zero for those from or to a dynamic cell."""
    dynamic = {k for k in {k for e in directed for k in e} if keyframes[k].moving is not None}
    some = [n for n, e in enumerate(directed) if not dynamic.isdisjoint(e)]
    if not some:
        return weight
    weight = weight.clone()
    weight[some] *= _static(keyframes, [directed[n] for n in some], pixels[some])[..., None]
    return weight


def propagated(
    grid: SampleGrid,
    moving: Bool[Tensor, "p"] | None,
    pixels: Float[Tensor, "p 2"],
    weight: Float[Tensor, "p 2"],
) -> Bool[Tensor, "p"] | None:
    """Propagate dynamic cells (``moving``) of another image to an image, by its matches with it."""
    if moving is None:
        return None
    cell, inside = grid.cells_of(pixels)
    return moving[cell] & inside & (weight[:, 0] > 0)


def dynamic_fraction(keyframes: KeyframeSet) -> float:
    """Return the fraction of dynamic cells; 0 without keyframes."""
    found = [k.moving.float().mean().cpu() for k in keyframes if k.moving is not None]
    return float(torch.stack(found).sum()) / len(keyframes) if found else 0.0


def update_dynamic(
    keyframes: KeyframeSet, edges: Mapping[Pair, Edge], decided: Sequence[Pair], threshold: float
) -> None:
    """Update the dynamic cells of the sources of some directed edges.

    ``decided`` are all edges of these sources that are used; a cell with too few matches keeps its
    state. ``threshold`` is the least ratio of the mean residual around a cell to the median
    residual of its edges. A dynamic cell that stands still in the image (``MAX_STANDING_PARALLAX``)
    stays dynamic.
    """
    directed = sorted(decided)
    if not directed:
        return
    source = torch.tensor([i for i, _ in directed])
    for chunk in source_chunks(source, EDGES_TOGETHER):
        ratio, parallax, static = relative_residuals(keyframes, edges, directed[chunk])
        ratio = ratio.clamp(max=MAX_RATIO)
        ids, row = source[chunk].unique(return_inverse=True)
        row = row.to(ratio.device)
        total = ratio.new_zeros(len(ids), ratio.shape[1])
        count = total.index_add(0, row, (~ratio.isnan()).to(ratio))
        total = total.index_add(0, row, ratio.nan_to_num(0.0))
        before = keyframes.moving(ids.tolist())
        # The median over the static cells of an edge is its usual parallax.
        usual = torch.where(static, parallax, torch.nan).nanmedian(1).values[:, None]
        moved = torch.zeros_like(total).index_add(0, row, (parallax / usual).nan_to_num(0.0))
        stands = before & (moved < MAX_STANDING_PARALLAX * count)
        dynamic = dynamic_cells(keyframes.grid, total, count, before, threshold)
        border = _mean(keyframes.grid, stands.to(total), 5) >= MIN_DYNAMIC_AROUND
        dynamic |= stands | border
        for n, (k, is_any) in enumerate(zip(ids.tolist(), dynamic.any(1).tolist(), strict=True)):
            keyframes[k].moving = dynamic[n].clone() if is_any else None


def dynamic_cells(
    grid: SampleGrid,
    total: Float[Tensor, "n p"],
    count: Float[Tensor, "n p"],
    before: Bool[Tensor, "n p"],
    threshold: float,
) -> Bool[Tensor, "n p"]:
    """Return regions of keyframes whose mean residual ratio, ``total / count``, is too large.

    An undecided cell gets the state of its surroundings, and each the majority of the cells around
    it, so that a moving region includes its border. All keep their state ``before`` if none can be
    decided, or nearly all exceed it: then the pose or the image is wrong.
    """
    near = _mean(grid, total, 3)
    seen = _mean(grid, count, 3)
    known = seen >= MIN_MATCHES
    core = (near > threshold * seen) & known
    is_known = known.any(1, keepdim=True) & (core.sum(1) <= MAX_DYNAMIC * known.sum(1))[:, None]
    filled = grid_fields(grid).fill(core.to(total), known.to(total))
    return torch.where(is_known, _mean(grid, filled, 5) >= MIN_DYNAMIC_AROUND, before)


def _mean(grid: SampleGrid, values: Float[Tensor, "n p"], size: int) -> Float[Tensor, "n p"]:
    """Return the mean over a square of cells around each, cut at the border of the grid."""
    image = values.view(-1, 1, grid.height, grid.width)
    pooled = avg_pool2d(image, size, 1, size // 2, count_include_pad=False)
    return pooled.view(values.shape)


def _static(
    keyframes: KeyframeSet, directed: Sequence[Pair], pixels: Float[Tensor, "e p 2"]
) -> Bool[Tensor, "e p"]:
    """Whether matches neither start nor end in a dynamic cell."""
    cell, inside = keyframes.grid.cells_of(pixels)
    source, target = (keyframes.moving([e[k] for e in directed]) for k in (0, 1))
    return ~(source | (target.gather(1, cell) & inside))


def relative_residuals(
    keyframes: KeyframeSet, edges: Mapping[Pair, Edge], directed: Sequence[Pair]
) -> tuple[Float[Tensor, "e p"], Float[Tensor, "e p"], Bool[Tensor, "e p"]]:
    """Return residuals of some edges at the best depths, over the median of each edge; parallax in
    pixels, i.e. motion beyond rotation (both NaN without a match); and whether matches are static.

    A cell's depth is the best fit to these edges, so they should be all edges of their sources.
    """
    grid = keyframes.grid
    ids = sorted({k for e in directed for k in e})
    slot = {k: n for n, k in enumerate(ids)}
    pixels, weight = edge_matches(grid, [edges[e] for e in directed])
    poses = keyframes.poses(ids)
    first, second = (torch.tensor([slot[e[k]] for e in directed]) for k in (0, 1))
    residual = best_residuals(
        grid.camera, grid.rays, poses, keyframes.inverse_depths(ids), first, second, pixels, weight
    )
    T_ji = relative_motion(poses, first, second).to(pixels)
    far = project(grid.camera, grid.rays, T_ji, torch.zeros_like(residual)).pixels
    is_matched = weight[..., 0] > 0
    residual = torch.where(is_matched, residual, torch.nan)
    parallax = torch.where(is_matched, (pixels - far).norm(dim=-1), torch.nan)
    static = _static(keyframes, directed, pixels)
    return residual / _usual(residual, static)[:, None], parallax, static


def _usual(residual: Float[Tensor, "e p"], static: Bool[Tensor, "e p"]) -> Float[Tensor, "e"]:
    """Return the median residual of each edge over static matches, bounded by that of all edges.

    A moving object may fill a keyframe, but not most of those processed together.
    """
    usual = torch.where(static, residual, torch.nan).nanmedian(1).values
    common = usual.nanmedian().nan_to_num(MIN_RESIDUAL).clamp(min=MIN_RESIDUAL)
    usual = torch.where(usual.isnan(), common, usual)
    return torch.minimum(torch.maximum(usual, common), MAX_EDGE_RATIO * common)
