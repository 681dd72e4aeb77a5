"""Copies of keyframes for another thread, each in its state at the handover."""

from collections.abc import Iterable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.world.keyframes import Keyframe, KeyframeTable

Handover = Sequence[tuple[Keyframe, Float[Tensor, "4 4"]]]
"""Copies of keyframes that have changed, and their poses."""


class KeyframeMirror:
    """A copy of a table that changes only by :meth:`update`.

    Fields of keyframes are replaced, never changed in place; so a copy of references is enough.
    """

    def __init__(self, keyframes: KeyframeTable) -> None:
        self._original = keyframes
        self.table = keyframes.mirror()
        """The copies, for the other thread."""
        self._copies = self.table.new_set()
        self._seen: dict[int, tuple[object, ...]] = {}
        """State of each followed keyframe at the last handover."""

    def follow(self, ids: Iterable[int]) -> None:
        """Also copy these keyframes from now on."""
        self._seen |= dict.fromkeys(ids, ())

    def changed(self) -> Handover:
        """Copy the keyframes that have changed since the last call."""
        changed = []
        for id, before in self._seen.items():
            keyframe = self._original[id]
            now = _parts(keyframe)
            if len(before) != len(now) or any(a is not b for a, b in zip(now, before, strict=True)):
                self._seen[id] = now
                changed.append((keyframe.copied_to(self.table), keyframe.T_cw))
        return changed

    def update(self, changed: Handover, stream: "torch.cuda.Stream | None") -> None:
        """Apply the changes, in the other thread, which works in a ``stream`` of a GPU."""
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
    """Return all parts of a keyframe that are ever replaced."""
    k = keyframe
    return k.T_cw, k.inverse_depth, k.information, k.prior, k.scale, k.moving
