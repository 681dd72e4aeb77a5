"""Times as options give them: ``90``, ``90s``, ``10m`` or ``1.5h``."""

import re
from typing import Annotated

import tyro

from geogs.errors import InputError

_SECONDS = {"": 1.0, "s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0}


def seconds(text: str, what: str = "budget") -> float:
    """Seconds of a duration.

    Raises:
        InputError: it is none, or not above zero.
    """
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*(s|m|min|h)?\s*", text)
    value = float(match[1]) * _SECONDS[match[2] or ""] if match else 0.0
    if value <= 0:
        raise InputError(f"the {what} {text!r} is no duration; give one such as 90s, 10m or 1h.")
    return value


def several_seconds(text: str, what: str = "time") -> tuple[float, ...]:
    """Seconds of durations with commas between. Raises InputError as for one."""
    return tuple(seconds(part, what) for part in text.split(",") if part.strip())


Duration = Annotated[
    float | None,
    tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar="TIME",
        instance_from_str=lambda words: seconds(words[0]),
        is_instance=lambda value: value is None or isinstance(value, float),
        str_from_instance=lambda value: ["none" if value is None else f"{value:g}s"],
    ),
]
"""Type of an option that is one, or is not given."""

Durations = Annotated[
    tuple[float, ...],
    tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar="TIME,...",
        instance_from_str=lambda words: several_seconds(words[0]),
        is_instance=lambda value: isinstance(value, tuple),
        str_from_instance=lambda value: [",".join(f"{time:g}s" for time in value) or "none"],
    ),
]
"""Type of an option that is several, or none."""
