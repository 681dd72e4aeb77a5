"""One training run of the flow network: steps, running mean of the weights, exact resume."""

import math
from dataclasses import asdict, dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, distributed, nn

from geogs.tracking.flow.own_network import FlowEstimate, FlowNetwork
from geogs.train.flow_loss import flow_loss
from geogs.train.options import FlowTraining
from geogs.train.pairs import FlowBatch, flow_batch
from geogs.train.rooms.options import RoomOptions
from geogs.train.rooms.sampler import RoomSampler
from geogs.train.starts import StartOptions


@dataclass(frozen=True)
class Worker:
    """This process among those that train together, one for each device."""

    device: torch.device
    rank: int = 0
    count: int = 1


class FlowTrainer:
    """The network, its optimiser and the rooms it learns from.

    Step n of a run depends on nothing but the seed, n, and the state after step n - 1, so that a
    run that goes on from a checkpoint equals one that was never stopped (on the CPU to the last
    bit).
    """

    def __init__(self, options: FlowTraining, worker: Worker, fuse: bool = False) -> None:
        self.options, self.worker = options, worker
        torch.manual_seed(options.seed)
        self.network = FlowNetwork(options.network).to(worker.device)
        self.mean = FlowNetwork(options.network).to(worker.device).requires_grad_(False)
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
        self.rooms = RoomSampler(
            RoomOptions(width=options.width, height=options.height, views=options.views),
            worker.device,
            options.seed,
        )
        if fuse:
            self.network.encoder.compile(dynamic=False)
            self.network.update.compile(dynamic=False)

    def advance(self) -> Float[Tensor, ""]:
        """Take a step; returns its loss, which stays on the device."""
        options = self.options
        batch = self.batch(self.step)
        self._gradient.zero_()
        loss = self._loss(batch)
        loss.backward()
        if self.worker.count > 1:
            distributed.all_reduce(self._gradient)
            self._gradient /= self.worker.count
        nn.utils.clip_grad_norm_(self._parameters, options.clip)
        # A step from a loss that is not finite would be the last.
        self._gradient.nan_to_num_(0.0, 0.0, 0.0)
        for group in self.optimizer.param_groups:
            group["lr"] = options.learning_rate * schedule(self.step, options)
        self.optimizer.step()
        self.step += 1
        decay = min(options.ema, (1 + self.step) / (10 + self.step))
        with torch.no_grad():
            means: list[Tensor] = [*self.mean.parameters()]
            torch._foreach_lerp_(means, [*self._parameters], 1 - decay)
        return loss.detach()

    def batch(self, step: int) -> FlowBatch:
        """What step ``step`` learns from."""
        clips = self.rooms.sample(step, self.options.batch, self.worker.rank)
        generator = torch.Generator(self.worker.device)
        generator.manual_seed(hash((self.options.seed, step, self.worker.rank)) % 2**62)
        with torch.no_grad():
            return flow_batch(clips, StartOptions(), generator)

    def state(self) -> dict[str, Any]:
        """All that a run needs to go on; plain tensors and numbers."""
        return {
            "options": asdict(self.options),
            "step": self.step,
            "network": self.network.state_dict(),
            "mean": self.mean.state_dict(),
            "optimizer": self.optimizer.state_dict(),
        }

    def load(self, state: dict[str, Any]) -> None:
        """Go on from :meth:`state`."""
        self.network.load_state_dict(state["network"])
        self.mean.load_state_dict(state["mean"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.step = int(state["step"])

    def _loss(self, batch: FlowBatch) -> Float[Tensor, ""]:
        estimates, dense = run_network(self.network, batch, self.options.iterations)
        return flow_loss(estimates, dense, batch, self.options)


def run_network(
    network: FlowNetwork, batch: FlowBatch, iterations: int
) -> tuple[list[FlowEstimate], Float[Tensor, "e h w 2"]]:
    """Estimates of every iteration, and the upsampled flow of the last; bfloat16 on a GPU."""
    device = batch.images.device
    with torch.autocast(device.type, torch.bfloat16, enabled=device.type == "cuda"):
        images = batch.images
        if device.type == "cuda":
            images = images.contiguous(memory_format=torch.channels_last)
        features = network.encode(images)
        estimates = list(network.iterate(features, batch.edges, batch.start, iterations))
        dense = network.upsample(estimates[-1], *batch.truth.shape[1:3])
    return estimates, dense


def schedule(step: int, options: FlowTraining) -> float:
    """Learning rate of a step over its peak: a linear warm-up, then half a cosine."""
    if step < options.warmup:
        return (step + 1) / options.warmup
    done = (step - options.warmup) / max(options.steps - options.warmup, 1)
    return 0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(done, 1.0)))


def _flat_gradient(parameters: list[nn.Parameter]) -> Float[Tensor, "n"]:
    """One buffer for all gradients, so that they are summed over the devices at once."""
    flat = torch.zeros(sum(p.numel() for p in parameters), device=parameters[0].device)
    at = 0
    for p in parameters:
        p.grad = flat[at : at + p.numel()].view_as(p)
        at += p.numel()
    return flat
