"""What a command says at its end: sentences for people, or one JSON object for programs."""

import io
import json
import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path

from geogs.guard.terminal_text import say

JSON = "--json"
"""Option of every command: one JSON object on the standard output, in place of sentences."""
JSON_HELP = "Print one JSON object in place of text."
EXIT_NOT_RELIABLE = 3
"""Exit code after a result that is not reliable, by its own verdict."""


@dataclass(frozen=True)
class Answer:
    """The end of a command."""

    text: str
    """Sentences for the terminal."""
    values: Mapping[str, object] = field(default_factory=dict)
    """The same for a program, as values that JSON knows, and paths."""
    code: int = 0
    """Exit code."""


def shown(answer: Answer | int) -> int:
    """Print the sentences of an answer. Returns its exit code."""
    if isinstance(answer, int):
        return answer
    if answer.text:
        say(*answer.text.splitlines())
    return answer.code


def wants_json(arguments: Sequence[str]) -> bool:
    """Whether ``--json`` is among the arguments before a ``--``."""
    return JSON in _options(arguments)


def without_json(arguments: Sequence[str]) -> list[str]:
    """The arguments without ``--json``."""
    options = _options(arguments)
    return [*(word for word in options if word != JSON), *arguments[len(options) :]]


class Record:
    """Collects what a command says, for one JSON object."""

    def __init__(self) -> None:
        self._values: dict[str, object] = {}
        self._text = io.StringIO()
        self._warnings: list[str] = []

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Take what is printed and warned of in the block."""
        handler = _Listed(self._warnings)
        log = logging.getLogger("geogs")
        log.addHandler(handler)
        try:
            with redirect_stdout(self._text):
                yield
        finally:
            log.removeHandler(handler)

    def take(self, answer: Answer | int) -> int:
        """Take the end of a command. Returns its exit code."""
        if isinstance(answer, int):
            return answer
        self._values |= answer.values
        self._text.write(answer.text)
        return answer.code

    def fail(self, sentence: str) -> None:
        """Take the sentence of an error."""
        self._values["error"] = sentence

    def text(self, command: str, code: int) -> str:
        """The object, in one line."""
        own = self._values.pop("warnings", [])
        assert isinstance(own, list), "a list of sentences"
        warnings = list(dict.fromkeys([*self._warnings, *own]))
        lines = self._text.getvalue().splitlines()
        head = {"command": command, "exit_code": code, "warnings": warnings, "text": lines}
        return json.dumps(_plain({**head, **self._values}))


class _Listed(logging.Handler):
    """Keeps the sentences of warnings."""

    def __init__(self, sentences: list[str]) -> None:
        super().__init__(logging.WARNING)
        self._sentences = sentences

    def emit(self, record: logging.LogRecord) -> None:
        self._sentences.append(record.getMessage())


def _options(arguments: Sequence[str]) -> Sequence[str]:
    """The arguments before a ``--``."""
    end = arguments.index("--") if "--" in arguments else len(arguments)
    return arguments[:end]


def _plain(value: object) -> object:
    """A value as JSON knows it: none instead of infinity and NaN."""
    if isinstance(value, Mapping):
        return {str(name): _plain(inner) for name, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value) if isinstance(value, Path) else value
