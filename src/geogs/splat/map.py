"""The map: geometry-only Gaussian disks and what is remembered about each of them."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.geometry.lie import matrix_to_quaternion, quaternion_multiply, sim3_scale
from geogs.splat.rows import GrowingRows
from geogs.types import MapSnapshot


class DiskParameters(NamedTuple):
    """The ten trained numbers of every disk, before activation."""

    position: Float[Tensor, "n 3"]
    """Centre, world frame, map units."""
    quaternion: Float[Tensor, "n 4"]
    """w, x, y, z of any non-zero norm; its rotation maps the disk's axes (tangent, tangent,
    normal) into the world."""
    log_scale: Float[Tensor, "n 2"]
    """Logarithm of the standard deviation along each tangent, map units."""
    opacity_logit: Float[Tensor, "n"]
    """The opacity is its sigmoid."""

    @staticmethod
    def of(disks: MapSnapshot) -> "DiskParameters":
        """The disks of a snapshot before activation."""
        opacity_logit = disks.opacity.clamp(1e-6, 1 - 1e-6).logit()
        return DiskParameters(disks.position, disks.quaternion, disks.scale.log(), opacity_logit)


class GaussianMap:
    """Disks with trainable parameters (leaf tensors that require gradients) and bookkeeping.

    ``keyframe_id`` names the keyframe that created a disk, ``steps`` counts its optimiser steps and
    ``seen`` the times it was marked as seen; all int64. While a :class:`MapOptimizer` trains the
    map, change the number or the frame of the disks through the optimiser, so that its moments
    follow.

    All tensors are the first rows of larger ones (``room``), which stay where they are until more
    disks come than there is room for.
    """

    def __init__(
        self,
        parameters: DiskParameters,
        keyframe_id: Int[Tensor, "n"],
        steps: Int[Tensor, "n"] | None = None,
        seen: Int[Tensor, "n"] | None = None,
    ) -> None:
        steps = torch.zeros_like(keyframe_id) if steps is None else steps
        seen = torch.zeros_like(keyframe_id) if seen is None else seen
        self._trained = [GrowingRows(p) for p in parameters]
        self._counts = [GrowingRows(c) for c in (keyframe_id, steps, seen)]
        self._expose()

    @classmethod
    def empty(cls, device: torch.device | str = "cpu") -> "GaussianMap":
        """A map without disks, float32."""

        def shape(*size: int) -> Tensor:
            return torch.zeros(size, device=device)

        none = torch.zeros(0, dtype=torch.int64, device=device)
        return cls(DiskParameters(shape(0, 3), shape(0, 4), shape(0, 2), shape(0)), none)

    def __len__(self) -> int:
        return len(self.position)

    @property
    def device(self) -> torch.device:
        """Where the disks live."""
        return self.position.device

    @property
    def parameters(self) -> DiskParameters:
        """The trained tensors themselves, not copies."""
        return DiskParameters(self.position, self.quaternion, self.log_scale, self.opacity_logit)

    @property
    def scale(self) -> Float[Tensor, "n 2"]:
        """Standard deviations along the tangents, detached."""
        return self.log_scale.detach().exp()

    @property
    def opacity(self) -> Float[Tensor, "n"]:
        """In (0, 1), detached."""
        return self.opacity_logit.detach().sigmoid()

    @property
    def capacity(self) -> int:
        """Disks there is room for; it changes whenever the tensors have moved."""
        return len(self._trained[0].room)

    @property
    def room(self) -> DiskParameters:
        """The trained tensors with all their room; rows beyond the disks mean nothing."""
        return DiskParameters(*(rows.room for rows in self._trained))

    @property
    def counters_room(self) -> tuple[Int[Tensor, "c"], Int[Tensor, "c"]]:
        """``steps`` and ``seen`` with all their room."""
        return self._counts[1].room, self._counts[2].room

    def append(self, parameters: DiskParameters, keyframe_id: int | Int[Tensor, "m"]) -> None:
        """Add disks behind the present ones; gradients of the old tensors are dropped."""
        n = len(parameters.position)
        ids = torch.as_tensor(keyframe_id, dtype=torch.int64, device=self.device).expand(n)
        new = torch.zeros_like(ids)
        for rows, p in zip(self._trained, parameters, strict=True):
            rows.append(p.to(rows.room))
        for rows, c in zip(self._counts, (ids, new, new), strict=True):
            rows.append(c)
        self._expose()

    def keep(self, mask: Bool[Tensor, "n"]) -> None:
        """Drop the disks where ``mask`` is false; gradients are dropped."""
        self.take(mask.nonzero()[:, 0])

    def take(self, index: Int[Tensor, "m"], start: int = 0) -> None:
        """Keep the disks of the index, the first ``start`` in place; gradients are dropped."""
        for rows in (*self._trained, *self._counts):
            rows.take(index, start)
        self._expose()

    def mark_seen(self, visible: Bool[Tensor, "n"]) -> None:
        """Count the disks that a rendering showed."""
        self.seen += visible

    @torch.no_grad()
    def transform(self, S: Float[Tensor, "*n 4 4"]) -> None:
        """Move the disks by a similarity, in place: one (4, 4) for all or one per disk (n, 4, 4).

        Positions move, quaternions rotate, log-scales grow by the logarithm of the scale. Computed
        in the precision of ``S``.
        """
        S = S.to(self.device)
        scale = sim3_scale(S)
        linear = S[..., :3, :3]
        rotation = matrix_to_quaternion(linear / scale[..., None, None])
        moved = (linear @ self.position.to(S.dtype)[..., None])[..., 0] + S[..., :3, 3]
        turned = quaternion_multiply(
            rotation.expand(len(self), 4).contiguous(), self.quaternion.to(S.dtype)
        )
        self.position.copy_(moved)
        self.quaternion.copy_(turned)
        self.log_scale += scale.log()[..., None].to(self.log_scale.dtype)

    def snapshot(self) -> MapSnapshot:
        """The disks as plain numbers: copies, detached, quaternions normalised."""
        quaternion = self.quaternion.detach()
        return MapSnapshot(
            position=self.position.detach().clone(),
            quaternion=quaternion / quaternion.norm(dim=-1, keepdim=True),
            scale=self.scale,
            opacity=self.opacity,
        )

    def _expose(self) -> None:
        """Fresh leaf tensors over the present rows, without gradients."""
        fresh = (rows.rows.detach().requires_grad_() for rows in self._trained)
        self.position, self.quaternion, self.log_scale, self.opacity_logit = fresh
        self.keyframe_id, self.steps, self.seen = (rows.rows for rows in self._counts)
