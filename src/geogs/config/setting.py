"""Kinds of settings: kind and range stand in the type of each and are checked when it is made.

    @dataclass(frozen=True)
    class SweepConfig(Settings, group="mapping.sweep"):
        planes: Annotated[int, Range(2, 256), Basic()] = 72

The type says all there is to say of a setting; the command line, its help and the documentation
are made from it.
"""

import functools
import math
import reprlib
import types
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from numbers import Integral, Real
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Union, get_args, get_origin

from geogs.errors import InputError

# Seconds of the units of a time.
_SECONDS = {"s": 1.0, "min": 60.0, "m": 60.0, "h": 3600.0}

Bound = float | str
"""A number, or the name of another setting of the group."""


@dataclass(frozen=True)
class Range:
    """Numbers from ``least`` to ``most``, or ``above`` and ``below`` what does not belong to them.

    A setting that a bound names is declared before the one that is bounded.
    """

    least: Bound | None = None
    most: Bound | None = None
    above: Bound | None = None
    below: Bound | None = None
    odd: bool = False
    or_zero: bool = False
    """0 is allowed, too."""

    @property
    def bounds(self) -> tuple[Bound | None, ...]:
        """All four."""
        return self.least, self.most, self.above, self.below

    def holds(self, value: float, group: object = None) -> bool:
        """Whether a finite number lies in the range, given the other settings of its group.

        Without a group, bounds by other settings are not looked at.
        """
        least, most, above, below = (
            _number(getattr(group, bound, None)) if isinstance(bound, str) else bound
            for bound in self.bounds
        )
        return (self.or_zero and value == 0) or (
            (least is None or value >= least)
            and (most is None or value <= most)
            and (above is None or value > above)
            and (below is None or value < below)
            and not (self.odd and value % 2 != 1)
        )

    def partners(self) -> tuple[str, ...]:
        """Names of the settings that the bounds refer to."""
        return tuple(bound for bound in self.bounds if isinstance(bound, str))

    def __str__(self) -> str:
        """In words: ``from 1 to 8``, ``above 0 and at most 1``, ``from 3 to 15 and odd``."""
        words = {"above": self.above, "at least": self.least, "below": self.below}
        words |= {"at most": self.most}
        if self.least is not None and self.most is not None:
            words = {"from": self.least, "to": self.most}
        parts = [f"{word} {_shown(bound)}" for word, bound in words.items() if bound is not None]
        text = (" " if "from" in words else " and ").join(parts)
        text = f"{text} and odd" if self.odd else text
        return f"0 or {text}" if self.or_zero else text


@dataclass(frozen=True)
class Basic:
    """A setting with a shorter name, or one that ``--help`` shows or hides unlike its group.

    ``--help-all`` shows every setting, ``--help`` those at the top and these.
    """

    name: str = ""
    """A shorter name on the command line, such as ``--stride`` or ``-o``."""
    is_common: bool = True
    """Whether ``--help`` shows it."""


RARE = Basic(is_common=False)
"""Mark of a setting at the top that only ``--help-all`` shows."""


@dataclass(frozen=True)
class Only:
    """A setting that other commands than this one do not heed, and do not offer.

    No command offers those for ``python``, which presets and programs set.
    """

    command: Literal["run", "reconstruct", "python"]


@dataclass(frozen=True)
class Positional:
    """An option that is given without its name, in the order of the fields."""

    required: bool = True
    unless: tuple[str, ...] = ()
    """Options with which it may be left out all the same."""


@dataclass(frozen=True)
class NamesFile:
    """A text that may be the name of a file, where it is none of these words."""

    words: tuple[str, ...] = ()


@dataclass(frozen=True)
class Formerly:
    """Words of the command line by which an option went in the last version, each with the new one.

    A word may have a value after it: ``--poses auto``. They go with the next version.
    """

    words: Mapping[str, str]


class Time:
    """Seconds that an option may give as ``90s``, ``10m`` or ``1.5h``, too."""


class Moment:
    """A frame by its number, or by its time in the source: ``90s``, ``1.5m``, ``1:30``."""


