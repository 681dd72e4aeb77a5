"""Command-line options from a dataclass, the same way for every sub-command.

Settings are read, checked and explained from their types alone (:mod:`geogs.config.setting`).
Nested dataclasses become dotted options (``--input.stride 2``); hyphens and underscores are the
same; a switch ``--depth`` has a ``--no-depth``; numbers of a tuple have commas between them, and an
option that is a tuple of texts can be repeated.
"""

import difflib
import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, fields, replace
from typing import Any, TypeVar

from geogs.cli.candidates import ASKED, candidates, matching
from geogs.cli.help import first_clause, help_text
from geogs.config.leaves import Leaf, default_of, former_words, leaves
from geogs.config.setting import Positional, dashed, group_of, refusal
from geogs.errors import InputError
from geogs.guard.terminal_text import say

_log = logging.getLogger(__name__)
Options = TypeVar("Options")
Record = TypeVar("Record")
Given = Mapping[str, str]
"""Given values as text, by the dotted name of the option; switches are on or off."""


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
        default: makes the default options, depending on the given ones.

    Raises:
        InputError: an option is unknown, wrong or missing.
        SystemExit: with 0 after ``--help`` and ``--complete``, with 2 where there are no arguments
            but some needed.
    """
    known = leaves(options, command)
    _say_what_is_asked(options, known, argv, command)
    words, given = _named(known, _renamed(known, argv), command)
    for leaf in known:
        if words and leaf.mark(Positional) is not None:
            taken = len(words) if leaf.kind.is_tuple else 1
            given[leaf.name] = words[:taken]
            words = words[taken:]
    if words:
        raise InputError(f"geogs {command} cannot do anything with {words[0]}.")
    missing = [leaf for leaf in known if leaf.name not in given and _is_needed(leaf, given)]
    if missing and not argv:
        say(*help_text(options, command, everything=False).splitlines(), is_error=True)
        raise SystemExit(2)
    if missing:
        name = (*missing[0].options, missing[0].name.upper())[0]
        what = first_clause(missing[0].help)
        raise InputError(f"geogs {command} needs {name}: {what[:1].lower()}{what[1:]}.")
    values = {leaf.path: _value(leaf, given[leaf.name]) for leaf in known if leaf.name in given}
    texts = {name: some[-1] for name, some in given.items()}
    made: Options = _made(options, default(texts) if default else None, values, ())
    return made


def record(kind: type[Record], options: object) -> Record:
    """The plain record within the options of a command."""
    return kind(**{f.name: getattr(options, f.name) for f in fields(kind)})  # type: ignore[arg-type]


def _say_what_is_asked(
    options: type, known: Sequence[Leaf], argv: Sequence[str], command: str
) -> None:
    """Print help or completions if they are requested; then SystemExit."""
    everything = "--help-all" in argv
    if argv and argv[-1] == ASKED:
        found = matching(candidates(known, argv[:-1]), argv[-2] if argv[:-1] else "")
        say(*found.splitlines())
    elif everything or "--help" in argv or "-h" in argv:
        say(*help_text(options, command, everything).splitlines())
    else:
        return
    raise SystemExit(0)


def _renamed(known: Sequence[Leaf], argv: Sequence[str]) -> Iterator[str]:
    """The arguments with new names for old ones, and a warning for each of these."""
    former = former_words(known)
    arguments = list(argv)
    while arguments:
        word = arguments.pop(0)
        if word == "--":
            yield from (word, *arguments)
            return
        name, equals, text = word.partition("=")
        name = dashed(name)
        pair = f"{name} {text if equals or not arguments else arguments[0]}"
        old = pair if pair in former else name
        if old == pair and not equals:
            arguments.pop(0)
        if old in former:
            _log.warning("%s is now %s; the old name goes in the next version.", old, former[old])
            word = former[old] if old == pair else former[old] + equals + text
        yield word


def _named(
    known: Sequence[Leaf], argv: Iterable[str], command: str
) -> tuple[list[str], dict[str, list[str]]]:
    """Positional words, and the values of options by their dotted names."""
    names = {name: leaf for leaf in known for name in leaf.options}
    switches = {
        name: (leaf, text)
        for leaf in known
        if leaf.kind.base is bool
        for text, name in (*(("on", name) for name in leaf.options), ("off", leaf.switch_off))
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


def _is_needed(leaf: Leaf, given: Mapping[str, object]) -> bool:
    mark = leaf.mark(Positional)
    if mark is None:
        return leaf.default is MISSING
    return mark.required and given.keys().isdisjoint(mark.unless)


def _value(leaf: Leaf, texts: list[str]) -> object:
    """Parse the value of an option. Raises InputError if it is not allowed."""
    kind = leaf.kind
    if kind.base is bool:
        return texts[-1] == "on"
    several = kind.is_tuple and (kind.base is str or leaf.mark(Positional) is not None)
    value = kind.read_each(texts) if several else kind.read(texts[-1])
    if not kind.allows(value):
        raise InputError(refusal(leaf.name, value, kind))
    return value


def _made(
    options: type, default: Any, values: Mapping[tuple[str, ...], object], path: tuple[str, ...]
) -> Any:
    """Make an instance with given values, by their paths; the others are the default's.

    Every group is made once, with all of its values.
    """
    changed: dict[str, Any] = {}
    for field in fields(options):
        at = (*path, field.name)
        inner = group_of(field.type)
        if inner is not None and any(p[: len(at)] == at for p in values):
            own = default_of(field) if default is None else getattr(default, field.name)
            changed[field.name] = _made(inner, None if own is MISSING else own, values, at)
        elif at in values:
            changed[field.name] = values[at]
    return options(**changed) if default is None else replace(default, **changed)
