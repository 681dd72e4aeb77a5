"""Whatever is in a file, its parser gives values or a sentence, and never hangs.

``make fuzz`` tries many more than the few of a normal run, in a process of its own.
"""

import os
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from parsers import parsers
from parsers.child import Child
from parsers.hostile import hostile
from parsers.reading import read

EXAMPLES = int(os.environ.get("GEOGS_FUZZ", 0)) or 4
ARE_MANY = EXAMPLES >= 100
CORPUS = Path(__file__).parents[1] / "corpus"
PARSERS = parsers()

Read = Callable[[str, Path], None]
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


@pytest.fixture(scope="module")
def reads() -> Iterator[Read]:
    """What reads an example; of many one may end the process, which is then not this one."""
    if ARE_MANY:
        with Child() as child:
            yield child.read
    else:
        yield lambda name, folder: read(PARSERS[name], folder)


@pytest.mark.parametrize("name", PARSERS)
def test_the_good_example_is_read(name, example):
    PARSERS[name].read(example(name)[0])


@pytest.mark.parametrize("name", PARSERS)
def test_damaged_files_are_read_or_refused_in_a_sentence(name, example, reads):
    parser, (folder, good) = PARSERS[name], example(name)

    @settings(
        max_examples=EXAMPLES, deadline=None, database=None, derandomize=not ARE_MANY,
        phases=[Phase.generate, Phase.shrink], suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(st.data())
    def damage_and_read(data: st.DataObject) -> None:
        file = data.draw(st.sampled_from(parser.files))
        (folder / file).write_bytes(data.draw(parser.damage(good[file])))
        try:
            reads(name, folder)
        finally:
            (folder / file).write_bytes(good[file])

    damage_and_read()


@pytest.mark.parametrize("name", sorted(path.name for path in CORPUS.iterdir()))
def test_files_that_once_led_to_something_else(name, example, reads):
    folder, good = example(name)
    for case in sorted((CORPUS / name).iterdir()):
        file = next(file for file in good if Path(file).suffix == case.suffix)
        (folder / file).write_bytes(case.read_bytes())
        try:
            reads(name, folder)
        finally:
            (folder / file).write_bytes(good[file])


@pytest.mark.long
def test_what_a_parser_may_not_do_is_found_and_the_next_one_is_read():
    found = {
        "crashes": "crashes ended the process with -6", "floods": "floods took",
        "stumbles": "KeyError: 'stumbled'",
    }  # fmt: skip
    with Child(hostile, memory=1 << 30) as child:
        for name, words in found.items():
            with pytest.raises(AssertionError, match=words):
                child.read(name, CORPUS)
        child.read("reads", CORPUS)
    with Child(hostile, seconds=2) as child, pytest.raises(AssertionError, match="hangs hangs"):
        child.read("hangs", CORPUS)