class Unnamed:
    """A group whose settings stand at the top of the command line, without its name."""


Fraction = Annotated[float, Range(0, 1)]
Angle = Annotated[float, Range(0, 180)]
"""Degrees."""
Weight = Annotated[float, Range(0, 1e6)]
Positive = Annotated[float, Range(1e-9, 1e6)]
"""A divisor: not so small that squares and single precision take it for 0."""
Count = Annotated[int, Range(1, 1_000_000)]
Port = Annotated[int, Range(1, 65535)]
CountOrZero = Annotated[int, Range(0, 1_000_000)]
"""0 does without."""


@dataclass(frozen=True)
class Kind:
    """Values that a setting takes."""

    base: type
    """bool, int, float, str or Path."""
    choices: tuple[str, ...] = ()
    is_optional: bool = False
    """Whether it can be none."""
    word: str = ""
    """Word that may stand instead of a number, such as auto."""
    is_tuple: bool = False
    """Whether it is any number of such values."""
    range: Range = Range()
    """Range of the numbers."""
    marks: tuple[object, ...] = ()
    """Other marks in the type, such as :class:`Basic`."""

    @staticmethod
    def of(annotation: Any, marks: tuple[object, ...] = ()) -> "Kind":
        """The kind that a type describes. Raises TypeError for one that no setting can have."""
        origin = get_origin(annotation)
        inner = get_args(annotation)
        if origin is Annotated:
            return Kind.of(inner[0], (*inner[1:], *marks))
        if any(isinstance(mark, Moment) for mark in marks) and annotation is not int:
            return replace(Kind.of(int, marks), is_optional=type(None) in inner)
        if origin in (Union, types.UnionType) and len(inner) == 2:
            instead = get_args(inner[1]) if get_origin(inner[1]) is Literal else ()
            if inner[1] is type(None):
                return replace(Kind.of(inner[0], marks), is_optional=True)
            if len(instead) == 1:
                return replace(Kind.of(inner[0], marks), word=instead[0])
        if origin is tuple and len(inner) == 2 and inner[1] is ...:
            return replace(Kind.of(inner[0], marks), is_tuple=True)
        bounds = next((mark for mark in marks if isinstance(mark, Range)), Range())
        marks = tuple(mark for mark in marks if not isinstance(mark, Range))
        if origin is Literal:
            return Kind(str, inner, marks=marks)
        if annotation not in (bool, int, float, str, Path):
            raise TypeError(f"no setting can be of the type {annotation}")
        return Kind(annotation, range=bounds, marks=marks)

    def allows(self, value: object, group: object = None) -> bool:
        """Whether a setting of this kind can be ``value``, given the others of its group.

        Without a group, bounds by other settings are not looked at.
        """
        if value is None:
            return self.is_optional
        if self.word and value == self.word:
            return True
        if self.is_tuple:
            return isinstance(value, tuple) and all(self._allows_one(v, group) for v in value)
        return self._allows_one(value, group)

    def read_each(self, texts: Sequence[str]) -> tuple[object, ...]:
        """The values that several texts mean; a text that means none comes back as it is."""
        return tuple(self._read_one(text) for text in texts)

    def read(self, text: str) -> Any:
        """The value that a text means; a text that means none comes back as it is."""
        if self.is_optional and text.lower() == "none":
            return None
        if self.word and text.lower() == self.word:
            return self.word
        if self.is_tuple and self.base is not str:
            return tuple(self._read_one(part) for part in text.split(",") if part)
        return self._read_one(text)

    def __str__(self) -> str:
        """In words: ``none or a number above 0``."""
        one, many = {
            bool: ("on or off", "switches"),
            int: ("a whole number", "whole numbers"),
            float: ("a number", "numbers"),
            str: ("a text", "texts"),
            Path: ("a path", "paths"),
        }[self.base]
        text = many if self.is_tuple else one
        if Time in self.marks:
            text += ", as seconds or such as 90s, 10m or 1h,"
        if str(self.range):
            text += f" {self.range}"
        text += ", or a time such as 90s or 1:30" if self._is_moment else ""
        if self.choices:
            text = " or ".join(self.choices)
        text = f"{self.word} or {text}" if self.word else text
        return f"none or {text}" if self.is_optional else text

    @property
    def _is_moment(self) -> bool:
        return any(isinstance(mark, Moment) for mark in self.marks)

    def _allows_one(self, value: object, group: object) -> bool:
        if self.choices:
            return value in self.choices
        if self._is_moment and isinstance(value, str):
            return seconds_of(value) is not None
        if self.base not in (int, float):
            return isinstance(value, self.base)
        number = Integral if self.base is int else Real
        if isinstance(value, bool) or not isinstance(value, number):
            return False
        finite = isinstance(value, Integral) or math.isfinite(value)
        return finite and self.range.holds(value, group)  # type: ignore[arg-type]

    def _read_one(self, text: str) -> object:
        if self.base is Path and not text:  # which Python takes for the working folder
            return text
        try:
            if Time in self.marks and (seconds := seconds_of(text)) is not None:
                return seconds
            return self.base(text)
        except ValueError:
            return text


