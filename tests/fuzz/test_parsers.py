"""Whatever is in a file, its parser gives values or a sentence, and never hangs.

``make fuzz`` tries many more than the few of a normal run.
"""

import os
import signal
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import jaxtyping
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from geogs.errors import GeogsError
from parsers import Parser, parsers

EXAMPLES = int(os.environ.get("GEOGS_FUZZ", 0)) or 4
SECONDS = 20
"""Of computing; a parser may last ten times as long on a machine that has much else to do."""
CORPUS = Path(__file__).parents[1] / "corpus"
PARSERS = parsers()


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


Example = tuple[Path, dict[str, bytes]]


@pytest.fixture(scope="module")
def example(tmp_path_factory) -> Callable[[str], Example]:
    """The folder of the good example of a parser, and what its files hold."""

    @cache
    def written(name: str) -> Example:
        folder, parser = tmp_path_factory.mktemp(name), PARSERS[name]
        parser.write(folder)
        parser.read(folder)  # kernels are compiled, which takes its time
        return folder, {file: (folder / file).read_bytes() for file in parser.files}

    return written


@pytest.mark.parametrize("name", PARSERS)
def test_the_good_example_is_read(name, example):
    PARSERS[name].read(example(name)[0])


@pytest.mark.parametrize("name", PARSERS)
def test_damaged_files_are_read_or_refused_in_a_sentence(name, example):
    parser, (folder, good) = PARSERS[name], example(name)

    @settings(
        max_examples=EXAMPLES, deadline=None, database=None, derandomize=EXAMPLES < 100,
        phases=[Phase.generate, Phase.shrink], suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(st.data())
    def damage_and_read(data: st.DataObject) -> None:
        file = data.draw(st.sampled_from(parser.files))
        (folder / file).write_bytes(data.draw(parser.damage(good[file])))
        try:
            read(parser, folder)
        finally:
            (folder / file).write_bytes(good[file])

    damage_and_read()


@pytest.mark.parametrize("name", sorted(path.name for path in CORPUS.iterdir()))
def test_files_that_once_led_to_something_else(name, example):
    parser, (folder, good) = PARSERS[name], example(name)
    for case in sorted((CORPUS / name).iterdir()):
        file = next(file for file in good if Path(file).suffix == case.suffix)
        (folder / file).write_bytes(case.read_bytes())
        try:
            read(parser, folder)
        finally:
            (folder / file).write_bytes(good[file])
