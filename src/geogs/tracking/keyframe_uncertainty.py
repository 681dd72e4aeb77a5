"""Standard deviations of a tracker's keyframes, from the covariance of all its matches."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from geogs.bundle.problem import BundleProblem, StreamedProblem
from geogs.bundle.projection import CellProjection, relative_motion
from geogs.bundle.protocols import BundleOptions
from geogs.bundle.uncertainty.lens_error import LensEvidence, lens_evidence, lens_prior
from geogs.bundle.uncertainty.marginals import (
    Considered,
    Marginals,
    common_errors,
    deviations_after_alignment,
    marginals,
)
from geogs.bundle.uncertainty.varying_intrinsics import (
    FIRST,
    VaryingEvidence,
    considered_lenses,
    varying_evidence,
)
from geogs.tracking.frames.pose_filling import rows_in_doubt
from geogs.tracking.frames.row_errors import RowErrors
from geogs.tracking.graph.frame_graph import HUBER
from geogs.tracking.graph.rigid_parts import largest_part
from geogs.tracking.tracker import Tracker
from geogs.types import FrameLens, Uncertainty
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeSet

CELLS = 512
"""Most cells of a keyframe whose matches represent all."""
OPTIONS = BundleOptions(huber=HUBER, depth_damping=1e-5, chunk=96)
"""Options of the linearisation: many edges at a time, as cells are few. More damping of the depths
would count as evidence against a drift of scale, which changes them all."""
TOGETHER = 300
"""Most keyframes whose poses are solved jointly; longer videos are split into parts."""
USUAL_RESIDUAL = 0.23
"""Median residual, in deviations of a match, where the scene is as modelled: measured on rendered
videos (docs/notebook/uncertainty.md has the table)."""
FLAWLESS_RESIDUAL = 0.26
"""Largest such residual of videos without flaws: 0.21 to 0.26."""
MIN_SHARED = 0.2
"""Least shared fraction of the cells for a rigid connection of two edges (:func:`largest_part`):
views of a revisited place, which may be the only link between two stretches, have less in common
than those of a start."""
LEAST_FITTING = 0.9
"""Quantile of the keyframes' residuals that represents those whose matches fit worst."""


def keyframe_uncertainty(tracker: Tracker, errors: RowErrors | None = None) -> Uncertainty:
    """Estimate the uncertainty of all keyframes of a tracker that has a map, from its present
    edges; ``errors`` are those of its frames' rows, if already solved.

    Pose deviations are those of the errors left after alignment with the truth by a similarity, as
    frame and unit of the map are arbitrary
    (:func:`~geogs.bundle.uncertainty.marginals.deviations_after_alignment`). In the world of a
    saved map: of its new keyframes, relative to it.

    In a video of more than ``TOGETHER`` keyframes each part begins where the one before it ended,
    and deviations are relative to the first keyframe: errors add up along the path regardless of
    loops, so deviations are rather too large.
    """
    ids = tracker.segment.free
    times = np.array([tracker.keyframes[k].timestamp for k in ids], np.float64)
    position, rotation, depth, residual = (np.full(len(ids), np.inf) for _ in range(4))
    rows = rows_in_doubt(tracker.map.recorder.log, tracker.keyframes, errors)
    propagated = np.zeros(2)
    focal = 0.0
    change = 0.0
    lenses = 0.0
    table = tracker.keyframes.table
    for part in _parts(ids):
        found = _marginals(tracker, ids[part], rows)
        if found is None:
            continue
        depth[part] = found.depth_deviation.numpy()
        residual[part] = found.normalised_residual.numpy()
        focal = max(focal, found.focal_variance)
        change = max(change, found.focal_change)
        lenses = max(lenses, found.lens_change)
        if len(ids) <= TOGETHER + 1 and not tracker.segment.fixed:
            T_cw = tracker.keyframes.poses(ids)
            position[:], rotation[:] = deviations_after_alignment(T_cw, found.covariance)
            break
        squares = found.pose.diagonal(dim1=-2, dim2=-1).reshape(-1, 2, 3).sum(-1).numpy()
        squares = squares + propagated
        position[part], rotation[part] = np.sqrt(squares).T
        propagated = squares[-1] if not tracker.segment.fixed else propagated
    focal = math.sqrt(focal)
    if table.lens is not None:
        # An estimated lens keeps the deviation of its estimate: matches on images straightened by
        # it agree with it.
        focal = max(table.lens.deviation_focal, focal)
    fixed = set(tracker.segment.fixed)
    edges = tracker.map.graph.edges
    held = largest_part(tracker.keyframes, edges, MIN_SHARED, fixed).intersection(ids)
    joined = max(len(held), 1) / max(len(ids), 1)
    off = misfit(residual)
    varies = bool(table.frame_lenses)
    return Uncertainty(times, position, rotation, depth, focal, off, change, lenses, joined, varies)


