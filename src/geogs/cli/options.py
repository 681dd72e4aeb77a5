"""Command-line options from a dataclass, for every sub-command alike.

Settings are read, checked and explained from their types alone (:mod:`geogs.config.setting`).
Nested dataclasses become dotted options (``--input.stride 2``); hyphens and underscores are the
same; a switch ``--depth`` has a ``--no-depth``; numbers of a tuple have commas between them, and an
option that is a tuple of texts can be repeated.
"""

import difflib
import inspect
import shutil
import sys
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from geogs.config.leaves import Leaf, default_of, default_text, leaves
from geogs.config.setting import Basic, Positional, Time, dashed, group_of, refusal
from geogs.errors import InputError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Options = TypeVar("Options")
Record = TypeVar("Record", bound="DataclassInstance")
Given = Mapping[str, str]
"""What the arguments say, by the dotted name of the option; switches say on or off."""

_METAVARS = {int: "N", float: "X", str: "TEXT", Path: "PATH"}
_COLUMN = 28


def parse_options(
    options: type[Options],
    argv: Sequence[str],
    command: str,
    default: Callable[[Given], Options] | None = None,
) -> Options:
    """Make ``options`` from arguments.

    Args:
        options: the dataclass; its docstring and those of its fields are the help.
        argv: arguments after the name of the sub-command.
        command: the name of the sub-command.
        default: makes the options that hold where nothing is given, from what is given.

    Raises:
        InputError: an option is unknown, wrong or missing.
        SystemExit: with 0 after ``--help``, with 2 where there are no arguments but some needed.
    """
    known = leaves(options, command)
    everything = "--help-all" in argv
    if everything or "--help" in argv or "-h" in argv:
        print(help_text(options, command, everything))
        raise SystemExit(0)
    places = [(leaf, mark) for leaf in known if (mark := leaf.mark(Positional)) is not None]
    if not argv and any(mark.required for _, mark in places):
        print(help_text(options, command, everything=False), file=sys.stderr)
        raise SystemExit(2)
    words, given = _named(known, argv, command)
    for leaf, mark in places:
        taken = len(words) if leaf.kind.is_tuple else 1
        if words:
            given[leaf.name], words = words[:taken], words[taken:]
        elif mark.required and leaf.name not in given and mark.unless not in given:
            raise InputError(f"geogs {command} needs {leaf.name.upper()}: {_lower(leaf.help)}")
    if words:
        raise InputError(f"geogs {command} cannot do anything with {words[0]}.")
    values = {leaf.path: _value(leaf, given[leaf.name]) for leaf in known if leaf.name in given}
    texts = {name: some[-1] for name, some in given.items()}
    made: Options = _made(options, default(texts) if default else None, values, ())
    return made


def record(kind: type[Record], options: Record) -> Record:
    """The plain record that options of a command are more than."""
    return kind(**{f.name: getattr(options, f.name) for f in fields(kind)})


def help_text(options: type, command: str, everything: bool) -> str:
    """The help of a command: all of its options, or those that most need."""
    width = min(100, shutil.get_terminal_size().columns)
    known = leaves(options, command)
    places = [leaf for leaf in known if leaf.mark(Positional) is not None]
    usage = [_place(leaf) for leaf in places]
    groups: dict[str, list[Leaf]] = {"": []}
    for leaf in known:
        if leaf not in places and (everything or not leaf.group or leaf.mark(Basic) is not None):
            groups.setdefault(leaf.group, []).append(leaf)
    lines = [" ".join(["usage: geogs", command, *usage, "[OPTIONS]"]), ""]
    lines += [inspect.cleandoc(options.__doc__ or "").replace("``", ""), ""]
    lines += [line for leaf in places for line in _entry(leaf.name.upper(), leaf.help, width)]
    for group, some in groups.items():
        lines += ["", f"{group or 'options'}:"]
        lines += [line for leaf in some for line in _entry(_head(leaf), _explained(leaf), width)]
    shown = sum(map(len, groups.values()))
    if shown + len(places) < len(known):
        more = f"geogs {command} --help-all shows all {len(known)} options."
        lines += ["", more]
    return "\n".join(lines)


