"""The flow network's course: clips of random rooms and one of the two stages of its training."""

import os
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.tracking.flow.own import load_network
from geogs.tracking.flow.own_network import FlowNetwork
from geogs_synth.clips.room_options import SCENE_KINDS
from geogs_synth.clips.sampler import Plan, RoomSampler
from geogs_train.ahead import PROCESSES, PlansAhead
from geogs_train.course import Panels, Worker
from geogs_train.flow.flow_options import FlowTraining
from geogs_train.flow.flow_validation import SceneScores, SceneValidation
from geogs_train.flow.objective import objective
from geogs_train.trained_weights import write_weights


class FlowCourse:
    """Every step films other rooms."""

    weights = "flow.safetensors"
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

    def examination(self, batches: int) -> SceneValidation:
        """As in the protocol."""
        return SceneValidation(self.options, self.worker.device, batches)

    def load(self, path: Path) -> FlowNetwork:
        """As in the protocol."""
        return load_network(path)

    def export(self, network: FlowNetwork, path: Path, step: int, scores: SceneScores) -> None:
        """As in the protocol."""
        write_weights(network, path, step, scores=scores)

    def close(self) -> None:
        """End the processes that draw rooms."""
        if self._plans is not None:
            self._plans.close()

    def _plan(self, step: int) -> Plan:
        options, rank = self.options, self.worker.rank
        if self.worker.device.type != "cuda":
            return self.rooms.plan(step, options.batch, rank)
        if self._plans is None:
            cores = len(os.sched_getaffinity(0)) // self.worker.count
            self._plans = PlansAhead(
                options.rooms, self.rooms.bank.materials, options.seed, options.batch, rank,
                processes=max(PROCESSES, min(6, (cores - 2) // 2)),
            )  # fmt: skip
        return self._plans.plan(step)