def seconds_of(text: str) -> float | None:
    """The seconds of a time such as ``90s``, ``1.5m``, ``2h``, ``1:30`` or ``1:02:30``; none where
    it is none."""
    parts = text.split(":")
    unit = next((unit for unit in _SECONDS if text.endswith(unit)), "")
    try:
        if 2 <= len(parts) <= 3:
            hours, minutes = [0, *map(int, parts[:-1])][-2:]
            seconds = 3600.0 * hours + 60 * minutes + float(parts[-1])
        elif unit:
            seconds = _SECONDS[unit] * float(text.removesuffix(unit))
        else:
            return None
    except ValueError:
        return None
    return seconds if math.isfinite(seconds) and seconds >= 0 and "-" not in text else None


def _number(value: object) -> Any:
    """A bound by another setting; none where that is a time, which no number is compared with."""
    return None if isinstance(value, str) else value


class Settings:
    """A frozen dataclass of settings: each is checked when an instance is made.

    ``group`` is the dotted name that its settings have in front of their own.
    """

    group: ClassVar[str] = ""

    def __init_subclass__(cls, group: str | None = None) -> None:
        super().__init_subclass__()
        if group is not None:
            cls.group = group

    def __post_init__(self) -> None:
        """Raises InputError for a value that a setting cannot have."""
        for name, kind in kinds(type(self)):  # type: ignore[arg-type]
            value = getattr(self, name)
            if not kind.allows(value, self):
                at = f"{self.group}." if self.group else ""
                raise InputError(refusal(at + name, value, kind, self))


_SHORT = reprlib.Repr()
_SHORT.maxtuple = 16  # all that a setting has


def refusal(name: str, value: object, kind: Kind, group: object = None) -> str:
    """The sentence for a value that a setting cannot have."""
    partners = () if group is None else kind.range.partners()
    known = [f"{dashed(name)} is {getattr(group, name)}" for name in partners]
    beside = f" ({', '.join(known)})" if known else ""
    given = _SHORT.repr(value) if isinstance(value, str | int | tuple) else repr(value)
    return f"{dashed(name)} is {given}, but must be {kind}{beside}."


def dashed(name: str) -> str:
    """The name of a setting as the command line has it."""
    return name.replace("_", "-")


def group_of(annotation: Any) -> type | None:
    """The dataclass that the type of a field stands for; none if the field is a setting."""
    plain = get_args(annotation)[0] if get_origin(annotation) is Annotated else annotation
    return plain if isinstance(plain, type) and is_dataclass(plain) else None


@functools.cache
def kinds(settings: type) -> tuple[tuple[str, Kind], ...]:
    """Names and kinds of the settings of a dataclass, without its groups."""
    own = (f for f in fields(settings) if group_of(f.type) is None)  # type: ignore[arg-type]
    return tuple((f.name, Kind.of(f.type)) for f in own)


def _shown(bound: Bound) -> str:
    return dashed(bound) if isinstance(bound, str) else f"{bound:.15g}"