def _named(
    known: Sequence[Leaf], argv: Sequence[str], command: str
) -> tuple[list[str], dict[str, list[str]]]:
    """Words that belong to no option, and those that do by the dotted name of the option."""
    names = {name: leaf for leaf in known for name in _names(leaf)}
    switches = {
        name: (leaf, text)
        for leaf in known
        if leaf.kind.base is bool
        for text, name in (("on", _names(leaf)[0]), ("off", _off(leaf)))
    }
    loose: list[str] = []
    given: dict[str, list[str]] = {}
    words = iter(argv)
    for word in words:
        name, equals, text = word.partition("=")
        name = dashed(name)
        if word == "--":
            loose += words
        elif not word.startswith("-") or word == "-":
            loose.append(word)
        elif name in switches and not equals:
            leaf, text = switches[name]
            given[leaf.name] = [text]
        elif name in names and name not in switches:
            value = text if equals else next(words, None)
            if value is None or dashed(value) in names:
                raise InputError(f"{name} needs a value: {names[name].kind}.")
            given.setdefault(names[name].name, []).append(value)
        else:
            near = difflib.get_close_matches(name, [*names, *switches], n=1)
            hint = f"did you mean {near[0]}?" if near else f"see geogs {command} --help-all."
            raise InputError(f"geogs {command} has no option {word}; {hint}")
    return loose, given


def _value(leaf: Leaf, texts: list[str]) -> object:
    """The value that an option was given. Raises InputError if it cannot have that."""
    kind = leaf.kind
    if kind.base is bool:
        return texts[-1] == "on"
    several = kind.is_tuple and (kind.base is str or leaf.mark(Positional) is not None)
    value = tuple(kind.base(text) for text in texts) if several else kind.read(texts[-1])
    if not kind.allows(value):
        raise InputError(refusal(leaf.name, value, kind))
    return value


def _made(
    options: type, default: Any, values: Mapping[tuple[str, ...], object], path: tuple[str, ...]
) -> Any:
    """An instance with some values of its settings, by their paths; the others are the default's.

    Every group is made once, with all of its values.
    """
    changed: dict[str, Any] = {}
    for field in fields(options):
        at, inner = (*path, field.name), group_of(field.type)
        if inner is not None and any(p[: len(at)] == at for p in values):
            own = default_of(field) if default is None else getattr(default, field.name)
            changed[field.name] = _made(inner, None if own is MISSING else own, values, at)
        elif at in values:
            changed[field.name] = values[at]
    return options(**changed) if default is None else replace(default, **changed)


def _names(leaf: Leaf) -> list[str]:
    """Names of an option; the full one comes first."""
    mark = leaf.mark(Basic)
    short = [mark.name] if mark is not None and mark.name else []
    return [] if leaf.mark(Positional) is not None else [f"--{leaf.name}", *short]


def _off(leaf: Leaf) -> str:
    group = f"{leaf.group}." if leaf.group else ""
    return f"--{group}no-{dashed(leaf.path[-1])}"


def _place(leaf: Leaf) -> str:
    name = leaf.name.upper() + ("..." if leaf.kind.is_tuple else "")
    return name if leaf.mark(Positional).required else f"[{name}]"


def _head(leaf: Leaf) -> str:
    """Names of an option and what its value is."""
    kind = leaf.kind
    if kind.base is bool:
        return _off(leaf).replace("no-", "[no-]", 1)
    value = ",".join(kind.choices) if kind.choices else _METAVARS[kind.base]
    value = "TIME" if Time in kind.marks else value
    return f"{', '.join(reversed(_names(leaf)))} {value}"


def _explained(leaf: Leaf) -> str:
    """The help of an option with its default and its range."""
    ranges = " and ".join(map(str, leaf.kind.ranges))
    beside = "; ".join(text for text in (default_text(leaf), ranges) if text)
    return leaf.help + (f" ({beside})" if beside else "")


def _entry(head: str, text: str, width: int) -> list[str]:
    """Lines with an option to the left and its help to the right."""
    lines = textwrap.wrap(text.replace("``", ""), max(width - _COLUMN, 40)) or [""]
    first = [] if len(head) + 4 <= _COLUMN else [f"  {head}"]
    if not first:
        lines[0] = f"  {head}".ljust(_COLUMN) + lines[0]
    rest = lines[0:] if first else lines[1:]
    return [*(first or lines[:1]), *(" " * _COLUMN + line for line in rest)]


def _lower(sentence: str) -> str:
    return sentence[:1].lower() + sentence[1:]
