"""The keyframes that losses on a GPU know."""

from collections import OrderedDict
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.losses.cuda.view_table import ViewTable
from geogs.mapping.view import MapCameras, MapView


class KnownViews:
    """The keyframes' images, constants and poses on the GPU, brought up to date on demand.

    At most ``resident`` of them, unless more are asked for at once: the one not used for longest
    gives its slot away, and has to be rendered again before it hides anything.
    """

    def __init__(self, cameras: MapCameras, device: torch.device, resident: int) -> None:
        self.table = ViewTable(cameras.render, cameras.photo, device)
        self.resident = resident
        self._slots: OrderedDict[int, int] = OrderedDict()
        self._constants: dict[int, object] = {}
        self._poses: dict[int, Tensor] = {}

    def slots(self, views: Sequence[MapView]) -> list[int]:
        """The table's slots of some views, with their present constants and poses."""
        moved, wanted = {}, {view.id for view in views}
        for view in views:
            constants = view.constants
            if view.id not in self._slots:
                self._slots[view.id] = self._free_slot(view, wanted)
            elif constants is not None and self._constants[view.id] is not constants:
                self.table.set_constants(self._slots[view.id], constants)
            self._slots.move_to_end(view.id)
            self._constants[view.id] = constants
            if self._poses.get(view.id) is not view.T_cw:
                moved[view.id] = view.T_cw
        if moved:
            self.set_poses(list(moved), torch.stack(list(moved.values())))
            self._poses.update(moved)
        return [self._slots[view.id] for view in views]

    def _free_slot(self, view: MapView, wanted: set[int]) -> int:
        """A slot that now stands for the view."""
        gone = next((i for i in self._slots if i not in wanted), None)
        if len(self._slots) < self.resident or gone is None:
            return self.table.add(view.constants, view.photo)
        slot = self._slots.pop(gone)
        del self._constants[gone]
        self._poses.pop(gone, None)
        self.table.replace(slot, view.constants, view.photo)
        return slot

    def set_poses(self, ids: Sequence[int], T_cw: Float[Tensor, "k 4 4"]) -> None:
        """Poses to work with until ``slots`` is asked for again."""
        self.table.set_poses([self._slots[i] for i in ids], T_cw)
        for i in ids:
            self._poses.pop(i, None)
