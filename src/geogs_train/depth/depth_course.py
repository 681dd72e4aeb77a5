"""The depth network's training course: keyframes drawn from pools of clips of random rooms."""

from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.depth.network.model import DepthNetwork, load_depth_network
from geogs_synth.clips.sampler import RoomSampler
from geogs_synth.draw import Draw
from geogs_train.course import Panels, Worker, write_weights
from geogs_train.depth.clip_pool import ClipPool
from geogs_train.depth.depth_loss import depth_loss
from geogs_train.depth.depth_options import DepthTraining
from geogs_train.depth.depth_scores import DepthErrors, DepthScores, calibrated
from geogs_train.depth.depth_tuples import DepthBatch, draw_tuples
from geogs_train.depth.depth_validation import DepthValidation

CALIBRATION_BATCHES, CALIBRATION_SEED = 6, 9


class DepthCourse:
    """Training on small images first, then on large ones, each size with its own pool."""

    weights = "depth.safetensors"
    curves: Panels = (
        (
            "mean relative error of depth",
            ("absolute", "textured_absolute", "faint_absolute", "bare_absolute"),
            True,
        ),
        ("median error of normals, degrees", ("normal", "textured_normal", "bare_normal"), True),
        ("shares of validation pixels", ("within", "within_3", "within_5", "sure"), False),
    )
    recordable = False

    def __init__(self, options: DepthTraining, worker: Worker) -> None:
        self.options = options
        self.worker = worker
        large = RoomSampler(options.rooms, worker.device, options.seed)
        small = RoomSampler(
            replace(options.rooms, width=options.small_width, height=options.small_height),
            worker.device,
            options.seed + 1,
            large.bank,
        )
        pool = options.pool
        self._pools = [ClipPool(r, pool.plans, pool.rooms, worker) for r in (large, small)]
        self._held_out: DepthValidation | None = None

    def network(self) -> DepthNetwork:
        """Make a network with random weights, on the CPU."""
        return DepthNetwork(self.options.network)

    def compile(self, network: DepthNetwork) -> None:
        """Compile the parts with constant batch sizes, whatever the number of neighbours."""
        for part in (network.context, network.body):
            part.compile(dynamic=False)

    @torch.no_grad()
    def batch(self, step: int, progress: float) -> DepthBatch:
        """Draw a batch; the size of its images, by the finished fraction of the run, and the number
        of neighbours are equal for all workers."""
        options = self.options
        small = progress < options.small
        if not small:
            self._pools[True].empty()
        clips = self._pools[small].at(step // options.pool.refresh)
        shared = Draw.keyed(torch.device("cpu"), options.seed, step)
        least = options.tuples.least_neighbours
        most = options.tuples.most_neighbours
        count = least + int(shared.integers(most - least + 1, 1))
        draw = Draw(self.worker.generator(options.seed, step))
        size = options.small_batch if small else options.batch
        batch = draw_tuples(clips, size, count, options.tuples, draw)
        return replace(batch, progress=progress)

    def loss(self, network: DepthNetwork, batch: DepthBatch) -> Float[Tensor, ""]:
        """Loss of a batch; deterministic."""
        return depth_loss(network(batch.views), batch, self.options.loss)

    def validation(self, batches: int) -> DepthValidation:
        """Make the validation set."""
        found = DepthValidation(self.options, self.worker.device, batches)
        count = min(batches, CALIBRATION_BATCHES)
        self._held_out = DepthValidation(
            self.options, self.worker.device, count, CALIBRATION_SEED, found.bank
        )
        return found

    def load(self, path: Path) -> DepthNetwork:
        """Load the network of a file of weights."""
        return load_depth_network(path).requires_grad_(True)

    def export(self, network: DepthNetwork, path: Path, step: int, scores: DepthScores) -> None:
        """Write weights for shipping, calibrated on rooms that neither training nor validation
        use."""
        assert self._held_out is not None  # made with the validation set
        calibration = calibrated(DepthErrors.join(self._held_out.errors(network)))
        write_weights(network, path, step, scores=scores, calibration=calibration)

    def close(self) -> None:
        """End the processes that draw rooms."""
        for pool in self._pools:
            pool.close()
