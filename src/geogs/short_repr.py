"""One-line representation of records: arrays by their shape."""

from dataclasses import fields
from typing import Any, ClassVar


class ShortRepr:
    """Shows a dataclass, declared with ``repr=False``, with the shape of each array in it."""

    __slots__ = ()
    __dataclass_fields__: ClassVar[dict[str, Any]]

    def __repr__(self) -> str:
        parts = (f"{f.name}={_short(getattr(self, f.name))}" for f in fields(self) if f.repr)
        return f"{type(self).__name__}({', '.join(parts)})"


def _short(value: object) -> str:
    shape = getattr(value, "shape", None)
    return repr(value) if shape is None else "×".join(map(str, shape)) or str(value)
