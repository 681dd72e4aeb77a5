"""Per-frame intrinsics in the adjustment of all keyframes: focusing, zooming, stabilised lenses.

Focal length and principal point of each keyframe, beside those of the video, are estimated from all
matches; the matches are corrected, and everything is adjusted again. Flow is measured again once
images are straight. The prior of what a keyframe has of its own is white noise, of the focal length
and a random walk, whose variances are estimated as well (EM). Focal length and principal point are
freed one after the other, where that lowers the cost by much (forward selection): a depth that is
still wrong asks for either.
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
CONVERGED = 2e-4
"""Largest RMS step of a parameter over the keyframes at which the rounds end."""
DIVERGED = 2e-3
"""RMS step after the last round from which on nothing is accepted."""
AMBIGUOUS = 0.02
"""Relative cost that the parameters which stay fixed may remove in the end: 0.037 where the map was
wrong from its start and varying intrinsics hid it, up to 0.009 where they were right
(docs/notebook/lens.md)."""
AMBIGUOUS_ROWS = 0.06
"""The same beside a rolling shutter, as a lens that moves while rows are read shears and stretches
the image: 0.022 to 0.042. The verdict tests it again once that is corrected."""
GIVEN = 1e-6
"""Prior standard deviation of the shared intrinsics of a given lens."""

Evidence = Sequence[tuple[list[int], VaryingEvidence]]
"""Keyframes that are solved together, and the evidence of their matches; the parts in order."""


def correct_frame_lenses(
    matches: KeyframeMatches, before: FoundLenses | None = None
) -> FoundLenses:
    """Estimate per-frame intrinsics, correct all matches for them and adjust again.

    Nothing, and everything as it was, where no parameter lowers the cost enough, the steps do not
    converge, or a parameter that stays fixed would do nearly as well. With ``before``, which images
    are straight by, the remainder is estimated. Matches of frames between the keyframes stay
    (:meth:`FoundLenses.shift`). Not in the world of a saved map. The shared intrinsics of a given
    lens stay.
    """
    graph, keyframes, log = matches.graph, matches.keyframes, matches.log
    if not graph.edges or matches.tracker.segment.fixed:
        return FoundLenses()
    kept = [(k, k.T_cw.clone(), k.inverse_depth.clone(), k.information.clone()) for k in keyframes]
    measured = graph.packed
    prior = None if before is None else before.prior
    intrinsics = _Intrinsics(keyframes, prior or VaryingPrior())
    evidence = said_of_frame_lenses(matches.tracker, matches.tracker.segment.ids)
    if prior is None and not intrinsics.free_another(evidence):
        return FoundLenses()
    for _ in range(ROUNDS):
        last = intrinsics.step(evidence)
        matches.correct(measured, intrinsics.shifts)
        evidence = said_of_frame_lenses(matches.tracker, matches.tracker.segment.ids)
        if last < CONVERGED and not intrinsics.free_another(evidence):
            break
    if last > DIVERGED or intrinsics.left > (AMBIGUOUS_ROWS if log.rows else AMBIGUOUS):
        graph.edges.update(measured)
        for keyframe, T_cw, depth, information in kept:
            keyframe.T_cw, keyframe.inverse_depth = T_cw, depth
            keyframe.information = information
        return FoundLenses()
    return intrinsics.found(log)


class _Intrinsics:
    """Errors of the shared intrinsics and of each keyframe's that matches are corrected for."""

    def __init__(self, keyframes: KeyframeSet, prior: VaryingPrior) -> None:
        self.prior, self.common = prior, torch.zeros(SHAPES, dtype=torch.float64)
        self.left = 0.0
        """Largest relative cost reduction by a parameter that is fixed, as estimated last."""
        self._keyframes, self._own = keyframes, dict[int, Tensor]()
        deviation = keyframes.table.focal_deviation
        self._is_open = deviation > 0
        expected = lens_prior(deviation) if self._is_open else SHAPES * (GIVEN,)
        self._shared = torch.tensor(expected, dtype=torch.float64)

    def of(self, id: int) -> Float[Tensor, "5"]:
        """Errors of a keyframe's intrinsics, the shared ones included."""
        return self.common.index_add(0, torch.tensor(OWN), self._of(id))

    def free_another(self, evidence: Evidence) -> bool:
        """Forward selection: free the parameter with the largest gain, if that is enough."""
        fixed = [change for change in LensChange if not self.prior.varies(change)]
        is_first = len(fixed) == len(LensChange)
        now = 0.0 if is_first else max(0.0, self._estimated(evidence, self.prior)[2])
        most, best, self.left = now + EXPLAINED, self.prior, 0.0
        for prior in map(self.prior.also, fixed):
            explained = self._estimated(evidence, prior)[2]
            if explained >= most:
                most, best = explained, prior
            self.left = max(self.left, explained - now)
        is_freed, self.prior = best is not self.prior, best
        return is_freed

    def step(self, evidence: Evidence) -> float:
        """Take a step; its largest RMS over the keyframes, 0 without evidence."""
        if not evidence:
            return 0.0
        steps, self.prior, _ = self._estimated(evidence, self.prior)
        own = {
            k: size
            for (frames, _), step in zip(evidence, steps, strict=True)
            for k, size in zip(frames, step[:-SHAPES].reshape(-1, len(OWN)), strict=True)
        }
        self._own.update({k: self._of(k) + size for k, size in own.items()})
        if self._is_open:
            self.common = self.common + torch.stack([step[-SHAPES:] for step in steps]).mean(0)
        return float(torch.stack([*own.values()]).square().mean(0).max().sqrt())

    def _estimated(
        self, evidence: Evidence, prior: VaryingPrior
    ) -> tuple[list[Tensor], VaryingPrior, float]:
        """Steps of all parts, the prior after EM, and the largest relative cost reduction."""
        steps, explained = [], 0.0
        for frames, part in evidence:
            times = [self._keyframes[k].timestamp for k in frames]
            taken = torch.cat([*(self._of(k) for k in frames), self.common])
            at = torch.tensor(times, dtype=torch.float64)
            step, prior = part.told(at, taken, prior, self._shared)
            steps.append(step)
            explained = max(explained, part.explained(step))
        return steps, prior, explained

    def _of(self, id: int) -> Float[Tensor, "3"]:
        return self._own.get(id, torch.zeros(len(OWN), dtype=torch.float64))

    def shifts(self, part: list[Pair]) -> Float[Tensor, "e p 2"]:
        """Pixels to be added to the matches of some edges, as if pinholes had seen them."""
        grid, keyframes = self._keyframes.grid, self._keyframes
        T_ji, depth = keyframes.relative_poses(part), keyframes.inverse_depths([i for i, _ in part])
        at = project(grid.camera, grid.rays, T_ji, depth)
        both = torch.stack([torch.stack([self.of(k) for k in pair]) for pair in part])
        return shifts_of_edges(grid.camera, grid.rays, T_ji, at, both.to(at.pixels))

    def found(self, log: FrameLog) -> FoundLenses:
        """Intrinsics of the video and of each frame."""
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
