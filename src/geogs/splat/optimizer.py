"""Adam for a map whose disks come, go and move."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int, Int64
from torch import Tensor

from geogs.errors import InputError
from geogs.geometry.lie import matrix_to_quaternion, sim3_scale
from geogs.splat.map import DiskParameters, GaussianMap
from geogs.splat.rows import GrowingRows


@dataclass(frozen=True, slots=True)
class LearningRates:
    """Adam step sizes per group."""

    position: float
    """Map units."""
    quaternion: float
    log_scale: float
    opacity_logit: float

    def __iter__(self) -> Iterator[float]:
        return iter((self.position, self.quaternion, self.log_scale, self.opacity_logit))


@dataclass(frozen=True, eq=False)
class DiskState:
    """What a checkpoint holds of a map and its optimiser."""

    parameters: DiskParameters
    first: DiskParameters
    """Running means of the gradients."""
    second: DiskParameters
    """Running means of their squares."""
    keyframe_id: Int64[Tensor, "n"]
    steps: Int64[Tensor, "n"]
    seen: Int64[Tensor, "n"]


class MapOptimizer:
    """Adam (Kingma & Ba 2015) on a map's disks, with a step count per disk.

    Only disks given as visible are stepped: the moments and the step counts of the others stand
    still, so a disk out of view neither drifts nor forgets. Bias correction uses each disk's own
    count, ``map.steps``. Add, drop and move disks through ``append``, ``keep`` and ``transform``
    here, which do the same to the map and let the moments follow.
    """

    def __init__(
        self,
        disks: GaussianMap,
        learning_rates: LearningRates,
        betas: tuple[float, float] = (0.9, 0.99),
        eps: float = 1e-8,
    ) -> None:
        self.disks = disks
        self.learning_rates = learning_rates
        self.betas = betas
        self.eps = eps
        self._moments = tuple(
            [GrowingRows(torch.zeros_like(p)) for p in disks.parameters] for _ in betas
        )
        device = disks.device
        first, second = (_bias_corrections(beta).to(device) for beta in betas)
        self._corrections = (first, second)

    @property
    def first(self) -> list[Tensor]:
        """Running means of the gradients, one tensor per group."""
        return [m.rows for m in self._moments[0]]

    @property
    def second(self) -> list[Tensor]:
        """Running means of the squared gradients."""
        return [m.rows for m in self._moments[1]]

    def state(self) -> DiskState:
        """What a checkpoint holds."""
        disks = self.disks
        return DiskState(
            disks.parameters, DiskParameters(*self.first), DiskParameters(*self.second),
            disks.keyframe_id, disks.steps, disks.seen,
        )  # fmt: skip

    @torch.no_grad()
    def load(self, state: DiskState) -> None:
        """Give a map without disks those of another, with all that is remembered of them.

        Raises:
            InputError: there is not one of everything for each disk.
        """
        groups = (state.parameters, state.first, state.second)
        if any(len(g.position) != len(state.steps) for g in groups):
            raise InputError("the disks are incomplete")
        self.append(state.parameters, state.keyframe_id)
        own = (*self.first, *self.second, self.disks.steps, self.disks.seen)
        for rows, saved in zip(
            own, (*state.first, *state.second, state.steps, state.seen), strict=True
        ):
            rows.copy_(saved)

    def moments_room(self) -> list[Tensor]:
        """First, then second moments of the four groups with all their room (as the map's)."""
        for moments in self._moments:
            for m, p in zip(moments, self.disks.room, strict=True):
                m.reserve(len(p))
        return [m.room for moments in self._moments for m in moments]

    def zero_grad(self) -> None:
        """Forget the gradients."""
        for p in self.disks.parameters:
            p.grad = None

    @torch.no_grad()
    def step(self, visible: Bool[Tensor, "n"]) -> None:
        """One Adam step of the visible disks by the gradients accumulated in the map's tensors.

        A parameter group without gradient is left alone. Raises ValueError if disks were added to
        or dropped from the map without telling the optimiser.
        """
        if len(self.first[0]) != len(self.disks) or len(visible) != len(self.disks):
            raise ValueError(
                f"{len(self.disks)} disks, {len(self.first[0])} moments and {len(visible)} "
                "visibility flags: change the map through its optimiser."
            )
        self.disks.steps += visible
        groups = zip(
            self.disks.parameters, self.first, self.second, self.learning_rates, strict=True
        )
        update = adam_reference
        if self._is_fused():
            from geogs.splat.cpu.adam import adam_rows

            update = adam_rows
        for p, m, v, rate in groups:
            if p.grad is not None:
                update(
                    p, p.grad, m, v, visible, self.disks.steps, self._corrections,
                    rate, self.betas, self.eps,
                )  # fmt: skip

    @torch.no_grad()
    def append(self, parameters: DiskParameters, keyframe_id: int | Tensor) -> None:
        """Add disks to the map, with empty moments."""
        n = len(parameters.position)
        for moments in self._moments:
            for m in moments:
                m.append(m.room.new_zeros(n, *m.room.shape[1:]))
        self.disks.append(parameters, keyframe_id)

    def keep(self, mask: Bool[Tensor, "n"]) -> None:
        """Drop disks from the map, and their moments."""
        index = mask.nonzero()[:, 0]
        if len(index) == len(mask) == len(self.disks):
            return
        # Old disks come first and seldom go, so most rows of a large map need not be touched.
        start = int(mask.to(torch.uint8).argmin())
        for moments in self._moments:
            for m in moments:
                m.take(index, start)
        self.disks.take(index, start)

    @torch.no_grad()
    def excerpt(self, index: Int[Tensor, "m"]) -> "MapOptimizer":
        """The optimiser of a map of some of the disks: copies that :meth:`take_back` returns."""
        disks = self.disks
        part = MapOptimizer(
            GaussianMap(
                DiskParameters(*(p.detach()[index] for p in disks.parameters)),
                disks.keyframe_id[index], disks.steps[index], disks.seen[index],
            ),
            self.learning_rates, self.betas, self.eps,
        )  # fmt: skip
        for mine, theirs in zip(self._moments, part._moments, strict=True):
            for m, t in zip(mine, theirs, strict=True):
                t.rows.copy_(m.rows[index])
        return part

    @torch.no_grad()
    def take_back(self, index: Int[Tensor, "m"], part: "MapOptimizer") -> None:
        """What has become of the disks of an excerpt, none of which came or went."""
        own, other = self.disks, part.disks
        pairs = [*zip(own.parameters, other.parameters, strict=True)]
        pairs += [*zip(self.first, part.first, strict=True)]
        pairs += [*zip(self.second, part.second, strict=True)]
        pairs += [(own.steps, other.steps), (own.seen, other.seen)]
        for mine, theirs in pairs:
            mine.detach()[index] = theirs.detach()

    @property
    def position_gradient(self) -> Float[Tensor, "n"]:
        """Root mean square of each position's gradient over the last steps that saw the disk."""
        last = self.disks.steps.clamp(max=len(self._corrections[1]) - 1)
        correction = self._corrections[1][last].clamp(min=1e-6)
        return (self.second[0].sum(1) / correction.to(self.second[0])).sqrt()

    @torch.no_grad()
    def replace(self, gone: Bool[Tensor, "n"], new: DiskParameters, keyframe_id: Tensor) -> None:
        """Drop some disks from the map and add others."""
        self.keep(~gone)
        self.append(new, keyframe_id)

    @torch.no_grad()
    def transform(self, S: Float[Tensor, "*n 4 4"]) -> None:
        """Move the map by a similarity (one, or one per disk) and its moments with it.

        With x' = s R x + t the gradient becomes R g / s; a rotation of the world by r multiplies
        quaternions and their gradients by the orthogonal matrix of q -> r q. Second moments are
        treated as a diagonal covariance, of which the diagonal after the rotation is kept.
        """
        scale = sim3_scale(S)[..., None, None]
        R = S[..., :3, :3] / scale
        by = {0: R / scale, 1: _left_product(matrix_to_quaternion(R))}
        for group, linear in by.items():
            first, second = self.first[group], self.second[group]
            matrix = linear.to(first)
            first.copy_((matrix @ first[..., None])[..., 0])
            second.copy_((matrix.square() @ second[..., None])[..., 0])
        self.disks.transform(S)

    def _is_fused(self) -> bool:
        p = self.disks.position
        return p.device.type == "cpu" and p.dtype == torch.float32


def adam_reference(
    p: Tensor,
    grad: Tensor,
    first: Tensor,
    second: Tensor,
    visible: Tensor,
    steps: Tensor,
    corrections: tuple[Tensor, Tensor],
    rate: float,
    betas: tuple[float, float],
    eps: float,
) -> None:
    """One Adam step of the visible rows in plain PyTorch, in place: the kernel's specification."""
    g = grad[visible]
    m = first[visible].lerp(g, 1 - betas[0])
    v = second[visible].lerp(g * g, 1 - betas[1])
    first[visible], second[visible] = m, v
    row = (-1,) + (1,) * (p.dim() - 1)
    c1, c2 = (c[steps[visible].clamp(max=len(c) - 1)].view(row).to(p.dtype) for c in corrections)
    p[visible] -= rate * (m / c1) / ((v / c2).sqrt() + eps)


def _bias_corrections(beta: float) -> Float[Tensor, "t"]:
    """1 - beta^t for t = 0, 1, ... until it is one in float32."""
    count = max(2, math.ceil(math.log(1e-8) / math.log(beta)) + 1) if beta > 0 else 2
    return 1 - beta ** torch.arange(count, dtype=torch.float64)


def _left_product(q: Float[Tensor, "*n 4"]) -> Float[Tensor, "*n 4 4"]:
    """The matrix L(q) with L(q) p = q p (Hamilton product, w x y z)."""
    w, x, y, z = q.unbind(-1)
    rows = [w, -x, -y, -z, x, w, -z, y, y, z, w, -x, z, -y, x, w]
    return torch.stack(rows, -1).unflatten(-1, (4, 4))
