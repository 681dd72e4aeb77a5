"""The motion of one frame against a keyframe of known depth."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.bundle.select import grid_fields, motion_solver
from geogs.geometry.camera import Camera
from geogs.tracking.evidence import (
    Evidence,
    correlation_at,
    correlation_matched,
    matched_motion,
)
from geogs.tracking.features import FeatureMatches, match_features, surer_flow
from geogs.tracking.flow.filled import filled_positions
from geogs.tracking.flow.flow_operator import FlowOperator
from geogs.types import FlowMatch
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import Keyframe
from geogs.world.segments import ChainedPositions

MIN_TEXTURE = 0.05
"""A frame is skipped when less than this fraction of it has structure."""
MIN_MATCHED = 0.12
"""The camera is lost when less than this fraction of a keyframe finds a match."""
MIN_KNOWN = 0.1
"""Where the camera is cannot be told when the depth of less than this fraction of a keyframe is
known to 30 % and found in the image: then it is followed as if it only rotated."""
MIN_NCC = 0.5
"""A frame counts as located where the images agree: least median correlation (NCC) of windows of
9 x 9 pixels, reprojected by pose and depth. Unlike images come to 0, one place to 0.7 and more.
Where too few windows have texture the flow alone decides whether the camera is still where it was
followed to; a map is never started, nor a camera found again, without evidence."""
FIT_ITERATIONS = 6
"""Steps of the motion-only adjustment of a frame."""
FIT_HUBER = 5.0
"""Standard deviations of the flow beyond which a match counts linearly in it."""

FEATURE_PLACES = 2
"""Keyframes with which the features of a frame are compared when the camera is lost."""
MIN_POINTS = 50, 25
"""Fewest cells, and fewest features, that a pose is found from."""


@dataclass(frozen=True)
class FrameMotion:
    """A frame located against a keyframe."""

    keyframe: int
    T_cw: Float[Tensor, "4 4"]
    """float64."""
    match: FlowMatch
    """One edge, keyframe -> frame."""
    flow: float
    """Median motion of the matched cells in pixels: what the motion filter looks at."""
    matched: float
    """Fraction of the keyframe's cells with a match that agrees with the pose."""
    overlap: float
    """The same of those of its cells whose depth is known."""
    known: float
    """Fraction of the keyframe's cells that are matched and whose depth is known well enough to
    tell where the camera is."""
    residual: float
    """Median distance in pixels between matches and reprojection."""
    evidence: Evidence
    """What the images say of it."""


@dataclass(frozen=True)
class Recognition:
    """A keyframe that shows what an image shows."""

    keyframe: int
    T_rel: Float[Tensor, "4 4"]
    """Keyframe's camera to the image's, float64."""


