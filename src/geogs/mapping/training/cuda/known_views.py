"""Keyframes of the losses on a GPU."""

from collections.abc import Sequence
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.losses.cuda.view_table import ViewTable
from geogs.losses.single_view import ViewConstants
from geogs.mapping.keyframe_views import MapView
from geogs.mapping.view_arrays import MapCameras
from geogs.world.lru import LruCache


class KnownViews:
    """The keyframes' images, constants and poses on the GPU, brought up to date on demand.

    At most ``resident`` of them, unless more are requested at once. The least recently used loses
    its slot, and with it its rendered depth.
    """

    def __init__(self, cameras: MapCameras, device: torch.device, resident: int) -> None:
        self.table = ViewTable(cameras.render, cameras.photo, device)
        self._slots: LruCache[int, int] = LruCache(resident, self._free)
        self._unused: list[int] = []
        """Slots given away."""
        self._constants: dict[int, ViewConstants] = {}
        self._poses: dict[int, Tensor] = {}

    def slots(self, views: Sequence[MapView]) -> list[int]:
        """The table's slots of some views, with their present constants and poses."""
        moved = {}
        slots = []
        wanted = {view.id for view in views}
        for view in views:
            constants = view.constants
            is_new = view.id not in self._slots
            slot = self._slots.get(view.id, partial(self._new_slot, view), wanted)
            if not is_new and self._constants[view.id] is not constants:
                self.table.set_constants(slot, constants)
            slots.append(slot)
            self._constants[view.id] = constants
            if self._poses.get(view.id) is not view.T_cw:
                moved[view.id] = view.T_cw
        if moved:
            self.set_poses(list(moved), torch.stack(list(moved.values())))
            self._poses.update(moved)
        return slots

    def _new_slot(self, view: MapView) -> int:
        """Put the view into a free slot and return the slot."""
        if not self._unused:
            return self.table.add(view.constants, view.photo)
        slot = self._unused.pop()
        self.table.replace(slot, view.constants, view.photo)
        return slot

    def _free(self, id: int, slot: int) -> None:
        del self._constants[id]
        self._poses.pop(id, None)
        self._unused.append(slot)

    def set_poses(self, ids: Sequence[int], T_cw: Float[Tensor, "k 4 4"]) -> None:
        """Set poses that count until ``slots`` is called again."""
        slots = [slot for i in ids if (slot := self._slots.peek(i)) is not None]
        self.table.set_poses(slots, T_cw)
        for i in ids:
            self._poses.pop(i, None)
