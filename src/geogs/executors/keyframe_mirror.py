"""Copies of keyframes for another thread, each as it was when it was handed over."""

from collections.abc import Iterable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.world.keyframes import Keyframe, KeyframeTable

Handover = Sequence[tuple[Keyframe, Float[Tensor, "4 4"]]]
"""Copies of keyframes that have changed, and their poses."""


class KeyframeMirror:
    """A table that follows another, but is changed by nobody else than who asks it to.

    Fields of keyframes are replaced, never changed in place; so a copy of references is enough.
    """

    def __init__(self, keyframes: KeyframeTable) -> None:
        self._original = keyframes
        self.table = keyframes.mirror()
        """The copies, for the other thread."""
        self._copies = self.table.new_set()
        self._seen: dict[int, tuple[object, ...]] = {}
        """What each keyframe that is followed was at the last handover."""

    def follow(self, ids: Iterable[int]) -> None:
        """Copy these keyframes, too, from now on."""
        self._seen |= dict.fromkeys(ids, ())

    def changed(self) -> Handover:
        """Copies of the keyframes that are not what they were at the last call."""
        changed = []
        for id, before in self._seen.items():
            keyframe = self._original[id]
            now = _parts(keyframe)
            if len(before) != len(now) or any(a is not b for a, b in zip(now, before, strict=True)):
                self._seen[id] = now
                changed.append((keyframe.copied_to(self.table), keyframe.T_cw))
        return changed

    def update(self, changed: Handover, stream: "torch.cuda.Stream | None") -> None:
        """Take over what changed, in the other thread, which works in a ``stream`` of a GPU."""
        for keyframe, T_cw in changed:
            keyframe.T_cw = T_cw
            if keyframe.id in self._copies:
                vars(self._copies[keyframe.id]).update(vars(keyframe))
            else:
                self._copies.put(keyframe)
            for value in vars(keyframe).values():
                if stream is not None and isinstance(value, Tensor) and value.is_cuda:
                    value.record_stream(stream)


def _parts(keyframe: Keyframe) -> tuple[object, ...]:
    """All of a keyframe that is ever replaced."""
    k = keyframe
    return k.T_cw, k.inverse_depth, k.information, k.prior, k.scale, k.moving
