"""Lenses that change from frame to frame in the adjustment of all keyframes.

Focusing anew magnifies otherwise, stabilisation moves the lens or the crop, a zoom does the first
on purpose. Matches tell it of each keyframe; they are corrected for it, and everything is adjusted
again. Flow is not measured anew until images are straight. What a lens has of its own counts as
a random number of a deviation that the video tells, too (expectation maximisation). The focal
length and the principal point are let go one after the other, and only where that takes off much of
what the matches have left (forward selection): a depth that is wrong as yet asks for either.
"""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.projection import project
from geogs.bundle.uncertainty.lens_error import SHAPES, lens_prior, shifts_of_edges
from geogs.bundle.uncertainty.varying_intrinsics import (
    EXPLAINED,
    OWN,
    LensChange,
    VaryingEvidence,
    VaryingPrior,
)
from geogs.loop.camera.found import FoundLenses
from geogs.loop.keyframe_matches import KeyframeMatches
from geogs.tracking.frame_lenses import sizes_of_frames
from geogs.tracking.keyframe_uncertainty import said_of_frame_lenses
from geogs.types import FoundLens, FrameLens
from geogs.world.edges import Pair
from geogs.world.frames import FrameLog
from geogs.world.keyframes import KeyframeSet

ROUNDS = 12
"""At most."""
SETTLED = 2e-4
"""Largest change of a size, root mean square over the keyframes, by which the rounds end."""
UNSETTLED = 2e-3
"""From which on they have not settled after the last round."""
AMBIGUOUS = 0.02
"""Part of the cost that nothing else may take off in the end: 0.037 where the map was wrong from
its start, which lenses that change hid, up to 0.009 where they were found (docs/lens.md)."""
AMBIGUOUS_ROWS = 0.06
"""The same beside a rolling shutter, as a lens that moves while rows are read shears and stretches
what they show: 0.022 to 0.042. The verdict asks again once that is taken off."""
TOLD = 1e-6
"""Deviation of what is shared of a lens that somebody told of."""


Said = Sequence[tuple[list[int], VaryingEvidence]]
"""What matches say of the lenses of some keyframes, and of others."""


def correct_frame_lenses(
    matches: KeyframeMatches, before: FoundLenses | None = None
) -> FoundLenses:
    """Correct all matches for what the lens of each keyframe has of its own, and adjust again.

    Nothing where matches do not ask for it, it does not settle, or what does not change would do
    nearly as well: then everything is as it was.
    ``before`` was found already, images are straight by it, and what is left is asked for. What was
    found of the frames between the keyframes stays (:meth:`FoundLenses.shift`). Not in the world of
    a saved map. Of a lens that somebody told of, what all frames share stays.
    """
    graph, keyframes, log = matches.graph, matches.keyframes, matches.log
    if not graph.edges or matches.tracker.segment.fixed:
        return FoundLenses()
    kept = [(k, k.T_cw.clone(), k.inverse_depth.clone(), k.information.clone()) for k in keyframes]
    measured = graph.packed
    prior = None if before is None else before.prior
    sizes = _Sizes(keyframes, prior or VaryingPrior())
    said = said_of_frame_lenses(matches.tracker, matches.tracker.segment.ids)
    if prior is None and not sizes.grow(said):
        return FoundLenses()
    for _ in range(ROUNDS):
        last = sizes.step(said)
        matches.correct(measured, sizes.shifts)
        said = said_of_frame_lenses(matches.tracker, matches.tracker.segment.ids)
        if last < SETTLED and not sizes.grow(said):
            break
    if last > UNSETTLED or sizes.left > (AMBIGUOUS_ROWS if log.rows else AMBIGUOUS):
        graph.edges.update(measured)
        for keyframe, T_cw, depth, information in kept:
            keyframe.T_cw, keyframe.inverse_depth = T_cw, depth
            keyframe.information = information
        return FoundLenses()
    return sizes.found(log)


