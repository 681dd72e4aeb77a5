"""One closing of loops: what it is computed from, and how its answer meets keyframes as they are
by then."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.geometry.lie import se3_inverse
from geogs.loop.closure import LoopClosure, close_loops
from geogs.loop.matched_edges import MatchedEdges
from geogs.threads import on_one_torch_thread
from geogs.types import PoseCorrection
from geogs.world.loops import RelativePoses


@dataclass(frozen=True)
class ClosingQuestion:
    """What a closing is computed from; nothing in it changes any more."""

    ids: Sequence[int]
    """Of the keyframes, ascending."""
    T_cw: Float[Tensor, "n 4 4"]
    """Their poses, world to camera."""
    inverse_depths: Mapping[int, Float[Tensor, "p"]]
    """What they were; a depth that was replaced since is not taken over."""
    relative: RelativePoses
    """Between places in ``ids``."""
    matches: MatchedEdges | None
    fixed: int
    """Keyframes at the beginning that stay as they are."""
    is_metric: bool

    @on_one_torch_thread
    def answer(self) -> LoopClosure | None:
        """The closing, for any thread; None if no loop is believed."""
        return close_loops(
            self.ids, self.T_cw, self.relative, self.matches, None, self.fixed, self.is_metric
        )


def brought_forward(
    correction: PoseCorrection, T_cw: Mapping[int, Float[Tensor, "4 4"]]
) -> PoseCorrection:
    """The correction of keyframes as they are now, of one of keyframes as they were.

    ``T_cw`` has the present poses, by id. With T the pose before and S the similarity after, world
    to camera in the keyframe's unit of before, a correction moves what a keyframe shows by
    S^-1 T. A keyframe that has been adjusted meanwhile moves by the same, S' = T' T^-1 S; one that
    came later by that of the last one before it. Who is gone is left out.
    """
    known, reference = sorted(correction.before), 0
    after, scale = {}, {}
    for id, now in sorted(T_cw.items()):
        while reference + 1 < len(known) and known[reference + 1] <= id:
            reference += 1
        of = known[reference]
        before, s = correction.before[of], correction.scale[of]
        scale[id] = s
        if torch.equal(now, before):
            after[id] = correction.after[of]
            continue
        since = now @ se3_inverse(before)
        since[:3, 3] /= s  # S' / s, as after is S / s
        after[id] = since @ correction.after[of]
    return PoseCorrection(dict(T_cw), after, scale)
