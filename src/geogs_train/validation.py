"""The fixed validation set: rooms and textures that training never shows."""

from dataclasses import replace

import torch

from geogs.tracking.flow.own_network import FlowNetwork
from geogs_train.objective import run_network
from geogs_train.options import FlowTraining
from geogs_train.pairs import FlowBatch, flow_batch
from geogs_train.rooms.sampler import RoomSampler
from geogs_train.scores import CellErrors, FlowScores, has_texture, summarise
from geogs_train.starts import StartOptions

SEED = 2718


class Validation:
    """Batches of unseen rooms, made again whenever they are needed."""

    def __init__(self, options: FlowTraining, device: torch.device, batches: int = 8) -> None:
        rooms = replace(options.rooms, views=2, validation=True)
        self._rooms = RoomSampler(rooms, device, SEED)
        self._iterations = options.iterations
        self.batches, self._batch, self._device = batches, options.batch, device

    def batch(self, number: int, starts: StartOptions | None = None) -> FlowBatch:
        """The directed pairs of a batch, with the starts of the training if no others."""
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