class _Sizes:
    """Errors of the lens of all keyframes and of each, as far as they are taken off the matches."""

    def __init__(self, keyframes: KeyframeSet, prior: VaryingPrior) -> None:
        self.prior, self.common = prior, torch.zeros(SHAPES, dtype=torch.float64)
        self.left = 0.0
        """Part of the cost that what does not change would take off, when that was asked last."""
        self._keyframes, self._own = keyframes, dict[int, Tensor]()
        deviation = keyframes.table.focal_deviation
        self._is_open = deviation > 0
        expected = lens_prior(deviation) if self._is_open else SHAPES * (TOLD,)
        self._shared = torch.tensor(expected, dtype=torch.float64)

    def of(self, id: int) -> Float[Tensor, "5"]:
        """Of a keyframe, with what all share."""
        return self.common.index_add(0, torch.tensor(OWN), self._of(id))

    def grow(self, said: Said) -> bool:
        """Let that change, too, which takes most off the cost; false where nothing takes enough."""
        fixed = [change for change in LensChange if not self.prior.varies(change)]
        now = 0.0 if len(fixed) == len(LensChange) else max(0.0, self._told(said, self.prior)[2])
        most, best, self.left = now + EXPLAINED, self.prior, 0.0
        for prior in map(self.prior.also, fixed):
            explained = self._told(said, prior)[2]
            if explained >= most:
                most, best = explained, prior
            self.left = max(self.left, explained - now)
        has_grown, self.prior = best is not self.prior, best
        return has_grown

    def step(self, said: Said) -> float:
        """Go on to what matches say now. Returns the largest of the sizes' steps, root mean square
        over the keyframes; none where they say nothing."""
        if not said:
            return 0.0
        steps, self.prior, _ = self._told(said, self.prior)
        own = {
            k: size
            for (frames, _), step in zip(said, steps, strict=True)
            for k, size in zip(frames, step[:-SHAPES].reshape(-1, len(OWN)), strict=True)
        }
        self._own.update({k: self._of(k) + size for k, size in own.items()})
        if self._is_open:
            self.common = self.common + torch.stack([step[-SHAPES:] for step in steps]).mean(0)
        return float(torch.stack([*own.values()]).square().mean(0).max().sqrt())

    def _told(self, said: Said, prior: VaryingPrior) -> tuple[list[Tensor], VaryingPrior, float]:
        """Steps of all parts, the prior that suits them, and what they take off the cost of that
        which they do most to."""
        steps, explained = [], 0.0
        for frames, evidence in said:
            times = [self._keyframes[k].timestamp for k in frames]
            taken = torch.cat([*(self._of(k) for k in frames), self.common])
            at = torch.tensor(times, dtype=torch.float64)
            step, prior = evidence.told(at, taken, prior, self._shared)
            steps.append(step)
            explained = max(explained, evidence.explained(step))
        return steps, prior, explained

    def _of(self, id: int) -> Float[Tensor, "3"]:
        return self._own.get(id, torch.zeros(len(OWN), dtype=torch.float64))

    def shifts(self, part: list[Pair]) -> Float[Tensor, "e p 2"]:
        """What brings the matches of some edges to where the pinhole would have them."""
        grid, keyframes = self._keyframes.grid, self._keyframes
        T_ji, depth = keyframes.relative_poses(part), keyframes.inverse_depths([i for i, _ in part])
        at = project(grid.camera, grid.rays, T_ji, depth)
        both = torch.stack([torch.stack([self.of(k) for k in pair]) for pair in part])
        return shifts_of_edges(grid.camera, grid.rays, T_ji, at, both.to(at.pixels))

    def found(self, log: FrameLog) -> FoundLenses:
        """The lens of all frames, and what each has of its own."""
        known = {k.frame_index: self.of(k.id) for k in self._keyframes}
        sizes = sizes_of_frames(log, self._keyframes, known, self.prior)
        varies = torch.tensor(self.prior.jitter) > 0
        own = {
            n: FrameLens(*torch.where(varies, (s - self.common)[list(OWN)], 0.0).tolist())
            for n, s in sizes.items()
        }
        focal, k1, k2, right, down = self.common.tolist()
        lens = FoundLens(k1, k2, 0.0, 0.0, math.exp(focal), right=right, down=down)
        return FoundLenses(lens, own, self.prior)
