"""The selected images of a source, by their numbers."""

from dataclasses import dataclass

from geogs.config import InputConfig
from geogs.config.setting import seconds_of
from geogs.errors import InputError


@dataclass(frozen=True, slots=True)
class Selection:
    """Images ``start, start + stride, ...`` before ``stop``; none reads to the end."""

    start: int
    stop: int | None
    stride: int


def selection_of(config: InputConfig, fps: float | None) -> Selection:
    """The selection of the settings; times become frames by the nominal rate.

    Args:
        config: the settings.
        fps: frames per second; none where images have no times.

    Raises:
        InputError: a time is given where images have none, or nothing is between start and stop.
    """
    start = _frame(config.start, fps)
    stop = None if config.stop is None else _frame(config.stop, fps)
    if stop is not None and stop <= start:
        raise InputError(
            f"stop is {config.stop}, frame {stop}, but must be after start, frame {start}."
        )
    return Selection(start, stop, config.stride)


def _frame(place: int | str, fps: float | None) -> int:
    if isinstance(place, int):
        return place
    seconds = seconds_of(place)
    assert seconds is not None, "checked when the settings were made"
    if fps is None:
        raise InputError(f"{place} is a time, and these images have none; give their numbers.")
    return round(seconds * fps)
