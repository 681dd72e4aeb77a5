"""What the flow network is trained to do."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.tracking.flow.own_network import FlowEstimate, LaplaceMixture
from geogs.train.options import FlowTraining
from geogs.train.pairs import FlowBatch

MAX_ERROR = 100.0
"""Errors beyond so many pixels count as such; nothing is learned from how far lost a cell is."""


def flow_loss(
    estimates: Sequence[FlowEstimate],
    dense: Float[Tensor, "e h w 2"],
    batch: FlowBatch,
    options: FlowTraining,
) -> Float[Tensor, ""]:
    """Loss of all iterations (later ones count more) and of the upsampled flow of the last.

    With the ``joint`` likelihood a cell's flow and its uncertainty are trained by the negative
    log-likelihood of the error (and by a little of its absolute value, which keeps hopeless cells
    learning); with the ``separate`` one the flow is trained by the absolute error alone.
    """
    truth, weight = batch.at_cells(batch.truth), _weights(batch, options)
    at_cells = batch.at_cells(weight)
    total = truth.new_zeros(())
    for n, estimate in enumerate(estimates):
        error = (truth - estimate.pixels).clamp(-MAX_ERROR, MAX_ERROR)
        absolute = error.abs().mean(-1)
        if options.likelihood == "joint":
            value = _likelihood(estimate.error, error) + options.absolute * absolute
        else:
            value = absolute + 0.2 * _likelihood(estimate.error, error.detach())
        total = total + options.decay ** (len(estimates) - 1 - n) * _mean(value, at_cells)
    grid = torch.stack(_pixel_grid(dense), -1)
    missed = (batch.truth - grid - dense).clamp(-MAX_ERROR, MAX_ERROR).abs().mean(-1)
    return total + options.dense * _mean(missed, weight)


def _weights(batch: FlowBatch, options: FlowTraining) -> Float[Tensor, "e h w"]:
    return torch.where(batch.visible, 1.0, options.occluded) * batch.known


def _likelihood(mixture: LaplaceMixture, error: Tensor) -> Float[Tensor, "e p"]:
    return mixture.negative_log_likelihood(error)


def _mean(values: Tensor, weight: Tensor) -> Float[Tensor, ""]:
    values = torch.where(weight > 0, values, 0.0)
    return (values * weight).sum() / weight.sum().clamp(min=1.0)


def _pixel_grid(dense: Float[Tensor, "e h w 2"]) -> tuple[Tensor, Tensor]:
    rows = torch.arange(dense.shape[1], dtype=dense.dtype, device=dense.device)
    columns = torch.arange(dense.shape[2], dtype=dense.dtype, device=dense.device)
    v, u = torch.meshgrid(rows, columns, indexing="ij")
    return u, v
