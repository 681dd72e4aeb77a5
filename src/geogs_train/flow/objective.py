"""What a stage of the training makes of clips, and what it asks of the network."""

from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.errors import InputError
from geogs.tracking.flow.own_network import FlowEstimate, FlowFeatures, FlowNetwork
from geogs_synth.clips.clips import ClipBatch
from geogs_synth.clips.room_options import only_scene
from geogs_train.flow.flow_loss import flow_loss
from geogs_train.flow.flow_options import FlowTraining
from geogs_train.flow.flow_pairs import FlowBatch, flow_batch
from geogs_train.flow.starts import StartOptions


@runtime_checkable
class Objective(Protocol):
    """A stage."""

    recordable: bool
    """Whether the loss may be recorded as a CUDA graph."""

    def prepare(self, clips: ClipBatch, generator: torch.Generator) -> Any:
        """A batch; all that is random is drawn here."""
        ...

    def loss(self, network: FlowNetwork, batch: Any) -> Float[Tensor, ""]:
        """The loss of a batch that :meth:`prepare` made."""
        ...


class FlowObjective:
    """The first stage: flow of pairs and its likelihood."""

    recordable = True

    def __init__(self, options: FlowTraining) -> None:
        self.options = options

    def prepare(self, clips: ClipBatch, generator: torch.Generator) -> FlowBatch:
        """Every ordered pair of neighbouring views, from disturbed starts."""
        return flow_batch(clips, StartOptions(far=self.options.far), generator)

    def loss(self, network: FlowNetwork, batch: FlowBatch) -> Float[Tensor, ""]:
        """The loss of all iterations."""
        features, estimates, dense = run_network(network, batch, self.options.iterations)
        return flow_loss(features, estimates, dense, batch, self.options)


def objective(options: FlowTraining) -> Objective:
    """The stage that the options name."""
    if options.stage == "flow":
        return FlowObjective(options)
    if options.rooms.scenes != only_scene("usual"):
        raise InputError(
            "The bundle stage is for still rooms: --training.rooms.scenes.* must be 0 for all "
            "kinds but usual."
        )
    from geogs_train.flow.bundle_objective import BundleObjective

    return BundleObjective(options)


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
