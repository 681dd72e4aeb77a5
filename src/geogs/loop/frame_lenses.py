"""Lenses that change from frame to frame in the adjustment of all keyframes.

Focusing anew magnifies otherwise, stabilisation moves the lens or the crop, a zoom does the first
on purpose. Matches tell it of each keyframe; they are corrected for it, and everything is adjusted
again. Flow is not measured anew until images are straight. What a lens has of its own counts as
a random number of a deviation that the video tells, too (expectation maximisation).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.projection import project
from geogs.bundle.protocols import BundleOptions
from geogs.bundle.uncertainty.lens_error import SHAPES, lens_prior, shifts_of_edges
from geogs.bundle.uncertainty.varying_intrinsics import (
    EXPLAINED,
    FIRST,
    OWN,
    VaryingPrior,
)
from geogs.geometry.camera import Camera
from geogs.loop.straightening import FrameViews
from geogs.tracking.frame_lenses import shift_frames, sizes_of_frames
from geogs.tracking.frames.row_errors import in_parts
from geogs.tracking.graph.frame_graph import FrameGraph
from geogs.tracking.keyframe_uncertainty import said_of_frame_lenses
from geogs.tracking.tracker import Tracker
from geogs.types import FoundLens, FrameLens
from geogs.world.edges import PackedEdge, Pair
from geogs.world.straight_view import StraightView

ROUNDS = 8
"""At most."""
SETTLED = 2e-4
"""Largest change of a size, root mean square over the keyframes, by which the rounds end."""
UNSETTLED = 2e-3
"""From which on they have not settled after the last round."""
TOLD = 1e-6
"""Deviation of what is shared of a lens that somebody told of."""


@dataclass(frozen=True)
class VaryingLens:
    """What was found of a lens that changes."""

    lens: FoundLens
    """Of all frames."""
    own: Mapping[int, FrameLens]
    """By the indices of the frames that have a place."""
    prior: VaryingPrior | None = None
    """By which they vary, where they do."""

    def followed_by(self, camera: Camera, other: "VaryingLens") -> "VaryingLens":
        """With what was found on images that are straight by this."""
        lens = StraightView(camera, self.lens).followed_by(other.lens)
        none = FrameLens()
        own = {
            n: self.own.get(n, none).plus(other.own.get(n, none))
            for n in sorted(self.own.keys() | other.own.keys())
        }
        return VaryingLens(lens, own, other.prior or self.prior)

    def shift(self, tracker: Tracker) -> None:
        """Correct what was found of frames, beside what it was corrected by. After the lens of all
        (``shift_lens``), which takes the place of what was there."""
        lens, each = self.lens, list(OWN)
        common = torch.tensor([math.log(lens.focal), lens.k1, lens.k2, lens.right, lens.down])
        sizes = {
            n: common.double().index_add(0, torch.tensor(each), torch.tensor(o.sizes).double())
            for n, o in self.own.items()
        }
        shift_frames(tracker.map.recorder.log, tracker.keyframes, sizes)

    def views(self, camera: Camera) -> FrameViews:
        """How its frames are straightened."""
        each = torch.tensor([o.sizes for o in self.own.values()] or [FrameLens().sizes])
        focal, right, down = each.double().square().mean(0).sqrt().tolist()
        lens = replace(self.lens, varies_focal=focal, varies_centre=math.hypot(right, down))
        return FrameViews(StraightView(camera, lens), self.own)


def correct_frame_lenses(
    tracker: Tracker,
    free_pose: Sequence[int],
    free_depth: Sequence[int],
    options: BundleOptions,
    before: VaryingLens | None = None,
) -> VaryingLens | None:
    """Correct all matches for what the lens of each keyframe has of its own, and adjust again.

    None where matches do not ask for it, or it does not settle: then everything is as it was.
    ``before`` was found already, images are straight by it, and what is left is asked for. What was
    found of the frames between the keyframes stays (:meth:`VaryingLens.shift`). Not in the world of
    a saved map. Of a lens that somebody told of, what all frames share stays.
    """
    graph, keyframes, log = tracker.map.graph, tracker.keyframes, tracker.map.recorder.log
    if not graph.edges or tracker.segment.fixed:
        return None
    kept = [(k, k.T_cw.clone(), k.inverse_depth.clone(), k.information.clone()) for k in keyframes]
    measured = graph.packed
    sizes = _Sizes(tracker, before.prior if before is not None and before.prior else FIRST)
    last = math.inf
    for n in range(ROUNDS):
        explained, last = sizes.step()
        if n == 0 and before is None and explained < EXPLAINED:
            return None
        _shift(graph, measured, sizes)
        graph.adjust(list(graph.edges), free_pose, free_depth, options)
        if last < SETTLED:
            break
    if last > UNSETTLED:
        graph.edges.update(measured)
        for keyframe, T_cw, depth, information in kept:
            keyframe.T_cw, keyframe.inverse_depth = T_cw, depth
            keyframe.information = information
        return None
    known = {k.frame_index: sizes.of(k.id) for k in keyframes}
    found = sizes_of_frames(log, keyframes, known, sizes.prior)
    own = {n: FrameLens(*(s - sizes.common)[list(OWN)].tolist()) for n, s in found.items()}
    focal, k1, k2, right, down = sizes.common.tolist()
    lens = FoundLens(k1, k2, 0.0, 0.0, math.exp(focal), right=right, down=down)
    return VaryingLens(lens, own, sizes.prior)


class _Sizes:
    """Errors of the lens of all keyframes and of each, as far as they are taken off the matches."""

    def __init__(self, tracker: Tracker, prior: VaryingPrior) -> None:
        self.prior, self.common = prior, torch.zeros(SHAPES, dtype=torch.float64)
        self._tracker, self._own = tracker, dict[int, Tensor]()
        deviation = tracker.keyframes.table.focal_deviation
        self._is_open = deviation > 0
        expected = lens_prior(deviation) if self._is_open else SHAPES * (TOLD,)
        self._shared = torch.tensor(expected, dtype=torch.float64)

    def of(self, id: int) -> Float[Tensor, "5"]:
        """Of a keyframe, with what all share."""
        return self.common.index_add(0, torch.tensor(OWN), self._of(id))

    def step(self) -> tuple[float, float]:
        """Go on to what matches ask for now. Returns which part of their cost it takes off, and
        the largest of the sizes' steps, root mean square over the keyframes; none where nothing
        tells."""
        keyframes, explained = self._tracker.keyframes, 0.0
        said = said_of_frame_lenses(self._tracker, self._tracker.segment.ids)
        steps: dict[int, Tensor] = {}
        for frames, evidence in said:
            times = torch.tensor([keyframes[k].timestamp for k in frames]).double()
            taken = torch.cat([*(self._of(k) for k in frames), self.common])
            step, self.prior = evidence.told(times, taken, self.prior, self._shared)
            explained = max(explained, evidence.explained(step))
            steps.update(zip(frames, step[:-SHAPES].reshape(-1, len(OWN)), strict=True))
            if self._is_open:
                self.common = self.common + step[-SHAPES:] / len(said)
        for k, own in steps.items():
            self._own[k] = self._of(k) + own
        moved = torch.stack([*steps.values()]) if steps else torch.zeros(1, len(OWN))
        return explained, float(moved.square().mean(0).max().sqrt())

    def _of(self, id: int) -> Float[Tensor, "3"]:
        return self._own.get(id, torch.zeros(len(OWN), dtype=torch.float64))


def _shift(graph: FrameGraph, measured: Mapping[Pair, PackedEdge], sizes: _Sizes) -> None:
    """Have the measured edges with their matches where the pinhole would have them."""
    grid, keyframes = graph.keyframes.grid, graph.keyframes
    for part in in_parts(sorted(measured), grid.on_gpu):
        T_ji, depth = keyframes.relative_poses(part), keyframes.inverse_depths([i for i, _ in part])
        at = project(grid.camera, grid.rays, T_ji, depth)
        both = torch.stack([torch.stack([sizes.of(k) for k in pair]) for pair in part])
        shifts = shifts_of_edges(grid.camera, grid.rays, T_ji, at, both.to(at.pixels))
        for pair, shift in zip(part, shifts, strict=True):
            graph.edges[pair] = measured[pair].moved(grid.camera, shift)
