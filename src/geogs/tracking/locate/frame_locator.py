"""Pose of one frame relative to a keyframe of known depth."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.device_choice import grid_fields, motion_solver
from geogs.tracking.flow.flow_operator import FlowOperator
from geogs.tracking.keyframes.keyframe_choice import SeenMotion
from geogs.tracking.matching.photometric_check import PhotometricCheck, correlation_at
from geogs.tracking.matching.pnp import pnp, pnp_features
from geogs.tracking.matching.sparse_features import match_features
from geogs.types import FlowMatch
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import Keyframe

MIN_KNOWN = 0.1
"""Least fraction of a keyframe's cells whose depth is known to 30 % and matched in the image for
the camera's position to be known; below it only the rotation is tracked."""
FIT_ITERATIONS = 6
"""Steps of the motion-only adjustment of a frame."""
FIT_HUBER = 5.0
"""Huber threshold of this adjustment, in standard deviations of the flow."""
MAX_DIFFERENCE = 1.0
"""Largest median difference, in pixels, of matches from two searches that found the same pose; for
two repetitions of a pattern they differ by its period."""
DOUBTFUL_OVERLAP = 0.7
"""Fraction of the keyframe's known depths that agrees with a predicted pose, below which the frame
is also searched for without a guess: a guess off by half a period of a pattern leads to the wrong
repetition, which agrees over a part of the image."""
CONFIRMED_NCC = 0.95
"""Correlation of the images' windows above which a pose found by flow both with and without a guess
is accepted without features. Of 32 wrong poses before rendered chessboards 3 remain, as with
features always, against 9 if both searches are enough; a real corridor has 0.97."""
FEATURE_CANDIDATES = 2
"""Keyframes whose features are matched with a frame when the camera is lost."""


@dataclass(frozen=True, kw_only=True)
class FrameMotion(SeenMotion):
    """A frame located against a keyframe; its overlap is the fraction of the keyframe's cells with
    known depth whose match agrees with the pose."""

    keyframe: int
    T_cw: Float[Tensor, "4 4"]
    """World to camera, float64."""
    matched: float
    """The same fraction of all cells."""
    known: float
    """Fraction of the keyframe's cells that are matched, with a depth known well enough to locate
    the camera."""
    residual: float
    """Median distance in pixels between matches and reprojection."""
    check: PhotometricCheck
    """Agreement of the images at this pose."""

    def is_where(self, other: "FrameMotion") -> bool:
        """Whether the median difference from another pose's matches of the keyframe is small."""
        both = self.match.sure()[0] & other.match.sure()[0]
        off = (self.match.pixels - other.match.pixels)[0, both].norm(dim=-1)
        return len(off) > 0 and float(off.median()) < MAX_DIFFERENCE


@dataclass(frozen=True)
class Recognition:
    """A keyframe recognised in an image."""

    keyframe: int
    T_rel: Float[Tensor, "4 4"]
    """Keyframe's camera to the image's, float64."""


