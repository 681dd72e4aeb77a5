"""Simulated monocular priors with errors like those of networks, and rooms that need them."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Float32, UInt8

from geogs.priors.monocular_prior import DepthKind, PriorMaps
from geogs_synth.raycast.raycaster import RenderedView
from geogs_synth.scene.solids import BOX
from geogs_synth.scene.textured_scene import Scene
from geogs_synth.textures.patterns import fractal_noise


@dataclass(frozen=True)
class PriorErrors:
    """Errors of a simulated prior. Every image has its own random errors."""

    scale: float = 0.3
    """Standard deviation of the logarithm of the factor common to an image."""
    shift: float = 0.1
    """Standard deviation of its shift, as a fraction of the median, if the kind has one."""
    warp: float = 0.08
    """Standard deviation of the logarithm of a smooth factor that varies over the image."""
    warp_cells: int = 2
    """Approximate number of waves of that factor across the image."""
    noise: float = 0.02
    """Relative standard deviation of the pixels' independent noise."""
    blur: float = 0.008
    """Standard deviation of the blur at depth edges, as a fraction of the long edge."""
    wrong_share: float = 0.0
    """Fraction of the image, in random regions, whose depth is wrong."""
    wrong_factor: float = 2.5
    """Largest factor there, up or down; the least is two."""
    turn: float = 0.12
    """Standard deviation of the normals' direction, radians, smooth over the image."""


PLAUSIBLE = PriorErrors()
"""About as good as public networks are indoors: 7 % off after the best scale, normals 8 degrees."""
PATCHY = PriorErrors(wrong_share=0.12)
"""Equally plausible, but wrong by a factor of two and more in an eighth of the image."""
BAD = PriorErrors(warp=0.2, noise=0.05, wrong_share=0.35)
"""Wrong by a factor of two and more in a third of the image, a different one in every image."""


class DegradedPrior:
    """A prior that returns the true maps of some images with errors."""

    def __init__(
        self,
        views: Iterable[RenderedView],
        errors: PriorErrors = PLAUSIBLE,
        kind: DepthKind = DepthKind.SCALE_FREE,
        seed: int = 0,
    ) -> None:
        self._views = {v.image.tobytes(): (n, v) for n, v in enumerate(views)}
        self._errors, self._kind, self._seed = errors, kind, seed

    def predict(self, image: UInt8[np.ndarray, "h w 3"]) -> PriorMaps:
        """Depth and normals, with errors, of one of the known images."""
        number, view = self._views[image.tobytes()]
        rng = np.random.default_rng([self._seed, number, 0x9E1])
        depth = torch.from_numpy(self._depth(view.depth, rng))
        return PriorMaps(self._kind, depth, torch.from_numpy(self._normal(view.normal, rng)))

    def _depth(
        self, true: Float32[np.ndarray, "h w"], rng: np.random.Generator
    ) -> Float32[np.ndarray, "h w"]:
        e, shape = self._errors, true.shape
        sigma = e.blur * max(shape)
        depth = np.where(true > 0, true, np.float32(np.median(true)))
        depth = cv2.GaussianBlur(depth, (0, 0), sigma) if sigma > 0 else depth
        logarithm = np.log(depth) + e.scale * rng.standard_normal()
        logarithm += e.warp * fractal_noise(rng, shape, (e.warp_cells, e.warp_cells), 2)
        logarithm += e.noise * cv2.GaussianBlur(rng.standard_normal(shape, np.float32), (0, 0), 1.0)
        logarithm += self._wrong(shape, rng)
        spoiled = np.exp(logarithm)
        if self._kind is DepthKind.AFFINE_INVERSE:
            spoiled = 1 / spoiled
        if self._kind.has_shift:
            spoiled = spoiled + e.shift * rng.standard_normal() * np.median(spoiled)
        return spoiled.astype(np.float32)

    def _wrong(
        self, shape: tuple[int, int], rng: np.random.Generator
    ) -> Float32[np.ndarray, "h w"]:
        """Logarithm of the factor in the wrong regions, 0 elsewhere."""
        if self._errors.wrong_share <= 0:
            return np.zeros(shape, np.float32)
        place = fractal_noise(rng, shape, (3, 4), 2)
        level = np.quantile(place, 1 - self._errors.wrong_share)
        size = rng.uniform(math.log(2.0), math.log(self._errors.wrong_factor), shape[:1])[0]
        up = np.where(fractal_noise(rng, shape, (1, 2), 1) > 0, 1.0, -1.0)
        return (size * up * (place > level)).astype(np.float32)

    def _normal(
        self, true: Float32[np.ndarray, "h w 3"], rng: np.random.Generator
    ) -> Float32[np.ndarray, "h w 3"]:
        shape = true.shape[:2]
        turns = [fractal_noise(rng, shape, (2, 2), 2) for _ in range(3)]
        normal = true + self._errors.turn * np.cross(np.stack(turns, -1), true)
        length = np.linalg.norm(normal, axis=-1, keepdims=True)
        return (normal / np.maximum(length, 1e-6)).astype(np.float32)


def with_bare_walls(scene: Scene) -> Scene:
    """The same room with each wall in one colour, without texture."""
    s = scene.solids
    rectangle = (s.kind == BOX) & (s.half[:, 2] == 0)
    upright = np.abs(s.rotation[:, 2, 2]) < 0.5
    textures = list(scene.textures)
    for k in np.unique(scene.face_texture[rectangle & upright]):
        image = textures[k].image
        plain = np.broadcast_to(image.mean((0, 1)).astype(np.uint8), image.shape).copy()
        textures[k] = replace(textures[k], image=plain)
    return replace(scene, textures=tuple(textures))
