"""A cache of large values: those used last stay, others are evicted."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Collection, Hashable
from typing import Generic, TypeVar

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")


class LruCache(Generic[K, V]):
    """The values used last, at most ``limit`` of them; others are computed again when needed.

    ``leave`` is called with each evicted value, so that it can be stored or its memory reused.
    Thread-safe, if ``leave`` is; no lock is held while a value is computed.
    """

    def __init__(self, limit: int, leave: Callable[[K, V], object] | None = None) -> None:
        self.limit = limit
        self._leave = leave
        self._values: OrderedDict[K, V] = OrderedDict()
        self._lock = threading.RLock()

    def __len__(self) -> int:
        return len(self._values)

    def __contains__(self, key: K) -> bool:
        return key in self._values

    def peek(self, key: K) -> V | None:
        """Return the value of a key if it is cached; it does not count as used."""
        return self._values.get(key)

    def items(self) -> list[tuple[K, V]]:
        """Return all cached values, used last at the end."""
        with self._lock:
            return list(self._values.items())

    def get(self, key: K, make: Callable[[], V], wanted: Collection[K] = ()) -> V:
        """Return the value of a key, computed if not cached; keys in ``wanted`` are not evicted.

        There are more than ``limit`` values only if so many are wanted.
        """
        with self._lock:
            if key in self._values:
                self._values.move_to_end(key)
                return self._values[key]
        self._make_room(wanted)
        value = make()
        self.put(key, value, wanted)
        return value

    def put(self, key: K, value: V, wanted: Collection[K] = ()) -> None:
        """Cache a value as the one used last; the least recently used are evicted."""
        with self._lock:
            if key not in self._values:
                self._make_room(wanted)
            if self.limit > 0 or key in wanted:
                self._values[key] = value
                self._values.move_to_end(key)

    def drop(self, key: K) -> None:
        """Remove a value without calling ``leave``."""
        with self._lock:
            self._values.pop(key, None)

    def clear(self) -> None:
        """Remove all values without calling ``leave``."""
        with self._lock:
            self._values.clear()

    def _make_room(self, wanted: Collection[K]) -> None:
        with self._lock:
            going = (k for k in list(self._values) if k not in wanted)
            while len(self._values) >= max(self.limit, 1):
                key = next(going, None)
                if key is None:
                    return
                value = self._values.pop(key)
                if self._leave is not None:
                    self._leave(key, value)
