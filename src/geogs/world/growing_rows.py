"""Tensors that grow and shrink by rows without moving."""

from jaxtyping import Int, Shaped
from torch import Tensor

_LEAST = 4096


class GrowingRows:
    """Rows in a larger tensor, so that appending rarely allocates and addresses stay valid.

    ``room`` is all of it, ``rows`` the part in use; both share memory.
    """

    def __init__(self, rows: Shaped[Tensor, "n *k"]) -> None:
        self.room = rows.detach().clone()
        self._count = len(rows)

    def __len__(self) -> int:
        return self._count

    @property
    def rows(self) -> Shaped[Tensor, "n *k"]:
        """The rows in use."""
        return self.room[: self._count]

    def append(self, rows: Shaped[Tensor, "m *k"]) -> None:
        """Append rows; the room doubles where it is too small."""
        count = self._count + len(rows)
        if count > len(self.room):
            self.reserve(max(count, 2 * len(self.room), _LEAST))
        self.room[self._count : count] = rows.detach()
        self._count = count

    def reserve(self, size: int) -> None:
        """Make room for ``size`` rows in total; new room is zero."""
        if size > len(self.room):
            room = self.room.new_zeros(size, *self.room.shape[1:])
            room[: self._count] = self.rows
            self.room = room

    def take(self, index: Int[Tensor, "m"], start: int = 0) -> None:
        """Keep the rows in ``index``, in its order; the first ``start`` of them are in place."""
        self.room[start : len(index)] = self.room[index[start:]]
        self._count = len(index)
