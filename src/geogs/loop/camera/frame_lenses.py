"""Per-frame intrinsics in the adjustment of all keyframes: focusing, zooming, stabilised lenses.

Focal length and principal point of each keyframe, relative to the shared ones, are estimated from
all matches; the matches are corrected, and everything is adjusted again. The prior of a keyframe's
intrinsics is white noise, for the focal length plus a random walk, whose variances are estimated as
well (EM). Focal length and principal point are freed one after the other, where that lowers the
cost by much (forward selection): a depth that is still wrong would be explained by either.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.projection import project
from geogs.bundle.uncertainty.lens_error import SHAPES, lens_prior
from geogs.bundle.uncertainty.varying_intrinsics import (
    EXPLAINED,
    OWN,
    LensChange,
    VaryingEvidence,
    VaryingPrior,
)
from geogs.loop.keyframe_matches import KeyframeMatches
from geogs.tracking.frame_lenses import shift_frames, shifts_of_own, sizes_of_frames
from geogs.tracking.keyframe_uncertainty import said_of_frame_lenses
from geogs.types import FrameLens
from geogs.world.edges import Pair

ROUNDS = 12
"""Most rounds."""
CONVERGED = 2e-4
"""Largest RMS step of a parameter over the keyframes at which the rounds end."""
DIVERGED = 2e-3
"""RMS step after the last round above which the estimate is rejected."""
AMBIGUOUS = 0.02
"""Largest relative cost that the fixed parameters could still remove at the end: 0.037 where the
map was wrong from its start and varying intrinsics hid it, up to 0.009 where they were right
(docs/notebook/lens.md)."""
AMBIGUOUS_ROWS = 0.06
"""The same for a rolling shutter, as a lens that moves during readout shears and stretches the
image: 0.022 to 0.042. The verdict tests it again once that is corrected."""
GIVEN = 1e-6
"""Prior standard deviation of the shared intrinsics of a given lens."""

Evidence = Sequence[tuple[list[int], VaryingEvidence]]
"""Keyframes that are solved together, and the evidence of their matches; the parts in order."""


@dataclass(frozen=True)
class FrameLenses:
    """Per-frame intrinsics; true if they vary."""

    each: Mapping[int, FrameLens] = field(default_factory=dict)
    """Intrinsics by the indices of the located frames."""
    prior: VaryingPrior | None = None
    """Prior of the variation; None if they do not vary."""

    def __bool__(self) -> bool:
        return self.prior is not None


def correct_frame_lenses(
    matches: KeyframeMatches, before: FrameLenses | None = None
) -> FrameLenses:
    """Estimate per-frame intrinsics, correct all matches for them and adjust again.

    The estimate is empty, and everything is restored, if no parameter lowers the cost enough, the
    steps do not converge, or a fixed parameter would do nearly as well. Steps begin at the estimate
    ``before``, which is kept in these cases. Matches of frames between the keyframes are corrected,
    too. Not in the world of a saved map. The shared intrinsics of a given lens are fixed.
    """
    before = before or FrameLenses()
    ids = matches.tracker.segment.ids
    if not matches.measured or matches.tracker.segment.fixed:
        return before
    restore = _saved(matches)
    intrinsics = _Intrinsics(matches, before)
    evidence = said_of_frame_lenses(matches.tracker, ids)
    if not before and not intrinsics.free_another(evidence):
        return before
    matches.corrections["lenses"] = intrinsics.shifts
    for _ in range(ROUNDS):
        last = intrinsics.step(evidence)
        matches.adjust()
        evidence = said_of_frame_lenses(matches.tracker, ids)
        if last < CONVERGED and not intrinsics.free_another(evidence):
            break
    most = AMBIGUOUS_ROWS if matches.log.rows else AMBIGUOUS
    if last > DIVERGED or intrinsics.left > most:
        restore()
        return before
    found = intrinsics.found()
    shift_frames(matches.log, matches.keyframes, found.each)
    return found


def _saved(matches: KeyframeMatches) -> Callable[[], None]:
    """Return a function that restores the present state."""
    camera = matches.camera
    edges = dict(matches.graph.edges)
    corrections = dict(matches.corrections)
    keyframes = [(k, k.T_cw.clone(), k.inverse_depth, k.information) for k in matches.keyframes]

    def restore() -> None:
        matches.graph.see_by(camera)
        matches.graph.replace(edges)
        matches.corrections.clear()
        matches.corrections.update(corrections)
        for keyframe, T_cw, depth, information in keyframes:
            keyframe.T_cw = T_cw
            keyframe.inverse_depth = depth
            keyframe.information = information

    return restore


class _Intrinsics:
    """Estimated corrections of the shared intrinsics and of each keyframe's."""

    def __init__(self, matches: KeyframeMatches, before: FrameLenses) -> None:
        self.prior = before.prior or VaryingPrior()
        self.left = 0.0
        """Largest relative cost reduction by a fixed parameter, as estimated last."""
        self._matches = matches
        self._keyframes = matches.keyframes
        none = FrameLens()
        self._own = {
            k.id: torch.tensor(before.each.get(k.frame_index, none).sizes, dtype=torch.float64)
            for k in matches.keyframes
        }
        self._common = torch.zeros(SHAPES, dtype=torch.float64)
        """Total change of the camera."""
        deviation = self._keyframes.table.focal_deviation
        self._is_open = deviation > 0
        expected = lens_prior(deviation) if self._is_open else SHAPES * (GIVEN,)
        self._shared = torch.tensor(expected, dtype=torch.float64)

    def free_another(self, evidence: Evidence) -> bool:
        """Forward selection: free the parameter with the largest gain, if that is enough."""
        fixed = [change for change in LensChange if not self.prior.varies(change)]
        is_first = len(fixed) == len(LensChange)
        now = 0.0 if is_first else max(0.0, self._estimated(evidence, self.prior)[2])
        most = now + EXPLAINED
        best = self.prior
        self.left = 0.0
        for prior in map(self.prior.also, fixed):
            explained = self._estimated(evidence, prior)[2]
            if explained >= most:
                most = explained
                best = prior
            self.left = max(self.left, explained - now)
        is_freed = best is not self.prior
        self.prior = best
        return is_freed

    def step(self, evidence: Evidence) -> float:
        """Take a step; return its largest RMS over the keyframes, 0 without evidence."""
        if not evidence:
            return 0.0
        steps, self.prior, _ = self._estimated(evidence, self.prior)
        own = {
            k: size
            for (frames, _), step in zip(evidence, steps, strict=True)
            for k, size in zip(frames, step[:-SHAPES].reshape(-1, len(OWN)), strict=True)
        }
        self._own.update({k: self._own[k] + size for k, size in own.items()})
        if self._is_open:
            common = torch.stack([step[-SHAPES:] for step in steps]).mean(0)
            self._common = self._common + common
            matches = self._matches
            matches.graph.see_by(matches.camera.moved(*common.tolist()))
        return float(torch.stack([*own.values()]).square().mean(0).max().sqrt())

    def _estimated(
        self, evidence: Evidence, prior: VaryingPrior
    ) -> tuple[list[Tensor], VaryingPrior, float]:
        """Return steps of all parts, prior after EM, and the largest relative cost reduction."""
        steps = []
        explained = 0.0
        for frames, part in evidence:
            times = [self._keyframes[k].timestamp for k in frames]
            taken = torch.cat([*(self._own[k] for k in frames), self._common])
            at = torch.tensor(times, dtype=torch.float64)
            step, prior = part.told(at, taken, prior, self._shared)
            steps.append(step)
            explained = max(explained, part.explained(step))
        return steps, prior, explained

    def shifts(self, part: list[Pair]) -> Float[Tensor, "e p 2"]:
        """Return shifts of the matches of some edges to those of the shared lens, in pixels."""
        grid = self._keyframes.grid
        keyframes = self._keyframes
        T_ji = keyframes.relative_poses(part)
        depth = keyframes.inverse_depths([i for i, _ in part])
        at = project(grid.camera, grid.rays, T_ji, depth)
        both = torch.stack([torch.stack([self._own[k] for k in pair]) for pair in part])
        return shifts_of_own(grid.camera, grid.rays, T_ji, at, both.to(at.pixels))

    def found(self) -> FrameLenses:
        """Return the intrinsics of each frame."""
        known = {k.frame_index: self._own[k.id] for k in self._keyframes}
        sizes = sizes_of_frames(self._matches.log, self._keyframes, known, self.prior)
        varies = torch.tensor(self.prior.deviations[: len(OWN)]) > 0
        each = {n: FrameLens(*torch.where(varies, s, 0.0).tolist()) for n, s in sizes.items()}
        return FrameLenses(each, self.prior)
