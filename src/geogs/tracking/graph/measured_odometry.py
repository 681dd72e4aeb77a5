"""Poses of another tracker in ours: whether they fit, at which scale, and what they say of motion.

Only motions between neighbouring keyframes are used, so that a world of its own and a drift do no
harm. Until enough of them fit those of the images they are not used at all.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Float

from geogs.bundle.motion_term import MeasuredMotions
from geogs.config import OdometryConfig
from geogs.geometry.lie import se3_inverse
from geogs.priors.odometry import ScaleVote, information_of, vote_on_scale
from geogs.types import MeasuredPose
from geogs.world.keyframes import Keyframe, KeyframeSet
from geogs.world.segments import OdometryScale

MIN_AGREEMENT = 0.4
"""Fraction of the motions that must fit those of the images before any of them is used: of another
recording hardly any does."""
MIN_MOTIONS = 5
"""Motions that must fit before any is used."""
MAX_DEVIATION = 0.1
"""Relative deviation of the scale up to which motions are used ..."""
PRECISE = 0.003
"""... and up to which it is asked again with every keyframe."""
LATEST = 200
"""Latest motions that are asked while the camera is tracked."""


@dataclass(frozen=True)
class OdometryAgreement:
    """How far measured motions fit those of the images."""

    motions: int
    """Number of motions that were measured between neighbouring keyframes."""
    fitting: float
    """Fraction of these that fit within their deviations."""
    used: bool
    """Whether they took part."""


class Odometry:
    """Motions between the keyframes of a segment by another tracker."""

    def __init__(
        self, keyframes: KeyframeSet, config: OdometryConfig, found: OdometryScale | None = None
    ) -> None:
        """``found`` is what is known of the scale already, and is changed in place."""
        self.keyframes = keyframes
        self.config = config
        self.found = found or OdometryScale()

    def update_scale(self) -> None:
        """Find the scale, if it is not precise yet, by the latest keyframes."""
        ids = self.keyframes.ids[-LATEST:]
        if not ids or self.keyframes[ids[-1]].pose is None:
            return
        if self.found.scale is None or self.found.deviation > PRECISE:
            self._take(self._vote(ids))

    def update_scale_by_all(self) -> None:
        """Find the scale by all keyframes."""
        self._take(self._vote(self.keyframes.ids))

    def agreement(self) -> OdometryAgreement:
        """How far all motions fit, at the present poses."""
        vote = self._vote(self.keyframes.ids)
        return OdometryAgreement(len(vote.fits), vote.fraction, self.found.scale is not None)

    def between(self, ids: Sequence[int]) -> MeasuredMotions | None:
        """Motions from each of some keyframes to the next, in the unit of the map.

        Sources and targets are indices among the ids. None where they are not to be used.
        """
        scale = self.found.scale
        if scale is None:
            return None
        steps, motion = self._measured(ids)
        if not steps:
            return None
        information = information_of(motion, self.config)
        information[:, :3] *= scale**2
        motion[:, :3, 3] /= scale
        source, target = (torch.tensor([pair[k] for pair in steps]) for k in (0, 1))
        return MeasuredMotions(source, target, motion, information)

    def since(self, keyframe: Keyframe, pose: MeasuredPose | None) -> torch.Tensor | None:
        """Motion from a keyframe to where the camera is said to be, in the unit of the map."""
        before, scale = keyframe.pose, self.found.scale
        if scale is None or pose is None or before is None or before.world != pose.world:
            return None
        motion = pose.T_cw @ se3_inverse(before.T_cw)
        motion[:3, 3] /= scale
        return motion

    def _measured(
        self, ids: Sequence[int]
    ) -> tuple[list[tuple[int, int]], Float[torch.Tensor, "m 4 4"]]:
        """Neighbours whose poses are of one world, by their places among some keyframes, and the
        motions from each to the next, metres."""
        known = [(n, self.keyframes[k].pose) for n, k in enumerate(ids)]
        poses = [(n, pose) for n, pose in known if pose is not None]
        steps = [(a, b) for a, b in pairwise(poses) if a[1].world == b[1].world]
        motions = _stacked([b.T_cw @ se3_inverse(a.T_cw) for (_, a), (_, b) in steps])
        return [(m, n) for (m, _), (n, _) in steps], motions

    def _vote(self, ids: Sequence[int]) -> ScaleVote:
        steps, measured = self._measured(ids)
        T = [self.keyframes[k].T_cw for k in ids]
        seen = _stacked([T[n] @ se3_inverse(T[m]) for m, n in steps])
        return vote_on_scale(seen, measured, self.config)

    def _take(self, vote: ScaleVote) -> None:
        enough = int(vote.fits.sum()) >= MIN_MOTIONS and vote.fraction >= MIN_AGREEMENT
        if enough and vote.deviation <= MAX_DEVIATION:
            self.found.scale, self.found.deviation = vote.scale, vote.deviation


def _stacked(motions: list[torch.Tensor]) -> Float[torch.Tensor, "m 4 4"]:
    return torch.stack(motions) if motions else torch.zeros(0, 4, 4, dtype=torch.float64)