class FrameLocator:
    """Finds the pose of a frame from flow against keyframes, by motion-only adjustment.

    A pose is believed where enough of the flow agrees with it, and the images do.
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
        """Pose of a frame that is near ``T_guess``; None if too little agrees with any pose.

        A frame that was not expected there needs the images' evidence; one that was, only where
        there is texture to have any.
        """
        forward, backward = grid_fields(self.grid).reproject([keyframe], [T_guess])
        there, _ = self.operator.measure(
            [keyframe.encoded], [encoded], forward, backward, fine=False
        )
        return self._solve(keyframe, encoded, there, T_guess, is_expected)

    def relocate(self, keyframe: Keyframe, encoded: Any) -> FrameMotion | None:
        """Pose of a frame about which nothing is known, by flow from a cold start and PnP."""
        there, _ = self.operator.measure([keyframe.encoded], [encoded], fine=False)
        good = there.sure()[0] & (keyframe.information > 0)
        T_rel = pnp(self.grid, keyframe.inverse_depth, there.pixels[0], good)
        if T_rel is None:
            return None
        T_guess = T_rel.to(keyframe.T_cw) @ keyframe.T_cw
        return self.locate(keyframe, encoded, T_guess, is_expected=False)

    def relocate_by_features(self, keyframe: Keyframe, encoded: Any) -> FrameMotion | None:
        """As :meth:`relocate`, by sparse features: the motion may be of any size."""
        grey = self.operator.grey
        found = match_features(grey(keyframe.encoded), grey(encoded))
        if found is None:
            return None
        T_rel = pnp_features(self.grid, keyframe, found)
        if T_rel is None:
            return None
        T_guess = T_rel.to(keyframe.T_cw) @ keyframe.T_cw
        return self.locate(keyframe, encoded, T_guess, is_expected=False)

    def relocate_any(self, keyframes: Sequence[Keyframe], encoded: Any) -> FrameMotion | None:
        """The first success of :meth:`relocate` over several keyframes, the likeliest first.

        Where all fail, features are tried with the first ``FEATURE_PLACES`` of them.
        """
        for keyframe in keyframes:
            motion = self.relocate(keyframe, encoded)
            if motion is not None:
                return motion
        for keyframe in keyframes[:FEATURE_PLACES]:
            motion = self.relocate_by_features(keyframe, encoded)
            if motion is not None:
                return motion
        return None

    def _solve(
        self,
        keyframe: Keyframe,
        encoded: Any,
        match: FlowMatch,
        T_guess: Float[Tensor, "4 4"],
        is_expected: bool,
    ) -> FrameMotion | None:
        T, T_ji, judged = motion_solver(self.grid).fit(
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
        # All at once, so that a GPU is waited for once.
        found = torch.cat([T.reshape(-1), judged.to(T), seen.to(T)]).cpu()
        _, agree, residual, flow, informed, known = found[16:22].tolist()
        if agree < self.min_matched or not residual < self.max_residual:
            return None
        evidence = Evidence.of(found[22:24])
        if not evidence.bears_out(self.min_ncc, is_expected):
            return None
        return FrameMotion(
            keyframe.id,
            found[:16].reshape(4, 4),
            match,
            flow,
            agree,
            agree / informed,
            known,
            residual,
            evidence,
        )


@dataclass(frozen=True)
class ChainedMatch:
    """The motion of a frame since the last keyframe while no depth is known."""

    there: FlowMatch
    """One edge, keyframe -> frame."""
    flow: float
    """Median motion of the matched cells in pixels."""
    matched: float
    """Fraction of the cells that are matched; 0 where the images do not agree there."""


class FlowChain:
    """Follows the flow from a first image through those after it, each starting from the last."""

    def __init__(self, grid: SampleGrid, operator: FlowOperator) -> None:
        self.grid = grid
        self.operator = operator

    def follow(self, chain: ChainedPositions, first: Any, encoded: Any) -> ChainedMatch:
        """Match the first image with the next one, from where ``chain`` has come to."""
        there, back = self.operator.measure([first], [encoded], chain.there, chain.back, fine=False)
        there, back = surer_flow(self.grid, self.operator, first, encoded, there, back)
        # What the images say where the flow, for want of a pose, leads.
        images = self.operator.grey(first), self.operator.grey(encoded)
        seen = correlation_matched(self.grid, *images, there.pixels[0])
        moved = matched_motion(self.grid, there.pixels[0], there.weight[0])
        # All at once, so that a GPU is waited for once.
        found = torch.cat([moved, seen]).cpu()
        matched, flow = found[:2].tolist()
        if not Evidence.of(found[2:]).bears_out(MIN_NCC, is_expected=True):
            matched = 0.0
        if matched > 0:
            chain.there = filled_positions(self.grid, there)[None]
            chain.back = filled_positions(self.grid, back)[None]
        return ChainedMatch(there, flow if matched else 0.0, matched)


def pnp(
    grid: SampleGrid,
    inverse_depth: Float[Tensor, "p"],
    pixels: Float[Tensor, "p 2"],
    good: Bool[Tensor, "p"],
) -> Float[Tensor, "4 4"] | None:
    """Pose T_ji of a view from cells with depth and their positions in it."""
    points = grid.rays[good] / inverse_depth[good, None]
    return _pnp(grid.camera, points, pixels[good], MIN_POINTS[0])


def pnp_features(
    grid: SampleGrid, keyframe: Keyframe, matches: FeatureMatches
) -> Float[Tensor, "4 4"] | None:
    """Pose T_ji of a view from features of a keyframe, which have the depth of their cells."""
    cell, inside = grid.cells_of(matches.first.to(grid.device))
    known = inside & (keyframe.information[cell] > 0)
    c, p = grid.camera, matches.first.to(grid.device)
    rays = torch.stack([(p[:, 0] - c.cx) / c.fx, (p[:, 1] - c.cy) / c.fy, p[:, 0] * 0 + 1], -1)
    points = (rays / keyframe.inverse_depth[cell, None])[known]
    return _pnp(c, points, matches.second.to(grid.device)[known], MIN_POINTS[1])


def _pnp(
    camera: Camera, points: Float[Tensor, "n 3"], pixels: Float[Tensor, "n 2"], least: int
) -> Float[Tensor, "4 4"] | None:
    """Pose of a view from at least so many points and where it sees them (RANSAC, SQPnP)."""
    if len(points) < least:
        return None
    ok, rotation, translation, inliers = cv2.solvePnPRansac(
        points.double().cpu().numpy(),
        pixels.double().cpu().numpy(),
        camera.matrix().numpy(),
        None,
        iterationsCount=200,
        reprojectionError=max(camera.width, camera.height) / 250,
        flags=cv2.SOLVEPNP_SQPNP,
    )
    if not ok or inliers is None or len(inliers) < 0.3 * len(points):
        return None
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(rotation)[0], translation[:, 0]
    return torch.from_numpy(T) if np.isfinite(T).all() else None
