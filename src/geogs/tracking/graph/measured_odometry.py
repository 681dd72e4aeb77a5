"""Odometry poses from another tracker: agreement with the images, scale, and motion terms.

Only motions between neighbouring keyframes are used, so that its own world frame and drift do no
harm. They are not used at all until enough of them fit those of the images.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Float

from geogs.bundle.terms import MeasuredMotions
from geogs.config import OdometryConfig
from geogs.geometry.lie import se3_inverse
from geogs.priors.odometry import ScaleVote, information_of, vote_on_scale
from geogs.types import MeasuredPose
from geogs.world.keyframes import Keyframe, KeyframeSet
from geogs.world.segments import OdometryScale

MIN_AGREEMENT = 0.4
"""Fraction of the motions that must fit those of the images before any is used: those of another
recording hardly ever fit."""
MIN_MOTIONS = 5
"""Motions that must fit before any is used."""
MAX_DEVIATION = 0.1
"""Largest relative deviation of the scale at which motions are used."""
PRECISE = 0.003
"""Relative deviation of the scale above which it is estimated again with every keyframe."""
LATEST = 200
"""Latest keyframes whose motions are used for the scale while the camera is tracked."""


@dataclass(frozen=True)
class OdometryAgreement:
    """Agreement of odometry with the images."""

    motions: int
    """Number of odometry motions between neighbouring keyframes."""
    fitting: float
    """Fraction of these that fit within their deviations."""
    used: bool
    """Whether they were used."""


class Odometry:
    """Motions between the keyframes of a segment by another tracker."""

    def __init__(
        self, keyframes: KeyframeSet, config: OdometryConfig, found: OdometryScale | None = None
    ) -> None:
        """``found`` is the scale so far, changed in place."""
        self.keyframes = keyframes
        self.config = config
        self.found = found or OdometryScale()

    def update_scale(self) -> None:
        """Estimate the scale from the latest keyframes, if it is not precise yet."""
        ids = self.keyframes.ids[-LATEST:]
        if not ids or self.keyframes[ids[-1]].pose is None:
            return
        if self.found.scale is None or self.found.deviation > PRECISE:
            self._take(self._vote(ids))

    def update_scale_by_all(self) -> None:
        """Estimate the scale from all keyframes."""
        self._take(self._vote(self.keyframes.ids))

    def agreement(self) -> OdometryAgreement:
        """Return the agreement of all motions, at the present poses."""
        vote = self._vote(self.keyframes.ids)
        return OdometryAgreement(len(vote.fits), vote.fraction, self.found.scale is not None)

    def between(self, ids: Sequence[int]) -> MeasuredMotions | None:
        """Return the motions from each of some keyframes to the next, in the unit of the map.

        Sources and targets are indices among the ids. None where motions are not used.
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
        """Return the odometry motion from a keyframe to a pose, in the unit of the map."""
        before = keyframe.pose
        scale = self.found.scale
        if scale is None or pose is None or before is None or before.world != pose.world:
            return None
        motion = pose.T_cw @ se3_inverse(before.T_cw)
        motion[:3, 3] /= scale
        return motion

    def _measured(
        self, ids: Sequence[int]
    ) -> tuple[list[tuple[int, int]], Float[torch.Tensor, "m 4 4"]]:
        """Return neighbours with poses in one world, as index pairs among ``ids``, and the motions
        from each to the next, metres."""
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
