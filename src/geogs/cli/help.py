"""Text of ``--help`` and ``--help-all``, from the types and docstrings of the options."""

import inspect
import re
import shutil
import textwrap
from collections.abc import Sequence
from pathlib import Path

from geogs.cli.answer import JSON, JSON_HELP
from geogs.config.leaves import Leaf, default_text, leaves
from geogs.config.setting import Basic, Positional, Time

_METAVARS = {int: "N", float: "X", str: "TEXT", Path: "PATH"}
_COLUMN = 28
_MANY = 60
"""Number of options from which on the help of the common ones is brief."""


def help_text(options: type, command: str, everything: bool) -> str:
    """The help of a command: all of its options, or the common ones.

    Of a command with many options the common ones have a line each, without groups.
    """
    width = min(100, shutil.get_terminal_size().columns)
    known = leaves(options, command)
    is_brief = not everything and len(known) > _MANY
    places = [leaf for leaf in known if leaf.mark(Positional) is not None]
    usage = [_place(leaf) for leaf in places]
    groups: dict[str, list[Leaf]] = {"": []}
    for leaf in known:
        if leaf not in places and (everything or is_shown_first(leaf)):
            groups.setdefault("" if is_brief else leaf.group, []).append(leaf)
    lines = [" ".join(["usage: geogs", command, *usage, "[OPTIONS]"]), ""]
    lines += [inspect.cleandoc(options.__doc__ or "").replace("``", ""), ""]
    row = _brief_row if is_brief else _row
    lines += [line for leaf in places for line in _entry(*row(leaf), width)]
    for group, some in groups.items():
        lines += ["", f"{group or 'options'}:"]
        lines += [line for leaf in some for line in _entry(*row(leaf), width)]
        lines += [] if group else _entry(JSON, JSON_HELP, width)
    shown = sum(map(len, groups.values()))
    if shown + len(places) < len(known):
        more = f"geogs {command} --help-all shows all {len(known)} options."
        lines += ["", more]
    return "\n".join(lines)


def is_shown_first(leaf: Leaf) -> bool:
    """Whether ``--help`` shows an option, not only ``--help-all``."""
    basic: Basic | None = leaf.mark(Basic)
    return not leaf.group if basic is None else basic.is_common


def first_clause(text: str) -> str:
    """Part of a text before its first colon, semicolon or full stop."""
    return text[:1] + re.split(r"[:;]|\.(?=\s|$)", text[1:])[0]


def _place(leaf: Leaf) -> str:
    name = leaf.name.upper() + ("..." if leaf.kind.is_tuple else "")
    return name if leaf.mark(Positional).required else f"[{name}]"


def _row(leaf: Leaf) -> tuple[str, str]:
    """An option with all of its names, and its help with its default and its range."""
    if leaf.mark(Positional) is not None:
        return leaf.name.upper(), leaf.help
    names = [*reversed(leaf.options)]
    if leaf.kind.base is bool:
        names[-1] = leaf.switch_off.replace("no-", "[no-]", 1)
    return _head(leaf, names), _explained(leaf)


def _brief_row(leaf: Leaf) -> tuple[str, str]:
    """An option with the name that is used most, and the beginning of its help."""
    if leaf.mark(Positional) is not None:
        return leaf.name.upper(), f"{first_clause(leaf.help)}."
    name = leaf.options[-1]
    if leaf.default is True:
        name = leaf.switch_off.replace("no-", "[no-]", 1)
    names = [name, leaf.options[0]] if len(name) == 2 else [name]
    return _head(leaf, names), f"{first_clause(leaf.help)}."


def _head(leaf: Leaf, names: Sequence[str]) -> str:
    """Names of an option and the type of its value."""
    kind = leaf.kind
    if kind.base is bool:
        return ", ".join(names)
    value = ",".join(kind.choices) if kind.choices else _METAVARS[kind.base]
    value = "TIME" if Time in kind.marks else value
    return f"{', '.join(names)} {value}"


def _explained(leaf: Leaf) -> str:
    """The help of an option with its default and its range."""
    beside = "; ".join(text for text in (default_text(leaf), str(leaf.kind.range)) if text)
    return leaf.help + (f" ({beside})" if beside else "")


def _entry(head: str, text: str, width: int) -> list[str]:
    """Lines with an option to the left and its help to the right."""
    lines = textwrap.wrap(text.replace("``", ""), max(width - _COLUMN, 40)) or [""]
    lines = [" " * _COLUMN + line for line in lines]
    left = f"  {head}  "
    if len(left) > _COLUMN:
        return [left.rstrip(), *lines]
    return [left.ljust(_COLUMN) + lines[0][_COLUMN:], *lines[1:]]
