"""The fixed validation set: tuples of rooms and textures that training never uses."""

from dataclasses import replace

import torch
from jaxtyping import UInt8
from torch import Tensor

from geogs.depth.network.model import DepthNetwork
from geogs.depth.network.stereo_views import DepthPrediction
from geogs_synth.clips.sampler import RoomSampler
from geogs_synth.draw import Draw
from geogs_synth.textures.pyramids import TextureBank
from geogs_train.depth.clip_pool import StoredClips
from geogs_train.depth.depth_options import DepthTraining
from geogs_train.depth.depth_scores import DepthErrors, DepthScores, summarise, texture_kind
from geogs_train.depth.depth_tuples import DepthBatch, draw_tuples

SEED = 3141
EVERY = 3
"""Step between the scored pixels, across and down."""


class DepthValidation:
    """Validation keyframes of one size with neighbours; drawn once, kept on the device."""

    def __init__(
        self,
        options: DepthTraining,
        device: torch.device,
        batches: int,
        seed: int = SEED,
        bank: TextureBank | None = None,
    ) -> None:
        """``bank`` may be that of another set."""
        rooms = RoomSampler(replace(options.rooms, validation=True), device, seed, bank)
        self.options = options
        self.bank = rooms.bank
        draw = Draw(torch.Generator(device).manual_seed(seed))
        self.batches: list[DepthBatch] = []
        self.kinds: list[UInt8[Tensor, "b h w"]] = []
        tuples = options.tuples
        span = tuples.most_neighbours - tuples.least_neighbours + 1
        for number in range(batches):
            clips = rooms.sample(number, options.pool.rooms)
            count = tuples.least_neighbours + number % span
            stored = StoredClips.of(clips)
            batch = draw_tuples(stored, options.batch, count, tuples, draw)
            clip, view = batch.place.unbind(1)
            self.batches.append(batch)
            self.kinds.append(texture_kind(clips.light[clip, view]))

    @torch.no_grad()
    def errors(self, network: DepthNetwork) -> list[DepthErrors]:
        """Errors of a network, batch by batch."""
        network.eval()
        parts = [
            pixel_errors(batch, network(batch.views), kind)
            for batch, kind in zip(self.batches, self.kinds, strict=True)
        ]
        network.train()
        return parts

    def score(self, network: DepthNetwork) -> DepthScores:
        """Scores of a network."""
        return summarise(DepthErrors.join(self.errors(network)))


def pixel_errors(
    batch: DepthBatch, found: DepthPrediction, kind: UInt8[Tensor, "b h w"]
) -> DepthErrors:
    """Errors of some of the pixels of a batch."""
    error = (found.depth(batch.views.typical) / batch.depth).log()
    cosine = (found.normal * batch.normal).sum(1)
    angle = torch.rad2deg(cosine.clamp(-1, 1).arccos())
    columns = (error, found.deviation(), found.outlier.sigmoid(), angle, kind)
    return DepthErrors(*(c[:, ::EVERY, ::EVERY].flatten() for c in columns))
