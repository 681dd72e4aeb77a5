"""The map: geometry-only Gaussian disks and their training state."""

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import torch
from jaxtyping import Bool, Float, Float32, Int, Int64, Shaped
from torch import Tensor

from geogs.config.setting import Range
from geogs.geometry.lie import matrix_to_quaternion, quaternion_multiply, sim3_scale
from geogs.limits import FARTHEST, Reference
from geogs.types import MapSnapshot


class GrowingRows:
    """Rows in a larger tensor, so that appending rarely allocates and addresses stay valid.

    ``room`` is all of it, ``rows`` the part in use; both share memory.
    """

    def __init__(self, rows: Shaped[Tensor, "n *k"]) -> None:
        self.room = rows.detach().clone()
        self._count = len(rows)

    def __len__(self) -> int:
        return self._count

    @property
    def rows(self) -> Shaped[Tensor, "n *k"]:
        """The rows in use."""
        return self.room[: self._count]

    def append(self, rows: Shaped[Tensor, "m *k"]) -> None:
        """Append rows; the room doubles where it is too small."""
        count = self._count + len(rows)
        if count > len(self.room):
            self.reserve(max(count, 2 * len(self.room), 4096))
        self.room[self._count : count] = rows.detach()
        self._count = count

    def reserve(self, size: int) -> None:
        """Make room for ``size`` rows in total; new room is zero."""
        if size > len(self.room):
            room = self.room.new_zeros(size, *self.room.shape[1:])
            room[: self._count] = self.rows
            self.room = room

    def take(self, index: Int[Tensor, "m"], start: int = 0) -> None:
        """Keep the rows in ``index``, in its order; the first ``start`` of them are in place."""
        self.room[start : len(index)] = self.room[index[start:]]
        self._count = len(index)


class DiskParameters(NamedTuple):
    """The ten trained numbers of every disk, before activation."""

    position: Annotated[Float32[Tensor, "n 3"], Range(-FARTHEST, FARTHEST)]
    """Centre, world frame, map units."""
    quaternion: Float32[Tensor, "n 4"]
    """w, x, y, z of any non-zero norm; its rotation maps the disk's axes (tangent, tangent,
    normal) into the world."""
    log_scale: Float32[Tensor, "n 2"]
    """Logarithm of the standard deviation along each tangent, map units."""
    opacity_logit: Float32[Tensor, "n"]
    """The opacity is its sigmoid."""

    @staticmethod
    def of(disks: MapSnapshot) -> "DiskParameters":
        """The disks of a snapshot before activation."""
        opacity_logit = disks.opacity.clamp(1e-6, 1 - 1e-6).logit()
        return DiskParameters(disks.position, disks.quaternion, disks.scale.log(), opacity_logit)


