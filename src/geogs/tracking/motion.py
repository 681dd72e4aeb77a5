"""The motion of one frame against a keyframe of known depth."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor

from geogs.bundle.motion import solve_poses
from geogs.bundle.projection import project
from geogs.errors import InputError
from geogs.geometry.lie import se3_inverse
from geogs.keyframes.grid import SampleGrid
from geogs.keyframes.keyframe import Keyframe
from geogs.tracking.flow.base import FlowMatch, FlowOperator

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
        forward, backward = all_reprojections(self.grid, [keyframe], [T_guess])
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


@dataclass(frozen=True, eq=False)
class ChainState:
    """What a checkpoint holds of a chain: where the cells are, in both directions."""

    there: Float32[Tensor, "1 p 2"] | None
    back: Float32[Tensor, "1 p 2"] | None


class FlowChain:
    """Follows the flow from a keyframe through the frames after it, each starting from the last."""

    def __init__(self, grid: SampleGrid, operator: FlowOperator) -> None:
        self.grid = grid
        self.operator = operator
        self._there: Tensor | None = None
        self._back: Tensor | None = None

    def state(self) -> ChainState:
        """What a checkpoint holds."""
        return ChainState(self._there, self._back)

    def load(self, state: ChainState) -> None:
        """Go on where another was. Raises InputError if that was of another camera."""
        for positions in (state.there, state.back):
            if positions is not None and positions.shape[1] != self.grid.size:
                raise InputError("the flow of the start is of another camera")
        self._there, self._back = state.there, state.back

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


def filled_positions(grid: SampleGrid, match: FlowMatch) -> Float[Tensor, "p 2"]:
    """Positions of a single edge, unmatched cells filled in from the flow around them."""
    return grid.pixels + filled_flow(grid, match)


def filled_flow(grid: SampleGrid, match: FlowMatch) -> Float[Tensor, "p 2"]:
    """Flow of a single edge, unmatched cells filled in from around them."""
    flow, weight = match.pixels[0] - grid.pixels, match.weight[0, :, 0]
    return grid.fill_all(flow.mT, weight.expand(2, -1)).mT.contiguous()


def all_reprojections(
    grid: SampleGrid, keyframes: Sequence[Keyframe], T_cw: Sequence[Float[Tensor, "4 4"]]
) -> tuple[Float[Tensor, "e p 2"], Float[Tensor, "e p 2"]]:
    """:func:`both_reprojections` of several pairs of a keyframe and a frame."""
    if not grid.on_gpu:
        views = [both_reprojections(grid, k, T) for k, T in zip(keyframes, T_cw, strict=True)]
        return torch.stack([v[0] for v in views]), torch.stack([v[1] for v in views])
    from geogs.bundle.cuda.fields import carry_depth

    rows = {k.id: k for k in keyframes}
    slot = {id: n for n, id in enumerate(rows)}
    there, back = carry_depth(
        grid,
        torch.stack(list(T_cw)),
        torch.stack([k.T_cw for k in rows.values()]),
        torch.tensor([slot[k.id] for k in keyframes]),
        torch.stack([k.inverse_depth for k in rows.values()]),
        torch.stack([k.information for k in rows.values()]),
        reproject=True,
    )
    return there, back


def both_reprojections(
    grid: SampleGrid, keyframe: Keyframe, T_cw: Float[Tensor, "4 4"]
) -> tuple[Float[Tensor, "p 2"], Float[Tensor, "p 2"]]:
    """Cells of the keyframe in a frame at ``T_cw``, and cells of that frame in the keyframe.

    The frame has no depth of its own; it borrows the keyframe's.
    """
    T = T_cw @ se3_inverse(keyframe.T_cw)
    depth, _ = transfer_depth(grid, T, keyframe.inverse_depth, keyframe.information)
    there = project(grid.camera, grid.rays, T[None], keyframe.inverse_depth[None])
    back = project(grid.camera, grid.rays, se3_inverse(T)[None], depth[None])
    return there.pixels[0], back.pixels[0]


def transfer_depth(
    grid: SampleGrid,
    T_ji: Float[Tensor, "4 4"],
    inverse_depth: Float[Tensor, "p"],
    information: Float[Tensor, "p"],
) -> tuple[Float[Tensor, "p"], Float[Tensor, "p"]]:
    """Inverse depth and information of frame i as seen from frame j; nearest surface wins.

    Cells that nothing falls on are filled from their surroundings and have no information.
    """
    if grid.on_gpu:
        from geogs.bundle.cuda.fields import carry_depth

        depth, carried = carry_depth(
            grid,
            T_ji[None],
            torch.eye(4).to(T_ji)[None],
            torch.zeros(1, dtype=torch.long),
            inverse_depth[None],
            information[None],
            reproject=False,
        )
        return depth[0], carried[0]
    R, t = T_ji[:3, :3].to(inverse_depth), T_ji[:3, 3].to(inverse_depth)
    z = (grid.rays @ R.mT + inverse_depth[:, None] * t)[:, 2]
    p = project(grid.camera, grid.rays, T_ji[None], inverse_depth[None])
    cell, hit = grid.cells_of(p.pixels[0])
    hit &= p.valid[0]
    moved = torch.where(hit, inverse_depth / z.clamp(min=1e-6), torch.zeros_like(z))
    depth = torch.zeros_like(moved).scatter_reduce(0, cell, moved, "amax")
    nearest = hit & (moved >= 0.98 * depth[cell])
    kept = torch.where(nearest, information * z.square(), torch.zeros_like(z))
    transferred = torch.zeros_like(kept).scatter_reduce(0, cell, kept, "amax")
    seen = depth > 0
    # A token confidence lets cells without information still be filled from, if weakly.
    return grid.fill(depth, torch.where(seen, transferred + 1e-6, 0.0)), transferred * seen


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
