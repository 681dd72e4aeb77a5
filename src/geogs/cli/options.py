"""Command-line options from a dataclass, for every sub-command alike."""

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Options = TypeVar("Options")
Record = TypeVar("Record", bound="DataclassInstance")

# Options so common that they may be given without the name of their group.
SHORT: Mapping[str, str] = {
    "--long-edge": "--input.long-edge",
    "--start": "--input.start",
    "--stop": "--input.stop",
    "--stride": "--input.stride",
    "-o": "--output",
}


def parse_options(
    options: type[Options],
    argv: Sequence[str],
    command: str,
    description: str | None = None,
    default: Options | None = None,
    short: Mapping[str, str] | None = None,
) -> Options:
    """Make ``options`` from arguments; its fields' docstrings are the help.

    Nested dataclasses become dotted options (``--input.stride 2``), hyphens and underscores are
    the same, a field of type ``tyro.conf.Positional`` needs no name.

    Args:
        options: the dataclass.
        argv: arguments after the name of the sub-command.
        command: the name of the sub-command.
        description: first lines of its help; the docstring of ``options`` if none.
        default: values other than the fields' defaults.
        short: other names of options.

    Raises:
        SystemExit: with 0 after ``--help``, with 2 after an option that is wrong or missing.
    """
    import tyro

    return tyro.cli(  # type: ignore[return-value]  # a default of none is no default
        options,
        args=[_expand(argument, short or {}) for argument in argv],
        prog=f"geogs {command}",
        description=description,
        default=default,
    )


def record(kind: type[Record], options: Record) -> Record:
    """The plain record that options of a command are more than."""
    return kind(**{f.name: getattr(options, f.name) for f in fields(kind)})


def given(argv: Sequence[str], name: str) -> str | None:
    """The value that arguments give an option, by which others' defaults are chosen; none if none.

    ``name`` is without hyphens; ``--name value`` and ``--name=value`` are the same.
    """
    for argument, following in zip(argv, [*argv[1:], ""], strict=True):
        option, equals, value = argument.partition("=")
        if option == f"--{name}":
            return value if equals else following
    return None


def _expand(argument: str, short: Mapping[str, str]) -> str:
    name, equals, value = argument.partition("=")
    return short.get(name, name) + equals + value
