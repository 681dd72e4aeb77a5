"""Tracking of earlier frames once a map is started: backwards, then forwards."""

from typing import Any

from jaxtyping import Float64
from torch import Tensor

from geogs.geometry.lie import se3_inverse
from geogs.tracking.frames.rotation_averaging import orientations
from geogs.tracking.graph.rigid_parts import largest_part
from geogs.tracking.keyframes.keyframe_choice import calls_for_keyframe
from geogs.tracking.local_mapping import LocalMapping
from geogs.tracking.locate.frame_locator import FrameLocator, FrameMotion, with_depth
from geogs.tracking.locate.localiser import visible_keyframes
from geogs.world.keyframes import KeyframeSet

MIN_SHARED = 0.5
"""Least shared fraction of the cells for a rigid connection of two edges (:func:`largest_part`):
more than for a start, as these keyframes are dispensable."""


def track_from_start(local: LocalMapping, locator: FrameLocator) -> None:
    """Locate the frames without pose by the keyframes of a start: those before its last keyframe,
    latest first, then those after it.

    The initial guess is the known position nearest in time, with the orientation from relative
    rotations; their errors are correlated while the camera rotates and add up, over a full
    rotation, to more than flow can bridge. Keyframes of failed attempts become keyframes again if
    far enough from the others: else all these frames would depend on a keyframe that sees them at
    its border, and parts of the scene would have no depth. Drop those that are not rigidly
    connected.
    """
    recorder, keyframes = local.map.recorder, local.keyframes
    waiting = recorder.unplaced()
    if not waiting:
        return
    rotations = {r.index: r.rotations for r in recorder.log.records}
    placed = {k.frame_index: k.T_cw for k in keyframes}
    # The earliest of the frames anchored to a dropped keyframe was that keyframe itself.
    given_up = {r.anchor: r for r in reversed(waiting) if r.anchor is not None}
    last, extended = max(placed), list[int]()
    for record in sorted(waiting, key=lambda r: (r.index > last, abs(r.index - last))):
        guess = placed[min(placed, key=lambda index: abs(index - record.index))]
        R = orientations(rotations, {n: T[:3, :3] for n, T in placed.items()}).get(record.index)
        guess = guess if R is None else _turned(guess, R)
        was, record.anchor = record.anchor, None
        motion = _located(keyframes, locator, record.index, recorder.encoded(record), guess)
        if motion is None:
            continue
        placed[record.index] = motion.T_cw
        known = [k.frame_index for k in keyframes]
        is_outside = not known[0] <= record.index <= known[-1]
        if was is not None and given_up[was] is record and is_outside and _is_far(local, motion):
            local.extend(record, was, motion)
            extended.append(was)
        else:
            T_rel = motion.T_cw @ se3_inverse(keyframes[motion.keyframe].T_cw)
            recorder.place(record, motion.keyframe, T_rel, motion.match)
    if extended:
        held = largest_part(keyframes, local.graph.edges, MIN_SHARED)
        local.map.forget([k for k in extended if k not in held])


def _is_far(local: LocalMapping, motion: FrameMotion) -> bool:
    """Whether a frame is far enough from the keyframe it was located at to become one."""
    return calls_for_keyframe(local.config, local.keyframes.grid, motion.seen)


def _located(
    keyframes: KeyframeSet,
    locator: FrameLocator,
    index: int,
    encoded: Any,
    guess: Float64[Tensor, "4 4"],
) -> FrameMotion | None:
    """Locate a frame at the keyframe nearest in time, or those that share most with the guess."""
    candidates = list(keyframes)
    nearest = min(candidates, key=lambda k: abs(k.frame_index - index))
    for keyframe in dict.fromkeys((nearest, *visible_keyframes(candidates, guess))):
        motion = with_depth(locator.locate(keyframe, encoded, guess, is_expected=False))
        if motion is not None:
            return motion
    return None


def _turned(T_cw: Float64[Tensor, "4 4"], R: Float64[Tensor, "3 3"]) -> Float64[Tensor, "4 4"]:
    """Return the pose with the same camera centre and another orientation."""
    turned = T_cw.clone()
    turned[:3, :3], turned[:3, 3] = R, R @ T_cw[:3, :3].mT @ T_cw[:3, 3]
    return turned