class FrameLocator:
    """Estimates the pose of a frame from flow against keyframes, by motion-only adjustment.

    A pose is accepted if enough of the flow agrees with it, and it passes the photometric check.
    """

    def __init__(
        self,
        grid: SampleGrid,
        operator: FlowOperator,
        min_matched: float,
        max_residual: float,
        min_ncc: float,
    ) -> None:
        self.grid = grid
        self.operator = operator
        self.min_matched = min_matched
        self.max_residual = max_residual
        self.min_ncc = min_ncc

    def locate(
        self,
        keyframe: Keyframe,
        encoded: Any,
        T_guess: Float[Tensor, "4 4"],
        is_expected: bool = True,
    ) -> FrameMotion | None:
        """Estimate the pose of a frame near ``T_guess``; None if too few matches agree with any.

        A frame that was not expected there has to pass the photometric check; an expected one only
        where there is texture.
        """
        forward, backward = grid_fields(self.grid).reproject([keyframe], [T_guess])
        match, _ = self.operator.measure(
            [keyframe.encoded], [encoded], forward, backward, fine=False
        )
        return self.fit(keyframe, encoded, T_guess, match, is_expected)

    def locate_both_ways(
        self,
        first: Keyframe,
        second: Keyframe,
        T_second: Float[Tensor, "4 4"],
        T_first: Float[Tensor, "4 4"],
    ) -> tuple[FrameMotion | None, FrameMotion | None]:
        """Locate each of two keyframes on the other's depth, by one flow measurement.

        ``T_second`` is an initial pose of the second in the world of the first, ``T_first`` the
        other way round; the two may differ in scale. Neither counts as expected.
        """
        expected, _ = grid_fields(self.grid).reproject([first, second], [T_second, T_first])
        there, back = self.operator.measure(
            [first.encoded], [second.encoded], expected[:1], expected[1:], fine=False
        )
        return (
            self.fit(first, second.encoded, T_second, there, is_expected=False),
            self.fit(second, first.encoded, T_first, back, is_expected=False),
        )

    def fit(
        self,
        keyframe: Keyframe,
        encoded: Any,
        T_guess: Float[Tensor, "4 4"],
        match: FlowMatch,
        is_expected: bool = True,
    ) -> FrameMotion | None:
        """Do the same as :meth:`locate`, by flow that has already been measured."""
        T, T_ji, fit = motion_solver(self.grid).fit(
            T_guess,
            keyframe,
            match.pixels[0],
            match.weight[0],
            iterations=FIT_ITERATIONS,
            huber=FIT_HUBER,
            limit=2 * self.max_residual,
        )
        seen = correlation_at(
            self.grid,
            self.operator.grey(keyframe.encoded),
            self.operator.grey(encoded),
            T_ji,
            keyframe.inverse_depth,
            keyframe.information,
        )
        # Copied at once, to wait for a GPU only once.
        found = torch.cat([T.reshape(-1), fit.to(T), seen.to(T)]).cpu()
        _, agree, residual, flow, parallax, informed, known = found[16:23].tolist()
        check = PhotometricCheck.of(found[23:25])
        if agree < self.min_matched or not residual < self.max_residual:
            return None
        if not check.passes(self.min_ncc, is_expected):
            return None
        return FrameMotion(
            flow,
            agree / informed,
            match,
            parallax,
            keyframe=keyframe.id,
            T_cw=found[:16].reshape(4, 4),
            matched=agree,
            known=known,
            residual=residual,
            check=check,
        )

    def locate_relative(
        self, keyframe: Keyframe, encoded: Any, T_rel: Float[Tensor, "4 4"] | None
    ) -> FrameMotion | None:
        """Estimate the pose of an unexpected frame near a guess relative to a keyframe, if any."""
        if T_rel is None:
            return None
        T_guess = T_rel.to(keyframe.T_cw) @ keyframe.T_cw
        return self.locate(keyframe, encoded, T_guess, is_expected=False)

    def relocate(self, keyframe: Keyframe, encoded: Any) -> FrameMotion | None:
        """Estimate the pose of a frame without a guess, by flow from a cold start and PnP."""
        there, _ = self.operator.measure([keyframe.encoded], [encoded], fine=False)
        good = there.sure()[0] & (keyframe.information > 0)
        T_rel = pnp(self.grid, keyframe.inverse_depth, there.pixels[0], good)
        return self.locate_relative(keyframe, encoded, T_rel)

    def relocate_by_features(self, keyframe: Keyframe, encoded: Any) -> FrameMotion | None:
        """Do the same as :meth:`relocate`, by sparse features: the motion may be of any size."""
        grey = self.operator.grey
        found = match_features(grey(keyframe.encoded), grey(encoded))
        T_rel = None if found is None else pnp_features(self.grid, keyframe, found)
        return self.locate_relative(keyframe, encoded, T_rel)

    def relocate_any(self, keyframes: Sequence[Keyframe], encoded: Any) -> FrameMotion | None:
        """Return the first success of :meth:`relocate` over several keyframes, likeliest first.

        Where all fail, features are tried with the first ``FEATURE_CANDIDATES`` of them.
        """
        attempts = [(self.relocate, k) for k in keyframes]
        attempts += [(self.relocate_by_features, k) for k in keyframes[:FEATURE_CANDIDATES]]
        motions = (attempt(keyframe, encoded) for attempt, keyframe in attempts)
        return next((motion for motion in motions if motion is not None), None)

    def best(
        self, keyframe: Keyframe, encoded: Any, expected: FrameMotion | None
    ) -> FrameMotion | None:
        """Return the pose with which most of the keyframe agrees: the expected one or, if that is
        doubtful, one found without a guess; features are used where flow found another pose."""
        if expected is None or expected.overlap >= DOUBTFUL_OVERLAP:
            return expected
        cold = with_depth(self.relocate(keyframe, encoded))
        found = [expected] if cold is None else [expected, cold]
        if cold is None or not (
            cold.is_where(expected) and cold.check.correlation >= CONFIRMED_NCC
        ):
            features = with_depth(self.relocate_by_features(keyframe, encoded))
            found += [] if features is None else [features]
        return max(found, key=lambda motion: motion.matched)


def with_depth(motion: FrameMotion | None) -> FrameMotion | None:
    """Return a motion if enough cells of known depth support it, else None."""
    return None if motion is None or motion.known < MIN_KNOWN else motion
