"""How a damaged example is read: to values or a sentence, and within a time."""

import signal
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import jaxtyping

from geogs.errors import GeogsError
from parsers.base import Parser

SECONDS = 20
"""Of computing; a parser may last ten times as long on a machine that has much else to do."""


class Hangs(BaseException):
    """A parser took too long; no ``except Exception`` takes it for something else."""


@contextmanager
def in_time() -> Iterator[None]:
    def ring(*_: object) -> None:
        raise Hangs

    numbers = (signal.SIGPROF, signal.SIGALRM)
    before = [signal.signal(number, ring) for number in numbers]
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    signal.alarm(10 * SECONDS)  # who waits computes nothing, nor does who gets no processor
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.alarm(0)
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


def read(parser: Parser, folder: Path) -> None:
    """Read a damaged example; what leaves the parser is a sentence, or nothing does."""
    with in_time(), warnings.catch_warnings(action="ignore"):
        try:
            parser.read(folder)
        except Exception as error:
            refusal = refusal_in(error)
            if refusal is None:
                raise
            text = str(refusal)
            assert text.endswith((".", "?")), text
            assert text.isprintable(), text
            assert len(text) < 800, text


def refusal_in(error: BaseException) -> GeogsError | None:
    """The refusal that an error is, or that the tests' type checks met in a sequence.

    They look into what is made on demand, and call it of the wrong type where it is refused.
    """
    met: BaseException | None = error
    if isinstance(error, jaxtyping.TypeCheckError):
        while met is not None and not isinstance(met, GeogsError):
            met = met.__cause__ or met.__context__
    return met if isinstance(met, GeogsError) else None
