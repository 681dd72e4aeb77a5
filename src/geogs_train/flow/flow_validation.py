"""The fixed validation set: rooms and textures that training never uses."""

from dataclasses import dataclass, replace

import torch

from geogs.tracking.flow.own_network import FlowNetwork
from geogs_synth.clips.room_options import SCENE_KINDS, only_scene
from geogs_synth.clips.sampler import RoomSampler
from geogs_synth.textures.pyramids import TextureBank
from geogs_train.flow.flow_loss import run_network
from geogs_train.flow.flow_options import FlowTraining
from geogs_train.flow.flow_pairs import FlowBatch, flow_batch
from geogs_train.flow.flow_scores import CellErrors, FlowScores, has_texture, summarise
from geogs_train.flow.starts import StartOptions

SEED = 2718


@dataclass(frozen=True)
class SceneScores:
    """Scores on the kinds of scenes in a network's training."""

    usual: FlowScores
    others: dict[str, FlowScores]
    """Scores by the names of :class:`SceneWeights`."""

    def line(self) -> str:
        """Format on a line for each kind."""
        rows = {"usual": self.usual, **self.others}
        return "\n".join(f"{name:8} {scores.line()}" for name, scores in rows.items())


class SceneValidation:
    """One validation set for each kind of scene; always with the usual one."""

    def __init__(self, options: FlowTraining, device: torch.device, batches: int) -> None:
        self._usual = Validation(options, device, batches)
        weights, few = options.rooms.scenes, max(1, batches // 2)
        self._others = {
            name: Validation(options, device, few, name, self._usual.bank)
            for name in SCENE_KINDS[1:]
            if getattr(weights, name) > 0
        }

    def score(self, network: FlowNetwork) -> SceneScores:
        """Scores of a network."""
        others = {name: v.score(network) for name, v in self._others.items()}
        return SceneScores(self._usual.score(network), others)


class Validation:
    """Batches of unseen scenes of one kind, rendered on demand."""

    def __init__(
        self,
        options: FlowTraining,
        device: torch.device,
        batches: int = 8,
        scene: str = "usual",
        bank: TextureBank | None = None,
    ) -> None:
        """``bank`` may be that of another set."""
        rooms = replace(options.rooms, views=2, validation=True, scenes=only_scene(scene))
        self._rooms = RoomSampler(rooms, device, SEED, bank)
        self.bank = self._rooms.bank
        self._iterations = options.iterations
        self.batches, self._batch, self._device = batches, options.batch, device

    def batch(self, number: int, starts: StartOptions | None = None) -> FlowBatch:
        """Directed pairs of a batch, with the starts of the training unless others are given."""
        generator = torch.Generator(self._device)
        generator.manual_seed(SEED + number)
        return flow_batch(
            self._rooms.sample(number, self._batch), starts or StartOptions(), generator
        )

    @torch.no_grad()
    def score(self, network: FlowNetwork) -> FlowScores:
        """Scores of a network."""
        parts = []
        for number in range(self.batches):
            batch = self.batch(number)
            _, estimates, dense = run_network(network, batch, self._iterations)
            deviation = estimates[-1].error.variance().sqrt()
            parts.append(cell_errors(batch, estimates[-1].pixels, deviation, dense))
        return summarise(parts)


def cell_errors(
    batch: FlowBatch, pixels: torch.Tensor, deviation: torch.Tensor, dense: torch.Tensor
) -> CellErrors:
    """Errors on the visible cells (and pixels) of a batch, given positions and dense flow."""
    truth, visible = batch.at_cells(batch.truth), batch.at_cells(batch.visible)
    flow = batch.flow
    textured = batch.at_cells(has_texture(batch.images))[batch.edges.first.long()]
    return CellErrors(
        error=(truth - pixels)[visible],
        deviation=deviation[visible],
        motion=batch.at_cells(flow).norm(dim=-1)[visible],
        textured=textured[visible],
        dense=(flow - dense).norm(dim=-1)[batch.visible],
    )
