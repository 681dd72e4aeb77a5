"""One training run of a network: steps, running mean of the weights, exact resume."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Generic, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor, distributed, nn

from geogs_train.course import Worker
from geogs_train.depth.depth_course import DepthCourse
from geogs_train.flow.flow_course import FlowCourse
from geogs_train.training_options import TrainingSchedule

Course = FlowCourse | DepthCourse
Batch = TypeVar("Batch")

WARM_UP = 3
"""Steps before the recording, in which libraries choose their kernels."""


class StepGraph(Generic[Batch]):
    """CUDA graph of the loss of batches of one size; gradients are added in place."""

    def __init__(self, work: Callable[[Batch], Float[Tensor, ""]], batch: Batch) -> None:
        own = {name: getattr(batch, name).clone() for name in _tensors(batch)}
        self._batch: Batch = replace(batch, **own)  # type: ignore[type-var]
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(WARM_UP):
                work(self._batch)
        torch.cuda.current_stream().wait_stream(stream)
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph):
            self._loss = work(self._batch)

    def __call__(self, batch: Batch) -> Float[Tensor, ""]:
        """Run on another batch of the same size; the loss is overwritten by the next call."""
        for name in _tensors(batch):
            getattr(self._batch, name).copy_(getattr(batch, name))
        self._graph.replay()
        return self._loss


class NetworkTrainer:
    """A network, its optimiser and its training course.

    Step n of a run depends only on the seed, n, and the state after step n - 1, so that a resumed
    run equals one that was never stopped (on the CPU to the last bit).
    """

    def __init__(
        self, course: Course, worker: Worker, fuse: bool = False, paced: bool = False
    ) -> None:
        """With ``paced`` the caller sets ``progress``; else it is the fraction of the steps."""
        self.course = course
        self.worker = worker
        self.options = options = course.options
        torch.manual_seed(options.seed)
        self.network = _on_device(course.network(), worker.device)
        self.mean = _on_device(course.network(), worker.device).requires_grad_(False)
        self.mean.load_state_dict(self.network.state_dict())
        self._parameters = list(self.network.parameters())
        self._gradient = _flat_gradient(self._parameters)
        self.optimizer = torch.optim.AdamW(
            self._parameters,
            lr=options.learning_rate,
            weight_decay=options.weight_decay,
            fused=worker.device.type == "cuda",
        )
        self.step = 0
        self.progress = 0.0
        self._paced = paced
        """``progress`` is the finished fraction of the run, on which batch and loss depend."""
        self._graph: StepGraph[Any] | None = None
        if fuse:
            course.compile(self.network)

    def advance(self) -> Float[Tensor, ""]:
        """Take a step; return its loss, which stays on the device."""
        options = self.options
        loss = self._gradients(self.course.batch(self.step, self.progress))
        if self.worker.count > 1:
            distributed.all_reduce(self._gradient)
            self._gradient /= self.worker.count
        nn.utils.clip_grad_norm_(self._parameters, options.clip)
        # A step from a loss that is not finite would ruin all weights.
        self._gradient.nan_to_num_(0.0, 0.0, 0.0)
        for group in self.optimizer.param_groups:
            group["lr"] = options.learning_rate * schedule(self.step, self.progress, options)
        self.optimizer.step()
        self.step += 1
        if not self._paced:
            self.progress = self.step / options.steps
        decay = min(options.ema, (1 + self.step) / (10 + self.step))
        with torch.no_grad():
            means: list[Tensor] = [*self.mean.parameters()]
            torch._foreach_lerp_(means, [*self._parameters], 1 - decay)
        return loss

    def begin_with(self, network: nn.Module) -> None:
        """Copy the weights of a network of the same sizes."""
        for mine in (self.network, self.mean):
            mine.load_state_dict(network.state_dict())

    def is_finite(self) -> bool:
        """Whether all weights are finite."""
        return bool(torch.stack([p.detach().isfinite().all() for p in self._parameters]).all())

    def _gradients(self, batch: Any) -> Float[Tensor, ""]:
        if self.worker.device.type != "cuda" or not self.course.recordable:
            return self._compute(batch)
        if self._graph is None:
            self._graph = StepGraph(self._compute, batch)
        return self._graph(batch).clone()

    def _compute(self, batch: Any) -> Float[Tensor, ""]:
        self._gradient.zero_()
        loss = self.course.loss(self.network, batch)
        loss.backward()
        return loss.detach()


def schedule(step: int, progress: float, options: TrainingSchedule) -> float:
    """Learning rate of a step over its peak: half a cosine, with a linear warm-up."""
    rate = 0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(progress, 1.0)))
    return rate * min(1.0, (step + 1) / max(options.warmup, 1))


def _on_device(network: nn.Module, device: torch.device) -> Any:
    """Move a network to a device, with channels last, which PyTorch's stubs do not know."""
    return network.to(device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]


def _flat_gradient(parameters: list[nn.Parameter]) -> Float[Tensor, "n"]:
    """One buffer for all gradients, so that they are summed over the devices at once."""
    flat = torch.zeros(sum(p.numel() for p in parameters), device=parameters[0].device)
    at = 0
    for p in parameters:
        p.grad = flat.as_strided(p.shape, p.stride(), at)
        at += p.numel()
    return flat


def _tensors(batch: Any) -> list[str]:
    """Names of the fields that are tensors."""
    return [name for name, value in vars(batch).items() if isinstance(value, Tensor)]