def misfit(residuals: Float[np.ndarray, "n"]) -> float:
    """Return the residual of the tenth of the keyframes whose matches fit worst, over that of the
    median keyframe, or of one without flaws; 0 where no matches are known.

    It is below 1.3 where poses are right: noise, blur and bare walls affect all of a video, and
    weights of matches account for them. Above it tracking has failed.
    """
    known = residuals[np.isfinite(residuals)]
    if not len(known):
        return 0.0
    return float(np.quantile(known, LEAST_FITTING) / max(np.median(known), FLAWLESS_RESIDUAL))


def said_of_lens(
    tracker: Tracker, ids: list[int], rows: RowErrors | None = None
) -> LensEvidence | None:
    """Return the evidence on the lens in the edges between some keyframes, earliest first.

    Also on the readout, if ``rows`` are given.
    """
    found = None
    for matches in _matches_in_parts(tracker, ids):
        said = matches.lens(rows)
        if said is not None:
            found = said if found is None else found.joined(said)
    return found


def said_of_frame_lenses(
    tracker: Tracker, ids: list[int]
) -> list[tuple[list[int], VaryingEvidence]]:
    """Return the evidence on the lens of each keyframe in the edges between some, earliest first.

    More than ``TOGETHER`` keyframes are split into parts; the last keyframe of one is the first of
    the next.
    """
    found = []
    for matches in _matches_in_parts(tracker, ids):
        said = matches.frame_lenses()
        if said is not None:
            found.append((matches.frames, said))
    return found


def _parts(ids: list[int]) -> Iterator[slice]:
    """Yield spans of ids that are solved jointly; the last of one is the first of the next."""
    for first in range(0, max(len(ids) - 1, 1), TOGETHER):
        yield slice(first, first + TOGETHER + 1)


def _matches_in_parts(tracker: Tracker, ids: list[int]) -> Iterator["_Matches"]:
    """Yield the matches of each span of ids that has any."""
    for part in _parts(ids):
        matches = _Matches.among(tracker, ids[part])
        if matches is not None:
            yield matches


