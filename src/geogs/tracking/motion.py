"""The motion of one frame against a keyframe of known depth."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from geogs.bundle.motion import solve_poses
from geogs.bundle.select import grid_fields
from geogs.keyframes.grid import SampleGrid
from geogs.keyframes.keyframe import Keyframe
from geogs.tracking.flow.base import FlowMatch, FlowOperator
from geogs.tracking.flow.filled import filled_positions

FIT_ITERATIONS = 6
"""Steps of the motion-only adjustment of a frame."""
FIT_HUBER = 5.0
"""Standard deviations of the flow beyond which a match counts linearly in it."""


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
    residual: float
    """Median distance in pixels between matches and reprojection."""


@dataclass(frozen=True)
class Recognition:
    """A keyframe that shows what an image shows."""

    keyframe: int
    T_rel: Float[Tensor, "4 4"]
    """Keyframe's camera to the image's, float64."""


class FrameLocator:
    """Finds the pose of a frame from flow against keyframes, by motion-only adjustment."""

    def __init__(
        self,
        grid: SampleGrid,
        operator: FlowOperator,
        min_matched: float,
        max_residual: float,
    ) -> None:
        self.grid = grid
        self.operator = operator
        self.min_matched = min_matched
        self.max_residual = max_residual

    def locate(
        self, keyframe: Keyframe, encoded: Any, T_guess: Float[Tensor, "4 4"]
    ) -> FrameMotion | None:
        """Pose of a frame that is near ``T_guess``; None if too little agrees with any pose."""
        forward, backward = grid_fields(self.grid).reproject([keyframe], [T_guess])
        there, _ = self.operator.measure(
            [keyframe.encoded], [encoded], forward, backward, fine=False
        )
        return self._solve(keyframe, there, T_guess)

    def relocate(self, keyframe: Keyframe, encoded: Any) -> FrameMotion | None:
        """Pose of a frame about which nothing is known, by flow from a cold start and PnP."""
        there, _ = self.operator.measure([keyframe.encoded], [encoded], fine=False)
        good = there.sure()[0] & (keyframe.information > 0)
        T_rel = pnp(self.grid, keyframe.inverse_depth, there.pixels[0], good)
        if T_rel is None:
            return None
        return self.locate(keyframe, encoded, T_rel.to(keyframe.T_cw) @ keyframe.T_cw)

    def relocate_any(self, keyframes: Sequence[Keyframe], encoded: Any) -> FrameMotion | None:
        """The first success of :meth:`relocate` over several keyframes."""
        for keyframe in keyframes:
            motion = self.relocate(keyframe, encoded)
            if motion is not None:
                return motion
        return None

    def _solve(
        self, keyframe: Keyframe, match: FlowMatch, T_guess: Float[Tensor, "4 4"]
    ) -> FrameMotion | None:
        fit = self._fit_on_gpu if self.grid.on_gpu else self._fit
        motion = fit(keyframe, match, T_guess)
        if motion is None or motion.matched < self.min_matched:
            return None
        return motion if motion.residual < self.max_residual else None

    def _fit_on_gpu(
        self, keyframe: Keyframe, match: FlowMatch, T_guess: Float[Tensor, "4 4"]
    ) -> FrameMotion | None:
        from geogs.bundle.cuda.motion import fit_frame

        T, (used, agree, residual, flow) = fit_frame(
            self.grid,
            T_guess,
            keyframe.T_cw,
            keyframe.inverse_depth,
            keyframe.information,
            match.pixels[0],
            match.weight[0],
            iterations=FIT_ITERATIONS,
            huber=FIT_HUBER,
            limit=2 * self.max_residual,
        )
        if used < self.min_matched:
            return None
        return FrameMotion(keyframe.id, T, match, flow, agree, residual)

    def _fit(
        self, keyframe: Keyframe, match: FlowMatch, T_guess: Float[Tensor, "4 4"]
    ) -> FrameMotion | None:
        weight = match.weight * (keyframe.information > 0)[:, None]
        used = weight[0, :, 0] > 0
        if float(used.float().mean()) < self.min_matched:
            return None
        frame = torch.zeros(1, dtype=torch.long, device=weight.device)
        T, residual = solve_poses(
            self.grid.camera,
            self.grid.rays,
            T_guess[None],
            keyframe.inverse_depth[None],
            keyframe.T_cw[None],
            frame,
            match.pixels,
            weight,
            iterations=FIT_ITERATIONS,
            huber=FIT_HUBER,
        )
        error = residual[0].norm(dim=-1)
        agree = float((used & (error < 2 * self.max_residual)).float().mean())
        median = float(error[used].median())
        flow = float((match.pixels[0] - self.grid.pixels).norm(dim=-1)[used].median())
        return FrameMotion(keyframe.id, T[0], match, flow, agree, median)


@dataclass(frozen=True)
class ChainedMatch:
    """The motion of a frame since the last keyframe while no depth is known."""

    there: FlowMatch
    """One edge, keyframe -> frame."""
    flow: float
    """Median motion of the matched cells in pixels."""
    matched: float
    """Fraction of the cells that are matched."""


class FlowChain:
    """Follows the flow from a keyframe through the frames after it, each starting from the last."""

    def __init__(self, grid: SampleGrid, operator: FlowOperator) -> None:
        self.grid = grid
        self.operator = operator
        self._there: Tensor | None = None
        self._back: Tensor | None = None

    def reset(self) -> None:
        """Begin again at a new keyframe."""
        self._there = self._back = None

    def follow(self, keyframe: Any, encoded: Any) -> ChainedMatch:
        """Match the keyframe with the next frame."""
        there, back = self.operator.measure(
            [keyframe], [encoded], self._there, self._back, fine=False
        )
        used = there.weight[0, :, 0] > 0
        matched = float(used.float().mean())
        flow = (there.pixels[0] - self.grid.pixels).norm(dim=-1)
        median = float(flow[used].median()) if matched else 0.0
        if matched > 0:
            self._there = filled_positions(self.grid, there)[None]
            self._back = filled_positions(self.grid, back)[None]
        return ChainedMatch(there, median, matched)


def pnp(
    grid: SampleGrid,
    inverse_depth: Float[Tensor, "p"],
    pixels: Float[Tensor, "p 2"],
    good: Bool[Tensor, "p"],
) -> Float[Tensor, "4 4"] | None:
    """Pose T_ji of a view from cells with depth and their positions in it (RANSAC, SQPnP)."""
    if int(good.sum()) < 50:
        return None
    points = (grid.rays[good] / inverse_depth[good, None]).double().cpu().numpy()
    image = pixels[good].double().cpu().numpy()
    threshold = max(grid.camera.width, grid.camera.height) / 250
    ok, rotation, translation, inliers = cv2.solvePnPRansac(
        points,
        image,
        grid.camera.matrix().numpy(),
        None,
        iterationsCount=200,
        reprojectionError=threshold,
        flags=cv2.SOLVEPNP_SQPNP,
    )
    if not ok or inliers is None or len(inliers) < 0.3 * len(points):
        return None
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(rotation)[0], translation[:, 0]
    return torch.from_numpy(T) if np.isfinite(T).all() else None
