"""Text for the terminal and for logs: whatever files and servers say is escaped in it."""

import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import logging


def printable(text: object) -> str:
    """Replace control characters but tabs, line breaks and marks of direction by their escapes."""
    return "".join(c if c.isprintable() or c == "\t" else ascii(c)[1:-1] for c in str(text))


def say(*lines: object, is_error: bool = False) -> None:
    """Print lines, each :func:`printable`, to the standard output or the standard error."""
    file = sys.stderr if is_error else sys.stdout
    print("\n".join(map(printable, lines)), file=file, flush=True)


def escape_records(handler: "logging.Handler") -> None:
    """Let a handler write each record as one :func:`printable` line."""
    usual = handler.format
    handler.format = lambda record: printable(usual(record))  # type: ignore[method-assign]
