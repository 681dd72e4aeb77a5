"""Safe reading of untrusted text, JSON, XML and YAML files: plain, of bounded size, never executed.

No message about such a file repeats its content, so that nothing leaks from a file that was named
by mistake or by somebody else's list.
"""

import json
import os
import re
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, ParseError, fromstring

from geogs.errors import InputError
from geogs.guard.terminal_text import printable

LARGEST_TEXT = 1 << 30
"""Bytes of a table, such as the poses of a long sequence or the points of a COLMAP model."""
LARGEST_DOCUMENT = 1 << 26
"""Bytes of a JSON document, such as the poses of all images of a scene."""
LARGEST_SETTINGS = 1 << 17
"""Bytes of a YAML document, whose reader is slow: a calibration, settings, a card."""

_NUMBER = re.compile(r"(\d+)\.\w+")
"""Names of numbered files, padded with zeros or not."""
_LONGEST_MESSAGE = 200

UNUSABLE = (ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RecursionError)
"""Errors that invalid values in a document may cause."""


def expanded(path: str | Path) -> Path:
    """Expand ~ to the user's folder; unchanged where there is no such user."""
    try:
        return Path(os.path.expanduser(path))
    except ValueError:  # a zero byte in the name of a user
        return Path(path)


def read_bytes(path: str | Path, largest: int = LARGEST_TEXT) -> bytes:
    """Read a plain file; a pipe or a device is not waited for.

    Raises:
        InputError: it is missing, no plain file, too large, or cannot be read.
    """
    with open_file(path) as stream:
        size = os.fstat(stream.fileno()).st_size
        if size > largest:
            raise InputError(
                f"{path} has {size / 2**20:.0f} MiB, more than any such file; is it another one?"
            )
        return stream.read(size)


@contextmanager
def open_file(path: str | Path) -> Iterator[BufferedReader]:
    """Open a plain file for reading; a pipe or a device is not waited for.

    Raises:
        InputError: it is missing, no plain file, or cannot be read.
    """
    name = str(path)
    if "\0" in name:
        raise InputError("A file name with a zero byte in it cannot be that of a file.")
    try:
        os.fsencode(name)
    except UnicodeEncodeError:
        raise InputError("No file can have that name; it has broken characters.") from None
    try:
        with open(path, "rb", opener=_without_waiting) as stream:
            if not stat.S_ISREG(os.fstat(stream.fileno()).st_mode):
                raise InputError(f"{name} is no plain file; give one.")
            yield stream
    except FileNotFoundError:
        raise InputError(f"{name} does not exist; give a file that does.") from None
    except IsADirectoryError:
        raise InputError(f"{name} is a folder; give a file.") from None
    except OSError as error:
        raise InputError(f"{name} cannot be read ({error.strerror or error}).") from error


def require_file(path: str | Path) -> Path:
    """Check the path of a plain file, for a library that opens files by their names.

    Raises InputError as of ``open_file``.
    """
    with open_file(path):
        return Path(path)


def first_file(paths: Iterable[Path]) -> Path | None:
    """Return the first of some files that exists, or None."""
    return next((path for path in paths if path.is_file()), None)


def numbered(paths: Iterable[Path], pattern: re.Pattern[str] = _NUMBER) -> list[tuple[int, Path]]:
    """Sort files by the number that a pattern finds in their names."""
    matches = ((pattern.fullmatch(path.name), path) for path in paths)
    return sorted((int(match[1]), path) for match, path in matches if match)


def read_text(path: str | Path, largest: int = LARGEST_TEXT) -> str:
    """Read the text of a plain file in UTF-8, with or without a byte order mark.

    Raises:
        InputError: as of ``read_bytes``, or it is no text.
    """
    try:
        return read_bytes(path, largest).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(f"{path} is not a text file in UTF-8; is it another one?") from None


def read_json(path: str | Path, largest: int = LARGEST_DOCUMENT) -> Any:
    """Read a JSON file.

    Raises:
        InputError: as of ``read_text``, or it is damaged.
    """
    text = read_text(path, largest)
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        at = f" after line {error.lineno}" if isinstance(error, json.JSONDecodeError) else ""
        raise InputError(f"{path} is damaged or no JSON{at}; copy it again.") from None


def read_xml(path: str | Path) -> Element:
    """Read an XML file without definitions of entities, by which a few lines can mean billions.

    Raises:
        InputError: as of ``read_bytes``, or it is damaged.
    """
    data = read_bytes(path, LARGEST_DOCUMENT)
    try:
        # A zero byte is one of UTF-16, in which a definition would not be found.
        if any(mark in data for mark in (b"<!DOCTYPE", b"<!ENTITY", b"\0")):
            raise ParseError
        return fromstring(data)
    except (ParseError, ValueError, LookupError):
        raise InputError(f"{path} is damaged or no plain XML; copy it again.") from None


def read_yaml(path: str | Path) -> Any:
    """Read a YAML file of plain values, without program tags and aliases.

    Raises:
        InputError: as of ``read_text``, or it is damaged.
    """
    return yaml_value(read_text(path, LARGEST_SETTINGS), str(path))


def yaml_value(text: str, name: str) -> Any:
    """Parse a YAML text as ``read_yaml`` does; ``name`` is used in error messages."""
    import yaml

    class PlainLoader(yaml.SafeLoader):
        """Refuses aliases, by which a few lines can mean billions of values, and deep nesting.

        Time would grow with the square of the depth.
        """

        def fetch_more_tokens(self) -> Any:
            # Deepest nesting of groups.
            if self.flow_level + len(self.indents) > 50:
                raise yaml.YAMLError
            return super().fetch_more_tokens()

        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.AliasEvent):
                raise yaml.YAMLError
            return super().compose_node(parent, index)

    try:
        return yaml.load(text, PlainLoader)  # a safe loader
    except (yaml.YAMLError, *UNUSABLE) as error:
        mark = getattr(error, "problem_mark", None)
        at = f" at line {mark.line + 1}" if mark is not None else ""
        said = f"{name} is damaged or not YAML of plain values{at}; correct it."
        raise InputError(said) from None


def in_short(error: Exception | str) -> str:
    """Return the first line of an error's message, printable and of limited length."""
    said = (str(error).strip() or type(error).__name__).splitlines()[0]
    plain = printable(said)
    return plain if len(plain) <= _LONGEST_MESSAGE else f"{plain[:_LONGEST_MESSAGE]}..."


def whole_number(value: Any) -> int:
    """Convert a value of a document to a whole number. Raises ValueError if it is none."""
    number = float(value)
    if not (abs(number) < 2**53 and number == int(number)):
        raise ValueError("no whole number")
    return int(number)


def _without_waiting(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NONBLOCK | os.O_CLOEXEC)