@dataclass(eq=False, repr=False)
class GaussianMap:
    """Disks, their counters, and the moments of the optimiser that trains them.

    The parameters are leaf tensors that require gradients. All tensors are the first rows of larger
    ones (``room``), which are only reallocated when they are full. So the tensors are replaced
    whenever disks are added or removed.
    """

    parameters: DiskParameters
    """The trained tensors themselves, not copies."""
    first: DiskParameters
    """Running means of the gradients."""
    second: DiskParameters
    """Running means of their squares."""
    keyframe_id: Annotated[Int64[Tensor, "n"], Reference("keyframes")]
    """Keyframe that created a disk."""
    steps: Annotated[Int64[Tensor, "n"], Range(0)]
    """Steps of the optimiser so far."""
    seen: Annotated[Int64[Tensor, "n"], Range(0)]
    """Renderings in training that showed a disk."""

    def __post_init__(self) -> None:
        groups = (self.parameters, self.first, self.second)
        if any(len(part) != len(self.steps) for group in groups for part in group):
            raise ValueError("the disks are incomplete")
        self._trained = [GrowingRows(p) for p in self.parameters]
        self._moments = [GrowingRows(m) for m in (*self.first, *self.second)]
        self._counts = [GrowingRows(c) for c in (self.keyframe_id, self.steps, self.seen)]
        self._expose()

    def __repr__(self) -> str:
        return f"GaussianMap({len(self)} disks, {self.device})"

    @classmethod
    def of(cls, parameters: DiskParameters, keyframe_id: Int[Tensor, "n"]) -> "GaussianMap":
        """Disks that have not been trained."""
        zeros = DiskParameters(*(torch.zeros_like(p) for p in parameters))
        none = torch.zeros_like(keyframe_id)
        return cls(parameters, zeros, zeros, keyframe_id, none, none)

    @classmethod
    def empty(cls, device: torch.device | str = "cpu") -> "GaussianMap":
        """A map without disks, float32."""
        sizes = (0, 3), (0, 4), (0, 2), (0,)
        none = torch.zeros(0, dtype=torch.int64, device=device)
        return cls.of(DiskParameters(*(torch.zeros(s, device=device) for s in sizes)), none)

    @property
    def position(self) -> Float[Tensor, "n 3"]:
        """Centres, world frame, map units."""
        return self.parameters.position

    def __len__(self) -> int:
        return len(self.position)

    @property
    def device(self) -> torch.device:
        """Device of the disks."""
        return self.position.device

    @property
    def scale(self) -> Float[Tensor, "n 2"]:
        """Standard deviations along the tangents, detached."""
        return self.parameters.log_scale.detach().exp()

    @property
    def opacity(self) -> Float[Tensor, "n"]:
        """Opacities in (0, 1), detached."""
        return self.parameters.opacity_logit.detach().sigmoid()

    @property
    def capacity(self) -> int:
        """Number of disks there is room for; it changes whenever the tensors are reallocated."""
        return len(self._trained[0].room)

    @property
    def room(self) -> DiskParameters:
        """The trained tensors with all their room; rows beyond the disks are unused."""
        return DiskParameters(*(rows.room for rows in self._trained))

    def training_room(self) -> list[Tensor]:
        """First, then second moments of the four groups, ``steps`` and ``seen``, with as much room
        as the parameters."""
        for m, p in zip(self._moments, self._trained * 2, strict=True):
            m.reserve(len(p.room))
        return [rows.room for rows in (*self._moments, *self._counts[1:])]

    def append(self, parameters: DiskParameters, keyframe_id: int | Int[Tensor, "m"]) -> None:
        """Add disks behind the present ones, with empty moments; old gradients are dropped."""
        n = len(parameters.position)
        ids = torch.as_tensor(keyframe_id, dtype=torch.int64, device=self.device).expand(n)
        new = torch.zeros_like(ids)
        for rows, p in zip(self._trained, parameters, strict=True):
            rows.append(p.to(rows.room))
        for rows in self._moments:
            rows.append(rows.room.new_zeros(n, *rows.room.shape[1:]))
        for rows, c in zip(self._counts, (ids, new, new), strict=True):
            rows.append(c)
        self._expose()

    def keep(self, mask: Bool[Tensor, "n"]) -> None:
        """Remove the disks where ``mask`` is false; if any is removed, gradients are dropped."""
        index = mask.nonzero()[:, 0]
        if len(index) == len(self):
            return
        # Old disks come first and are rarely removed: most rows of a large map stay untouched.
        start = int(mask.to(torch.uint8).argmin())
        for rows in (*self._trained, *self._moments, *self._counts):
            rows.take(index, start)
        self._expose()

    @torch.no_grad()
    def excerpt(self, index: Int[Tensor, "m"]) -> "GaussianMap":
        """Copy some of the disks into a map of their own; :meth:`take_back` writes them back."""

        def some(group: DiskParameters) -> DiskParameters:
            return DiskParameters(*(part.detach()[index] for part in group))

        return GaussianMap(
            some(self.parameters),
            some(self.first),
            some(self.second),
            self.keyframe_id[index],
            self.steps[index],
            self.seen[index],
        )

    @torch.no_grad()
    def take_back(self, index: Int[Tensor, "m"], part: "GaussianMap") -> None:
        """Write back the disks of an excerpt, to which none were added or removed."""
        own = (*self.parameters, *self.first, *self.second, self.steps, self.seen)
        theirs = (*part.parameters, *part.first, *part.second, part.steps, part.seen)
        for mine, other in zip(own, theirs, strict=True):
            mine.detach()[index] = other.detach()

    @torch.no_grad()
    def transform(self, S: Float[Tensor, "*n 4 4"]) -> None:
        """Move the disks by a similarity, in place: one (4, 4) for all or one per disk (n, 4, 4).

        Positions move, quaternions rotate, log-scales grow by the logarithm of the scale. Computed
        in the precision of ``S``. With x' = s R x + t the gradient becomes R g / s; a rotation of
        the world by r multiplies quaternions and their gradients by the orthogonal matrix of
        q -> r q. Second moments are treated as a diagonal covariance, of which the diagonal after
        the rotation is kept.
        """
        S = S.to(self.device)
        scale = sim3_scale(S)
        linear = S[..., :3, :3]
        R = linear / scale[..., None, None]
        rotation = matrix_to_quaternion(R)
        by = {0: R / scale[..., None, None], 1: _left_product(rotation)}
        for group, product in by.items():
            first, second = self.first[group], self.second[group]
            matrix = product.to(first)
            first.copy_((matrix @ first[..., None])[..., 0])
            second.copy_((matrix.square() @ second[..., None])[..., 0])
        moved = (linear @ self.position.to(S.dtype)[..., None])[..., 0] + S[..., :3, 3]
        position, quaternion, log_scale, _ = self.parameters
        turned = quaternion_multiply(
            rotation.expand(len(self), 4).contiguous(), quaternion.to(S.dtype)
        )
        position.copy_(moved)
        quaternion.copy_(turned)
        log_scale.add_(scale.log()[..., None].to(log_scale.dtype))

    def snapshot(self) -> MapSnapshot:
        """The disks as plain numbers: copies, detached, quaternions normalised."""
        quaternion = self.parameters.quaternion.detach()
        return MapSnapshot(
            position=self.position.detach().clone(),
            quaternion=quaternion / quaternion.norm(dim=-1, keepdim=True),
            scale=self.scale,
            opacity=self.opacity,
        )

    def _expose(self) -> None:
        """Make new leaf tensors over the present rows, without gradients."""
        fresh = (rows.rows.detach().requires_grad_() for rows in self._trained)
        self.parameters = DiskParameters(*fresh)
        self.first = DiskParameters(*(rows.rows for rows in self._moments[:4]))
        self.second = DiskParameters(*(rows.rows for rows in self._moments[4:]))
        self.keyframe_id, self.steps, self.seen = (rows.rows for rows in self._counts)


def _left_product(q: Float[Tensor, "*n 4"]) -> Float[Tensor, "*n 4 4"]:
    """The matrix L(q) with L(q) p = q p (Hamilton product, w x y z)."""
    w, x, y, z = q.unbind(-1)
    rows = [w, -x, -y, -z, x, w, -z, y, y, z, w, -x, z, -y, x, w]
    return torch.stack(rows, -1).unflatten(-1, (4, 4))
