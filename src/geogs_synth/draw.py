"""Random tensors of given shapes, and rotations."""

import hashlib
import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.geometry.lie import quaternion_to_matrix, so3_hat


class Draw:
    """Random tensors of a generator, on its device."""

    def __init__(self, generator: torch.Generator) -> None:
        self.device = generator.device
        self._generator = generator

    @staticmethod
    def keyed(device: torch.device, *key: int) -> "Draw":
        """A stream of random tensors that depends on the given numbers only."""
        digest = hashlib.blake2b(repr(key).encode(), digest_size=8).digest()
        return Draw(torch.Generator(device).manual_seed(int.from_bytes(digest) >> 1))

    def uniform(self, low: float | int, high: float | int, *shape: int) -> Float[Tensor, "..."]:
        """Uniform in [low, high)."""
        empty = torch.empty(shape, device=self.device)
        return empty.uniform_(low, high, generator=self._generator)

    def log_uniform(self, low: float, high: float, *shape: int) -> Float[Tensor, "..."]:
        """Log-uniform in [low, high)."""
        return self.uniform(math.log(low), math.log(high), *shape).exp_()

    def normal(self, deviation: float | int, *shape: int) -> Float[Tensor, "..."]:
        """Gaussian around zero."""
        empty = torch.empty(shape, device=self.device)
        return empty.normal_(0.0, deviation, generator=self._generator)

    def chance(self, probability: float, *shape: int) -> Bool[Tensor, "..."]:
        """True with the given probability."""
        return self.uniform(0.0, 1.0, *shape) < probability

    def integers(self, end: int, *shape: int) -> Int[Tensor, "..."]:
        """Uniform in 0..end-1."""
        return torch.randint(end, shape, generator=self._generator, device=self.device)

    def choose(self, weights: Sequence[float | int], *shape: int) -> Int[Tensor, "..."]:
        """Index of a weight, drawn in proportion to them."""
        value = self.uniform(0.0, sum(weights), *shape)
        bound = 0.0
        chosen = torch.zeros(shape, dtype=torch.int64, device=self.device)
        for index in range(1, len(weights)):
            bound += weights[index - 1]
            chosen = torch.where(value >= bound, index, chosen)
        return chosen

    def rotation(self, *shape: int) -> Float[Tensor, "... 3 3"]:
        """Uniformly distributed rotations."""
        return quaternion_to_matrix(self.normal(1.0, *shape, 4))


def about_z(angle: Float[Tensor, "..."]) -> Float[Tensor, "... 3 3"]:
    """Rotations about z by angles in radians."""
    c = angle.cos()
    s = angle.sin()
    o = torch.zeros_like(angle)
    i = torch.ones_like(angle)
    return torch.stack([c, -s, o, s, c, o, o, o, i], -1).unflatten(-1, (3, 3))


def rotated(
    vector: Float[Tensor, "*#n 3"], rotation: Float[Tensor, "*#n 3"]
) -> Float[Tensor, "*n 3"]:
    """Vectors rotated by rotation vectors, without a matrix for each of them."""
    angle = rotation.norm(dim=-1, keepdim=True)
    axis, vector = torch.broadcast_tensors(rotation / angle.clamp_min(1e-9), vector)
    once = torch.linalg.cross(axis, vector)
    return vector + angle.sin() * once + (1 - angle.cos()) * torch.linalg.cross(axis, once)


def rotation_matrix(vector: Float[Tensor, "... 3"]) -> Float[Tensor, "... 3 3"]:
    """Rotations by rotation vectors (axis times angle in radians)."""
    angle = vector.norm(dim=-1, keepdim=True)[..., None]
    K = so3_hat(vector / angle[..., 0].clamp_min(1e-9))
    eye = torch.eye(3, dtype=vector.dtype, device=vector.device)
    return eye + angle.sin() * K + (1 - angle.cos()) * (K @ K)
