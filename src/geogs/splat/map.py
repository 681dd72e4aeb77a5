"""The map: geometry-only Gaussian disks and what is remembered about each of them."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from geogs.geometry.lie import matrix_to_quaternion, quaternion_multiply, sim3_scale
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


class GaussianMap:
    """Disks with trainable parameters (leaf tensors that require gradients) and bookkeeping.

    ``keyframe_id`` names the keyframe that created a disk, ``steps`` counts its optimiser steps and
    ``seen`` the times it was marked as seen; all int64. While a :class:`MapOptimizer` trains the
    map, change the number or the frame of the disks through the optimiser, so that its moments
    follow.
    """

    def __init__(
        self,
        parameters: DiskParameters,
        keyframe_id: Int[Tensor, "n"],
        steps: Int[Tensor, "n"] | None = None,
        seen: Int[Tensor, "n"] | None = None,
    ) -> None:
        self.keyframe_id = keyframe_id
        self.steps = torch.zeros_like(keyframe_id) if steps is None else steps
        self.seen = torch.zeros_like(keyframe_id) if seen is None else seen
        self._set_parameters(parameters)

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

    def append(self, parameters: DiskParameters, keyframe_id: int | Int[Tensor, "m"]) -> None:
        """Add disks behind the present ones; gradients of the old tensors are dropped."""
        n = len(parameters.position)
        ids = torch.as_tensor(keyframe_id, dtype=torch.int64, device=self.device).expand(n)
        new = torch.zeros_like(ids)
        self.keyframe_id = torch.cat([self.keyframe_id, ids])
        self.steps = torch.cat([self.steps, new])
        self.seen = torch.cat([self.seen, new])
        self._set_parameters(
            DiskParameters(
                *(
                    torch.cat([old.detach(), p.detach().to(old)])
                    for old, p in zip(self.parameters, parameters, strict=True)
                )
            )
        )

    def keep(self, mask: Bool[Tensor, "n"]) -> None:
        """Drop the disks where ``mask`` is false; gradients are dropped."""
        self.keyframe_id = self.keyframe_id[mask]
        self.steps = self.steps[mask]
        self.seen = self.seen[mask]
        self._set_parameters(DiskParameters(*(p.detach()[mask] for p in self.parameters)))

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

    def _set_parameters(self, parameters: DiskParameters) -> None:
        fresh = (p.detach().clone().requires_grad_() for p in parameters)
        self.position, self.quaternion, self.log_scale, self.opacity_logit = fresh
