"""The second stage: flow, weights and all through the dense bundle adjustment."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.errors import InputError
from geogs.geometry.lie import retract
from geogs.tracking.flow.lookup import Edges
from geogs.tracking.flow.own import OwnFlowOptions
from geogs.tracking.flow.own_network import FlowNetwork, cell_pixels
from geogs.world.grid import OFFSET, STRIDE
from geogs_synth.clips.clip_batch import ClipBatch
from geogs_synth.clips.room_options import only_scene
from geogs_train.course import Worker
from geogs_train.flow.bundle import (
    ClipBundleOptions,
    ClipCameras,
    ClipEdges,
    ClipMatches,
    ClipState,
    adjust,
    reproject,
)
from geogs_train.flow.flow_course import FlowCourse
from geogs_train.flow.flow_options import FlowTraining
from geogs_train.flow.flow_pairs import MARGIN
from geogs_train.flow.pose_loss import PoseLossOptions, pose_loss

FLOOR = OwnFlowOptions().floor
"""Deviation in pixels that no weight goes beyond, as in the operator."""
SOLVER = ClipBundleOptions(iterations=2, damping_floor=1e-2, depth_damping=1e-3)
"""As the tracker's, in pixels."""


@dataclass(frozen=True)
class BundleBatch:
    """Clips with their true poses and depths, and a wrong state to begin with."""

    images: Float[Tensor, "n 3 h w"]
    cameras: ClipCameras
    edges: ClipEdges
    truth: ClipState
    start: ClipState


def neighbour_edges(views: int, reach: int, device: torch.device | str = "cpu") -> ClipEdges:
    """All ordered pairs of views at most ``reach`` apart."""
    pairs = [(i, j) for i in range(views) for j in range(views) if 0 < abs(i - j) <= reach]
    return ClipEdges(*torch.tensor(pairs, device=device).unbind(1))


def true_state(T_cw: Float[Tensor, "b v 4 4"], depth: Float[Tensor, "b v h w"]) -> ClipState:
    """The truth at the cells, at the scale that makes the median inverse depth of a clip one.

    That is where a tracker's depths start, so that one is as good a guess as any.
    """
    d = 1 / depth[..., OFFSET:-3:STRIDE, OFFSET:-3:STRIDE].flatten(2)
    scale = d.flatten(1).median(1).values[:, None, None]
    T = T_cw.clone()
    T[..., :3, 3] *= scale.to(T)
    return ClipState(T, d / scale)


class BundleCourse(FlowCourse):
    """What poses and depths come out of adjusting the network's flow with its weights.

    Rounds of flow from the present reprojection and adjustment, as the tracker's; the loss is
    DROID-SLAM's (poses, induced flow) and the likelihood of the flow, which keeps the
    deviations true.
    """

    recordable = False

    def __init__(self, options: FlowTraining, worker: Worker) -> None:
        """Raises InputError for rooms in which something moves or looks unusual."""
        if options.rooms.scenes != only_scene("usual"):
            raise InputError(
                "The bundle stage is for still rooms: --training.rooms.scenes.* must be 0 for all "
                "kinds but usual."
            )
        super().__init__(options, worker)

    def prepare(self, clips: ClipBatch, generator: torch.Generator) -> BundleBatch:
        """Disturb poses and depths; the first two poses, which set the scale, stay."""
        views, device = clips.images.shape[1], clips.images.device
        edges = neighbour_edges(views, self.options.bundle.reach, device)
        truth = true_state(clips.T_cw.double(), clips.depth.clamp(min=1e-2))
        rows, columns = clips.depth[0, 0, OFFSET:-3:STRIDE, OFFSET:-3:STRIDE].shape
        cells = cell_pixels(rows, columns, clips.depth)
        T = truth.T_cw

        def normal(*shape: int) -> Tensor:
            return torch.randn(*shape, generator=generator, device=device)

        amount = 10 ** (-3.0 + 1.5 * torch.rand(len(T), 1, 1, generator=generator, device=device))
        xi = amount * normal(*T.shape[:2], 6)
        xi = torch.cat([torch.zeros_like(xi[:, :2]), xi[:, 2:]], 1)
        wrong = truth.inverse_depth * (3 * amount * normal(*truth.inverse_depth.shape)).exp()
        start = ClipState(retract(xi.double(), T), wrong)
        cameras = ClipCameras(clips.intrinsics.float(), cells)
        return BundleBatch(clips.images.flatten(0, 1), cameras, edges, truth, start)

    def loss(self, network: FlowNetwork, batch: BundleBatch) -> Float[Tensor, ""]:
        """The loss of all rounds, the last counting most."""
        options, edges = self.options, batch.edges
        clips, views = batch.truth.inverse_depth.shape[:2]
        device = batch.images.device
        base = views * torch.arange(clips, dtype=torch.int32, device=device)[:, None]
        pairs = Edges(*((base + k.int()).flatten() for k in (edges.source, edges.target)))
        true = reproject(batch.cameras, batch.truth, edges)
        size = batch.cameras.cells.amax(0) + OFFSET + MARGIN
        near = (true.valid & ((true.pixels > -MARGIN) & (true.pixels < size)).all(-1)).float()
        with torch.autocast(device.type, torch.bfloat16, enabled=device.type == "cuda"):
            features = network.encode(batch.images)
        state, found, likelihood = batch.start, [], torch.zeros((), device=device)
        for _ in range(options.bundle.rounds):
            state = state.detach()
            begin = reproject(batch.cameras, state, edges).pixels.flatten(0, 1).float()
            with torch.autocast(device.type, torch.bfloat16, enabled=device.type == "cuda"):
                *_, last = network.iterate(features, pairs, begin, options.iterations)
            pixels = last.pixels.unflatten(0, (clips, -1))
            error = (true.pixels - pixels).clamp(-100, 100).flatten(0, 1)
            value = last.error.negative_log_likelihood(error).unflatten(0, (clips, -1))
            likelihood = likelihood + (near * value).sum() / near.sum().clamp(min=1)
            weight = last.error.weight(FLOOR).unflatten(0, (clips, -1))
            inside = ((pixels > 1) & (pixels < size - MARGIN)).all(-1, keepdim=True)
            matches = ClipMatches(pixels, weight * inside)
            state = adjust(batch.cameras, state, edges, matches, SOLVER)
            found.append(state)
        terms = PoseLossOptions(flow=options.bundle.flow, pose=options.bundle.pose)
        total = pose_loss(batch.cameras, found, batch.truth, edges, terms)
        return total.float() + options.bundle.likelihood * likelihood
