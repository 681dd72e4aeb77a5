"""Boxes, cone frustums and ellipsoids: the solids of every synthetic scene.

World frame: z up, metres, a scene fills [0, size]. A solid has a local frame (rotation local to
world, centre) and three numbers ``half`` whose meaning depends on its kind:

- BOX: half extents; a zero half extent along z makes a rectangle,
- FRUSTUM: radius at -z, radius at +z, half height (equal radii make a cylinder),
- ELLIPSOID: the three radii.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Generic, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

NONE, BOX, FRUSTUM, ELLIPSOID = -1, 0, 1, 2

Array = TypeVar("Array", np.ndarray, Tensor)


@dataclass(frozen=True)
class Solids(Generic[Array]):
    """Solids in NumPy or PyTorch: n of a scene, or n slots for them in each of b scenes."""

    kind: Array
    """(n) or (b n): BOX, FRUSTUM, ELLIPSOID, or NONE where a slot is empty."""
    rotation: Array
    """(n 3 3) or (b n 3 3): local to world."""
    centre: Array
    """(n 3) or (b n 3): world, metres."""
    half: Array
    """(n 3) or (b n 3): metres, by kind."""

    @property
    def bounding_half(self) -> Array:
        """(n 3) or (b n 3): half extents of each solid's bounding box in its local frame."""
        xp: Any = np if isinstance(self.half, np.ndarray) else torch
        radius = xp.maximum(self.half[..., 0], self.half[..., 1])
        frustum = xp.stack([radius, radius, self.half[..., 2]], -1)
        return xp.where((self.kind == FRUSTUM)[..., None], frustum, self.half)  # type: ignore[no-any-return]

    def at(self, places: Any) -> "Solids[Array]":
        """Some of the solids of every scene, by an index, a mask or a slice."""
        own = (slice(None),) * (self.kind.ndim - 1) + (places,)
        return Solids(*(getattr(self, f.name)[own] for f in fields(Solids)))

    def without(self: "Solids[Tensor]", gone: Bool[Tensor, "b n"]) -> "Solids[Tensor]":
        """The same slots, some emptied."""
        return replace(self, kind=torch.where(gone, NONE, self.kind))

    def moved_by(
        self: "Solids[Tensor]", velocity: Float[Tensor, "b n 3"], views: int | Int[Tensor, "*m"]
    ) -> "Solids[Tensor]":
        """The solids ``views`` views later, moved by ``velocity`` from view to view."""
        return replace(self, centre=self.centre + views * velocity)

    def flatten(self: "Solids[Tensor]") -> "Solids[Tensor]":
        """The p solids of each of k groups (b k p) one after the other."""
        return Solids(*(getattr(self, f.name).flatten(1, 2) for f in fields(Solids)))

    @staticmethod
    def join(parts: Sequence["Solids[Array]"]) -> "Solids[Array]":
        """All solids of several sets, one after the other."""
        axis = parts[0].kind.ndim - 1
        xp: Any = np.concatenate if isinstance(parts[0].kind, np.ndarray) else torch.cat
        return Solids(*(xp([getattr(p, f.name) for p in parts], axis) for f in fields(Solids)))


SolidBatch = Solids[Tensor]
"""Solids of a batch of scenes."""


def upright(
    kind: Int[Tensor, "*n"], centre: Float[Tensor, "*n 3"], half: Float[Tensor, "*n 3"]
) -> SolidBatch:
    """Solids without rotation."""
    return Solids(kind, torch.eye(3).expand(*kind.shape, 3, 3), centre, half)