@dataclass(frozen=True)
class _Matches:
    """Present poses and depths of some keyframes, and the edges between them."""

    keyframes: KeyframeSet
    problem: StreamedProblem
    frames: list[int]

    @staticmethod
    def among(tracker: Tracker, ids: list[int]) -> "_Matches | None":
        """Return the matches of some keyframes; None where no edge joins them."""
        free = ids if tracker.segment.fixed else ids[1:]
        among = {*ids, *tracker.segment.fixed}
        edges = [e for e in tracker.map.graph.edges if among.issuperset(e)]
        if not edges:
            return None
        problem, frames = tracker.map.graph.streamed_problem(edges, free, ids)
        return _Matches(tracker.keyframes, problem, frames)

    @property
    def grid(self) -> SampleGrid:
        """Sample grid of their cells."""
        return self.keyframes.grid

    def lens(self, rows: RowErrors | None, of_depths: bool = False) -> LensEvidence | None:
        """Return the evidence on the lens, and on the readout of ``rows``; None where matches do
        not determine all poses."""
        slope = None if rows is None else partial(self._slope, rows)
        return lens_evidence(self.grid, self.problem, OPTIONS, CELLS, slope, of_depths)

    def frame_lenses(self) -> VaryingEvidence | None:
        """Return the evidence on the lens of each keyframe."""
        return varying_evidence(self.grid, self.problem, OPTIONS)

    def lens_change(self, said: VaryingEvidence) -> float:
        """Return the relative cost reduction by per-frame intrinsics."""
        step, _ = said.told(self.times, torch.zeros_like(said.gradient), FIRST, self.shared)
        return max(0.0, said.explained(step))

    @property
    def times(self) -> Float64[Tensor, "n"]:
        """Times of the keyframes, seconds."""
        each = [self.keyframes[k].timestamp for k in self.frames]
        return torch.tensor(each, dtype=torch.float64)

    @property
    def shared(self) -> Float64[Tensor, "5"]:
        """Prior deviations of the shared lens."""
        prior = lens_prior(self.keyframes.table.focal_deviation)
        return torch.tensor(prior, dtype=torch.float64)

    def considered_lenses(self, said: VaryingEvidence, own: Mapping[int, FrameLens]) -> Considered:
        """Return the errors of per-frame intrinsics, given the present estimates ``own``."""
        each = [own.get(k, FrameLens()) for k in self.frames]
        return considered_lenses(
            said,
            self.grid,
            self.problem,
            OPTIONS,
            CELLS,
            torch.tensor([o.sizes for o in each], dtype=torch.float64),
            self.times,
            self.shared,
        )

    def _slope(
        self, rows: RowErrors, part: BundleProblem, rays: Tensor, at: CellProjection
    ) -> Float[Tensor, "e p 2"]:
        """Return derivatives of matches, at the projected cells, by the factor on the readout."""
        i, j = (
            [self.keyframes[self.frames[n]].frame_index for n in x]
            for x in (part.source.tolist(), part.target.tolist())
        )
        T_ji = relative_motion(part.T_cw, part.source, part.target)
        depth = part.inverse_depth[part.source]
        return rows.of_matches(i, j, T_ji, rays, depth, at.pixels).slope


def _marginals(tracker: Tracker, ids: list[int], rows: RowErrors | None) -> Marginals | None:
    """Compute the marginals of some keyframes, including the common errors of all their matches.

    To hold where the scene is not as modelled, too, deviations of matches are scaled by the ratio
    of their residuals to the usual ones. Those of the lens and of the readout of ``rows`` are not.
    """
    matches = _Matches.among(tracker, ids)
    if matches is None:
        return None
    own = torch.tensor([matches.frames.index(k) for k in ids])
    found = marginals(matches.grid, matches.problem, OPTIONS, CELLS)
    longer = (found.normalised_residual / USUAL_RESIDUAL).clamp(min=1)
    longer = torch.where(longer.isfinite(), longer, 1.0)
    said = matches.lens(rows, of_depths=True) if found.is_bounded else None
    own_lenses = None if said is None else matches.frame_lenses()
    if said is not None:
        found = found.beside(common_errors(matches.grid, matches.problem, OPTIONS, found, CELLS))
    found = replace(
        found,
        covariance=longer[own].square().mean() * found.covariance,
        relative_depth=longer[:, None] * found.relative_depth,
    )
    if said is not None:
        table = tracker.keyframes.table
        doubt = 0.0 if rows is None else rows.doubt
        corrected = 1.0 if table.lens is None else table.lens.focal
        found = found.beside(said.considered(corrected, doubt, table.focal_deviation))
        if own_lenses is not None and table.frame_lenses:
            found = found.beside(matches.considered_lenses(own_lenses, table.frame_lenses))
    free = (6 * own[:, None] + torch.arange(6)).reshape(-1)
    covariance = found.covariance[free[:, None], free]
    depth = found.relative_depth[own]
    residual = found.normalised_residual[own]
    change = 0.0 if said is None else said.focal_change
    lenses = 0.0 if own_lenses is None else matches.lens_change(own_lenses)
    return Marginals(covariance, depth, residual, found.focal_variance, change, lenses)
