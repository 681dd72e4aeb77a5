"""A training step recorded as a CUDA graph: its two thousand launches cost the CPU one."""

from collections.abc import Callable
from dataclasses import fields, replace

import torch
from jaxtyping import Float
from torch import Tensor

from geogs_train.flow_pairs import FlowBatch

WARM_UP = 3
"""Steps taken before the recording, so that libraries have chosen their kernels."""


class StepGraph:
    """Loss and gradients of batches of one size; the gradients are added where they lie."""

    def __init__(self, work: Callable[[FlowBatch], Float[Tensor, ""]], batch: FlowBatch) -> None:
        self._batch = replace(
            batch, **{f.name: getattr(batch, f.name).clone() for f in _tensors(batch)}
        )
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(WARM_UP):
                work(self._batch)
        torch.cuda.current_stream().wait_stream(stream)
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph):
            self._loss = work(self._batch)

    def __call__(self, batch: FlowBatch) -> Float[Tensor, ""]:
        """Run on another batch of the same size; the loss is overwritten by the next call."""
        for f in _tensors(batch):
            getattr(self._batch, f.name).copy_(getattr(batch, f.name))
        self._graph.replay()
        return self._loss


def _tensors(batch: FlowBatch) -> list:
    return [f for f in fields(batch) if isinstance(getattr(batch, f.name), Tensor)]
