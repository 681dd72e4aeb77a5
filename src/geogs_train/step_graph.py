"""A training step recorded as a CUDA graph: its two thousand launches cost the CPU one."""

from collections.abc import Callable
from dataclasses import Field, fields, replace
from typing import Any, Generic, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

Batch = TypeVar("Batch")

WARM_UP = 3
"""Steps taken before the recording, so that libraries have chosen their kernels."""


class StepGraph(Generic[Batch]):
    """Loss and gradients of batches of one size; the gradients are added where they lie."""

    def __init__(self, work: Callable[[Batch], Float[Tensor, ""]], batch: Batch) -> None:
        own = {f.name: getattr(batch, f.name).clone() for f in _tensors(batch)}
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
        for f in _tensors(batch):
            getattr(self._batch, f.name).copy_(getattr(batch, f.name))
        self._graph.replay()
        return self._loss


def _tensors(batch: Any) -> list[Field[Any]]:
    return [f for f in fields(batch) if isinstance(getattr(batch, f.name), Tensor)]
