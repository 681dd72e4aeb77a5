"""A walk along the wall of a long hall and back, with exact matches: large problems, no images."""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.projection import project
from geogs.config import Config
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_exp, se3_inverse
from geogs.geometry.umeyama import umeyama
from geogs.tracking.flow.flow_operator import Memories
from geogs.tracking.tracker import Tracker, lone_tracker
from geogs.types import FlowMatch
from geogs.world.grid import SampleGrid
from geogs.world.segments import TrackState

CAMERA = Camera(fx=480.0, fy=480.0, cx=255.5, cy=143.5, width=512, height=288)
"""Camera of a real run: 64 x 36 cells."""
SMALL = Camera(fx=75.0, fy=75.0, cx=39.5, cy=27.5, width=80, height=56)

STEP = 0.12
"""Metres between keyframes."""


def walk(count: int) -> Float[Tensor, "n 4 4"]:
    """World to camera: half of the keyframes one way, half back, looking at the wall z = 3."""
    k = np.arange(count)
    half = count // 2
    along = STEP * np.where(k < half, k, 2 * half - 1 - k)
    back = (k >= half).astype(float)
    xi = np.zeros((count, 6))
    xi[:, 4] = 0.35 * np.sin(0.11 * k) + 0.1
    xi[:, 3] = 0.05 * np.sin(0.07 * k)
    T_wc = se3_exp(torch.from_numpy(xi))
    centre = np.stack([along, 0.15 * np.sin(0.2 * k), 0.3 * np.sin(0.05 * k) - 0.2 * back], -1)
    T_wc[:, :3, 3] = torch.from_numpy(centre)
    return se3_inverse(T_wc)


def true_inverse_depth(T_cw: Float[Tensor, "n 4 4"], grid: SampleGrid) -> Float[Tensor, "n p"]:
    """Inverse depths of a hall with floor, ceiling, wall and two far ends, seen from inside."""
    T_wc = se3_inverse(T_cw)
    direction = grid.rays.double() @ T_wc[:, :3, :3].mT
    centre = T_wc[:, None, :3, 3]
    low = torch.tensor([-20.0, -1.5, -8.0], dtype=torch.float64)
    high = torch.tensor([20.0 + float(T_wc[:, 0, 3].max()), 1.2, 3.0], dtype=torch.float64)
    reach = torch.where(direction > 0, high - centre, low - centre) / direction
    return (1 / reach.amin(-1)).float()


class PlantedFlow:
    """Finds every match exactly but for noise of ``sigma`` pixels; images are their numbers."""

    def __init__(self, grid: SampleGrid, T_cw: Tensor, inverse_depth: Tensor, sigma: float) -> None:
        self.grid, self.T, self.d, self.sigma = grid, T_cw, inverse_depth, sigma

    def encode(self, image: np.ndarray) -> int:
        """The number that an image stands for."""
        return int(image[0, 0, 0]) + 256 * int(image[0, 0, 1])

    def texture(self, encoded: int) -> float:
        """Enough in every image."""
        return 1.0

    def grey(self, encoded: int) -> Tensor:
        """None is to be seen."""
        return torch.zeros(self.grid.camera.height, self.grid.camera.width)

    def measure(
        self,
        first: Sequence[int],
        second: Sequence[int],
        forward: Tensor | None = None,
        backward: Tensor | None = None,
        fine: bool = True,
        memory: Memories | None = None,
    ) -> tuple[FlowMatch, FlowMatch]:
        """True positions of the cells."""
        return self._match(first, second), self._match(second, first)

    def _match(self, source: Sequence[int], target: Sequence[int]) -> FlowMatch:
        i, j = list(source), list(target)
        p = project(self.grid.camera, self.grid.rays, self.T[j] @ se3_inverse(self.T[i]), self.d[i])
        seed = 7919 * i[0] + j[0]
        g = torch.Generator().manual_seed(seed)
        pixels = p.pixels + self.sigma * torch.randn(p.pixels.shape, generator=g)
        seen = p.valid & self.grid.inside(p.pixels)
        weight = torch.where(seen, 1 / max(self.sigma, 0.05) ** 2, 0.0)
        return FlowMatch(pixels, weight[..., None].expand(-1, -1, 2).contiguous())


def walked_tracker(
    camera: Camera, flow: PlantedFlow, image_of: Callable[[int], np.ndarray]
) -> Tracker:
    """One that holds the walk of a flow with its depths, ten keyframes a second."""
    tracker = lone_tracker(camera, operator=flow)
    for n, (T, d) in enumerate(zip(flow.T, flow.d, strict=True)):
        state = tracker.keyframes.add(n, n / 10, image_of(n), n, T.clone())
        state.inverse_depth, state.information = d.clone(), torch.full_like(d, 1e4)
        tracker.map.recorder.add_keyframe(state)
    tracker.segment.status.state = TrackState.TRACKING
    return tracker


def centre_error(tracker: Tracker, truth: Tensor) -> float:
    """Root mean square error of the keyframes' centres after a similarity."""
    poses = tracker.keyframes.poses(range(len(truth)))
    x, y = (se3_inverse(T)[:, :3, 3] for T in (poses, truth))
    scale, R, t = umeyama(x, y)
    return float((scale * x @ R.T + t - y).square().sum(1).mean().sqrt())


def planted_tracker(
    count: int, camera: Camera = SMALL, sigma: float = 0.1
) -> tuple[Tracker, Float[Tensor, "n 4 4"]]:
    """A tracker that holds the true walk with true depths, and the true poses."""
    grid = SampleGrid(camera)
    T = walk(count)
    d = true_inverse_depth(T, grid)
    T = T @ se3_inverse(T[0])  # the first pose is the identity
    tracker = lone_tracker(camera, Config(), operator=PlantedFlow(grid, T, d, sigma))
    for n in range(count):
        image = np.full((4, 4, 3), (n % 256, n // 256, 0), np.uint8)
        state = tracker.keyframes.add(n, n / 3, image, n, T[n].clone())
        state.inverse_depth = d[n].clone()
        state.information = torch.full_like(d[n], 1e4)
    tracker.segment.status.state = TrackState.TRACKING
    return tracker, T


def drift(tracker: Tracker, scale: float = 0.0, yaw: float = 0.0) -> None:
    """Bend the walk smoothly: lengths grow by ``scale`` and the view turns by ``yaw`` to its end.

    Every keyframe stays consistent with its neighbours to first order, as after a long chain.
    """
    states = list(tracker.keyframes)
    before = [s.T_cw for s in states]
    T = before[0]
    for n, state in enumerate(states):
        share = n / max(len(states) - 1, 1)
        factor = 1 + scale * share
        if n:
            step = before[n] @ torch.linalg.inv(before[n - 1])
            step[:3, 3] *= factor
            turn = torch.zeros(6, dtype=torch.float64)
            turn[4] = yaw / len(states)
            T = se3_exp(turn) @ step @ T
        state.T_cw = T
        state.inverse_depth = state.inverse_depth / factor
