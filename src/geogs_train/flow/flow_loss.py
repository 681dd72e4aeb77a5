"""Estimates of the flow network for a batch, and its training loss."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.tracking.flow.lookup import RADIUS, WINDOW, correlation_windows
from geogs.tracking.flow.own_network import FlowEstimate, FlowFeatures, FlowNetwork
from geogs_train.flow.flow_options import FlowTraining
from geogs_train.flow.flow_pairs import FlowBatch

MAX_ERROR = 100.0
"""Limit to which errors are clamped, pixels: the size of a lost cell's error is no information."""


def run_network(
    network: FlowNetwork, batch: FlowBatch, iterations: int
) -> tuple[FlowFeatures, list[FlowEstimate], Float[Tensor, "e h w 2"]]:
    """Features, estimates of every iteration, upsampled flow of the last; bfloat16 on a GPU."""
    device = batch.images.device
    with torch.autocast(device.type, torch.bfloat16, enabled=device.type == "cuda"):
        images = batch.images
        if device.type == "cuda":
            images = images.contiguous(memory_format=torch.channels_last)
        features = network.encode(images)
        estimates = list(network.iterate(features, batch.edges, batch.start, iterations))
        dense = network.upsample(estimates[-1], *batch.truth.shape[1:3])
    return features, estimates, dense


def flow_loss(
    features: FlowFeatures,
    estimates: Sequence[FlowEstimate],
    dense: Float[Tensor, "e h w 2"],
    batch: FlowBatch,
    options: FlowTraining,
) -> Float[Tensor, ""]:
    """Loss of all iterations (later ones count more) and of the upsampled flow of the last.

    A cell's flow and its uncertainty are trained by the negative log-likelihood of the error, and
    by a little of its size, which keeps hopeless cells learning.
    """
    truth = batch.at_cells(batch.truth)
    weight = torch.where(batch.visible, 1.0, options.occluded) * batch.known
    at_cells = batch.at_cells(weight)
    total = truth.new_zeros(())
    for n, estimate in enumerate(estimates):
        error = (truth - estimate.pixels).clamp(-MAX_ERROR, MAX_ERROR)
        value = estimate.error.negative_log_likelihood(error)
        value = value + options.absolute * error.abs().log1p().mean(-1)
        total = total + options.decay ** (len(estimates) - 1 - n) * _mean(value, at_cells)
    missed = (batch.flow - dense).clamp(-MAX_ERROR, MAX_ERROR).abs()
    total = total + options.dense * _mean(missed.log1p().mean(-1), weight)
    return total + options.descriptors * descriptor_loss(features, batch)


def descriptor_loss(features: FlowFeatures, batch: FlowBatch) -> Float[Tensor, ""]:
    """Cross-entropy of windows around the probes with the position of the truth in them.

    A window is read as logits over its 49 positions; the truth is split over the four around it.
    Cells that the second view does not see, and levels whose window misses the truth, do not count.
    Sum over the levels of the mean over the cells. With it descriptors become distinctive within
    the first hundreds of steps; with the flow's error alone that takes thousands.
    """
    windows = correlation_windows(features.source, features.pyramid, batch.edges, batch.probe)
    windows = windows.unflatten(-1, (-1, WINDOW)).log_softmax(-1)
    away = batch.at_cells(batch.truth) - batch.probe
    seen = batch.at_cells(batch.visible)
    places = torch.arange(-RADIUS, RADIUS + 1, dtype=away.dtype, device=away.device)
    total = away.new_zeros(())
    for n, level in enumerate(features.pyramid.levels):
        at = away * level.scale
        inside = seen & (at.abs() <= RADIUS).all(-1)
        portion = (1 - (at[..., None] - places).abs()).clamp(min=0)  # e p 2 7
        target = (portion[..., 1, :, None] * portion[..., 0, None, :]).flatten(-2)
        total = total + _mean(-(target * windows[..., n, :]).sum(-1), inside.float())
    return total


def _mean(values: Tensor, weight: Tensor) -> Float[Tensor, ""]:
    values = torch.where(weight > 0, values, 0.0)
    return (values * weight).sum() / weight.sum().clamp(min=1.0)
