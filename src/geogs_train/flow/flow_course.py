"""The flow network's training course: flow of pairs of views."""

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.tracking.flow.own_network import FlowNetwork, load_flow_network
from geogs_synth.clips.room_options import SCENE_KINDS
from geogs_synth.clips.sampler import RoomSampler
from geogs_train.ahead import PlansAhead
from geogs_train.course import Panels, Worker, write_weights
from geogs_train.flow.flow_loss import flow_loss, run_network
from geogs_train.flow.flow_options import FlowTraining
from geogs_train.flow.flow_pairs import FlowBatch, flow_batch
from geogs_train.flow.flow_validation import SceneScores, SceneValidation
from geogs_train.flow.starts import StartOptions

LEAST_PROCESSES = 3
"""Fewest processes that draw plans for a GPU: a step of this network is short."""


class FlowCourse:
    """Training with new rooms in every step."""

    recordable = True
    """Whether loss and gradients may be recorded as a CUDA graph."""
    weights = "flow.safetensors"
    """Name of the file of trained weights."""
    curves: Panels = (
        (
            "usual rooms: error, pixels",
            ("usual.epe", "usual.dense", "usual.textureless", "usual.large", "usual.median"),
            True,
        ),
        ("usual rooms: shares", ("usual.within", "usual.outliers", "usual.sure_share"), False),
        ("error, pixels", tuple(f"others.{name}.epe" for name in SCENE_KINDS[1:]), True),
        ("median error, pixels", tuple(f"others.{name}.median" for name in SCENE_KINDS[1:]), True),
        (
            "within two deviations",
            tuple(f"others.{name}.within" for name in SCENE_KINDS[1:]),
            False,
        ),
    )

    def __init__(self, options: FlowTraining, worker: Worker) -> None:
        self.options = options
        self.worker = worker
        self.rooms = RoomSampler(options.rooms, worker.device, options.seed)
        self._plans = PlansAhead(self.rooms, options.batch, worker, LEAST_PROCESSES)

    def network(self) -> FlowNetwork:
        """Make a network with random weights, on the CPU."""
        return FlowNetwork(self.options.network)

    def compile(self, network: FlowNetwork) -> None:
        """Compile the parts for which it pays."""
        network.encoder.compile(dynamic=False)
        network.update.compile(dynamic=False)

    def batch(self, step: int, progress: float) -> FlowBatch:
        """Batch of every ordered pair of neighbouring views, with disturbed starts; all randomness
        is here, and depends only on the step."""
        clips = self.rooms.film(self._plans.plan(step))
        generator = self.worker.generator(self.options.seed, step)
        with torch.no_grad():
            return flow_batch(clips, StartOptions(far=self.options.far), generator)

    def loss(self, network: FlowNetwork, batch: FlowBatch) -> Float[Tensor, ""]:
        """Loss of the flow of all iterations and of its likelihood."""
        found = run_network(network, batch, self.options.iterations)
        return flow_loss(*found, batch, self.options)

    def validation(self, batches: int) -> SceneValidation:
        """Make the validation set."""
        return SceneValidation(self.options, self.worker.device, batches)

    def load(self, path: Path) -> FlowNetwork:
        """Load the network of a file of weights."""
        return load_flow_network(path)

    def export(self, network: FlowNetwork, path: Path, step: int, scores: SceneScores) -> None:
        """Write weights for shipping."""
        write_weights(network, path, step, scores=scores)

    def close(self) -> None:
        """End the processes that draw rooms."""
        self._plans.close()
