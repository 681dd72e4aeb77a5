"""The flow network's course: clips of random rooms and one of the two stages of its training."""

from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.tracking.flow.own import load_network
from geogs.tracking.flow.own_network import FlowNetwork
from geogs_train.ahead import PlansAhead
from geogs_train.course import Panels, Worker
from geogs_train.export import export_weights
from geogs_train.objective import objective
from geogs_train.options import FlowTraining
from geogs_train.rooms.sampler import Plan, RoomSampler
from geogs_train.scores import FlowScores
from geogs_train.validation import Validation


class FlowCourse:
    """Every step films other rooms."""

    weights = "flow.safetensors"
    curves: Panels = (
        ("validation error, pixels", ("epe", "dense", "textureless", "large", "median"), True),
        ("shares of validation cells", ("within", "outliers", "sure_share"), False),
    )

    def __init__(self, options: FlowTraining, worker: Worker) -> None:
        self.options, self.worker = options, worker
        self.objective = objective(options)
        self.recordable = self.objective.recordable
        self.rooms = RoomSampler(options.rooms, worker.device, options.seed)
        self._plans: PlansAhead | None = None

    def network(self) -> FlowNetwork:
        """As in the protocol."""
        return FlowNetwork(self.options.network)

    def compile(self, network: FlowNetwork) -> None:
        """As in the protocol."""
        network.encoder.compile(dynamic=False)
        network.update.compile(dynamic=False)

    def batch(self, step: int, progress: float) -> Any:
        """As in the protocol."""
        clips = self.rooms.film(self._plan(step))
        generator = torch.Generator(self.worker.device)
        generator.manual_seed(hash((self.options.seed, step, self.worker.rank)) % 2**62)
        with torch.no_grad():
            return self.objective.prepare(clips, generator)

    def loss(self, network: FlowNetwork, batch: Any) -> Float[Tensor, ""]:
        """As in the protocol."""
        return self.objective.loss(network, batch)

    def examination(self, batches: int) -> Validation:
        """As in the protocol."""
        return Validation(self.options, self.worker.device, batches)

    def load(self, path: Path) -> FlowNetwork:
        """As in the protocol."""
        return load_network(path)

    def export(self, network: FlowNetwork, path: Path, step: int, scores: FlowScores) -> None:
        """As in the protocol."""
        export_weights(network, path, step, scores)

    def close(self) -> None:
        """End the processes that draw rooms."""
        if self._plans is not None:
            self._plans.close()

    def _plan(self, step: int) -> Plan:
        options, rank = self.options, self.worker.rank
        if self.worker.device.type != "cuda":
            return self.rooms.plan(step, options.batch, rank)
        if self._plans is None:
            self._plans = PlansAhead(
                options.rooms, self.rooms.bank.materials, options.seed, options.batch, rank
            )
        return self._plans.plan(step)
