"""Sequences too large for the memory: an element exists only while it is referenced."""

from collections.abc import Callable, Sequence
from typing import Generic, SupportsIndex, TypeVar, overload

S = TypeVar("S")
V = TypeVar("V")


class OnDemand(Sequence[V], Generic[S, V]):
    """A sequence whose elements are made on each access.

    Element ``i`` is ``make(items[i])``. Nothing is cached, so a loop over the sequence has one
    element in memory at a time. A slice makes nothing yet.
    """

    def __init__(self, items: Sequence[S], make: Callable[[S], V]) -> None:
        self._items = items
        self._make = make

    def __repr__(self) -> str:
        return f"OnDemand({len(self)} elements)"

    def __len__(self) -> int:
        return len(self._items)

    @overload
    def __getitem__(self, index: SupportsIndex) -> V: ...
    @overload
    def __getitem__(self, index: slice) -> "OnDemand[S, V]": ...
    def __getitem__(self, index: SupportsIndex | slice) -> "V | OnDemand[S, V]":
        if isinstance(index, slice):
            return OnDemand(self._items[index], self._make)
        return self._make(self._items[index.__index__()])
