"""Keyframes of synthetic rooms with exact depth and poses, for tests of loop detection."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_inverse
from geogs.tracking.flow.classical_flow import ClassicalFlow
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeSet, KeyframeTable
from geogs_synth.raycast.raycaster import Raycaster, RenderedView
from geogs_synth.scene.textured_scene import Scene
from lit_rooms import lit_room

CAMERA = Camera(fx=260.0, fy=260.0, cx=191.5, cy=143.5, width=384, height=288)


def orbit(scene: Scene, count: int, turn: float = 0.0) -> list[np.ndarray]:
    """Camera-to-world poses on a circle of half a metre that look outwards, once around.

    ``turn`` in radians is added to every direction.
    """
    angles = turn + np.linspace(0, 2 * np.pi, count, endpoint=False)
    return [at_angle(scene, angle) for angle in angles]


def at_angle(scene: Scene, angle: float) -> np.ndarray:
    """Camera to world half a metre from the middle of a room, looking outwards."""
    forward = np.array([np.cos(angle), np.sin(angle), -0.15])
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    T[:3, 3] = scene.size * [0.5, 0.5, 0.55] - 0.5 * forward * [1, 1, 0]
    return T


def views(scene: Scene, poses: Sequence[np.ndarray]) -> list[RenderedView]:
    """Rendered with one thread."""
    return _rendered(Raycaster(scene, threads=1), poses)


def room_views(seed: int, poses: Sequence[np.ndarray]) -> list[RenderedView]:
    """Views of a furnished room."""
    return _rendered(lit_room(seed), poses)


def _rendered(caster: Raycaster, poses: Sequence[np.ndarray]) -> list[RenderedView]:
    return [caster.render(CAMERA, T) for T in poses]


def stretched(scene: Scene, factor: float) -> Scene:
    """The room with everything longer along y: its pictures show the same things."""
    f = np.array([1.0, factor, 1.0])
    s = scene.solids
    along = np.abs(np.einsum("nij,i->nj", s.rotation, np.array([0.0, 1.0, 0.0])))
    half = s.half * (1 + (factor - 1) * along**2)
    return replace(scene, size=scene.size * f, solids=replace(s, centre=s.centre * f, half=half))


def keyframes(
    seen: Sequence[RenderedView], poses: Sequence[np.ndarray]
) -> tuple[KeyframeSet, ClassicalFlow]:
    """A store of the views with their true depth, and the operator that encoded them."""
    grid = SampleGrid(CAMERA)
    store, operator = KeyframeTable.on(grid).new_set(), ClassicalFlow(grid)
    for n, (view, T_wc) in enumerate(zip(seen, poses, strict=True)):
        T_cw = se3_inverse(torch.from_numpy(T_wc))
        state = store.add(n, n / 30, view.image, operator.encode(view.image), T_cw)
        x, y = grid.pixels.long().unbind(-1)
        depth = torch.from_numpy(view.depth)[y, x]
        state.information = (depth > 0).float()
        state.inverse_depth = torch.where(depth > 0, 1 / depth.clamp(min=1e-6), 1.0)
    return store, operator
