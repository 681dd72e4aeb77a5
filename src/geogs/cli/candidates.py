"""Completions of an unfinished word of a command line, for the Tab key of a shell."""

from collections.abc import Iterator, Mapping, Sequence

from geogs.cli.answer import JSON, JSON_HELP
from geogs.cli.help import first_clause, is_shown_first
from geogs.config.leaves import Leaf
from geogs.config.setting import Positional, dashed

ASKED = "--complete"
"""Last argument of a completion request from a shell."""


def matching(found: Mapping[str, str], unfinished: str) -> str:
    """Lines for a shell: completions of the unfinished word, with their descriptions."""
    named = [(name, text) for name, text in found.items() if name.startswith(unfinished)]
    return "\n".join(f"{name}\t{text}" if text else name for name, text in named)


def candidates(known: Sequence[Leaf], typed: Sequence[str]) -> dict[str, str]:
    """Possible completions of the last typed word, with their descriptions."""
    *before, unfinished = typed or [""]
    taking = {name: leaf for leaf in known if leaf.kind.base is not bool for name in leaf.options}
    last = taking.get(dashed(before[-1])) if before else None
    if last is not None:
        return dict.fromkeys(last.kind.choices, "")
    if unfinished.startswith("-"):
        offered = known if unfinished.strip("-") else filter(is_shown_first, known)
        found = {name: first_clause(leaf.help) for leaf in offered for name in _names(leaf)}
        return {**found, JSON: JSON_HELP}
    places = (leaf for leaf in known if leaf.mark(Positional) is not None)
    return {choice: "" for leaf in places for choice in leaf.kind.choices}


def _names(leaf: Leaf) -> Iterator[str]:
    yield from leaf.options
    if leaf.kind.base is bool and leaf.options:
        yield leaf.switch_off
