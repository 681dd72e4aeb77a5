"""Every setting of a tree of dataclasses, with what is to be said of it."""

import ast
import functools
import inspect
import itertools
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import MISSING, dataclass, fields, replace
from typing import Any, TypeVar, get_args

from geogs.config.setting import (
    Basic,
    Formerly,
    Kind,
    Only,
    Positional,
    Unnamed,
    dashed,
    group_of,
    kinds,
)

T = TypeVar("T")


@dataclass(frozen=True)
class Leaf:
    """A setting at its place in the tree."""

    path: tuple[str, ...]
    """Names of the fields that lead to it."""
    group: str
    """Dotted name of the groups it is in, empty at the top."""
    kind: Kind
    default: Any
    """``dataclasses.MISSING`` if it has none."""
    help: str
    """The sentences under the field."""

    @property
    def name(self) -> str:
        """The dotted name, as the command line has it."""
        own = dashed(self.path[-1])
        return f"{self.group}.{own}" if self.group else own

    @property
    def options(self) -> tuple[str, ...]:
        """Names on the command line, the full one first; none if it is given without one."""
        basic = self.mark(Basic)
        if self.mark(Positional) is not None:
            return ()
        return (f"--{self.name}", *([basic.name] if basic is not None and basic.name else []))

    @property
    def switch_off(self) -> str:
        """The name that turns a switch off."""
        group = f"{self.group}." if self.group else ""
        return f"--{group}no-{dashed(self.path[-1])}"

    def mark(self, kind: type) -> Any:
        """Mark in its type, such as :class:`Basic`; none if it does not."""
        return next((mark for mark in self.kind.marks if isinstance(mark, kind)), None)


def leaves(tree: object, command: str = "") -> tuple[Leaf, ...]:
    """The settings of a dataclass or of one's instance, whose values are the defaults then.

    With a command, without those that are :class:`Only` for another.
    """
    return tuple(
        leaf
        for leaf in _leaves(tree, (), "")
        if not command or (only := leaf.mark(Only)) is None or only.command == command
    )


def former_words(known: Iterable[Leaf]) -> dict[str, str]:
    """Words of the command line that went in the last version, with those in their place."""
    marks = (leaf.mark(Formerly) for leaf in known)
    return {old: new for mark in marks if mark for old, new in mark.words.items()}


def with_values(tree: T, values: Mapping[tuple[str, ...], object]) -> T:
    """The same settings but for some, which are named by the fields that lead to them."""
    own: dict[str, Any] = {}
    for name in {path[0] for path in values}:
        inner = {path[1:]: value for path, value in values.items() if path[0] == name}
        own[name] = inner[()] if () in inner else with_values(getattr(tree, name), inner)
    return replace(tree, **own)  # type: ignore[type-var]


def default_text(leaf: Leaf) -> str:
    """The default of a setting as one would write it; empty if it has none."""
    value = leaf.default
    if value is None or isinstance(value, bool):
        return {None: "none", True: "on", False: "off"}[value]
    if isinstance(value, tuple):
        return ",".join(map(str, value))
    return "" if value is MISSING else f"{value:.15g}" if isinstance(value, float) else str(value)


def default_of(field: Any) -> Any:
    """Default of a field; ``MISSING`` if it must be given."""
    return field.default if field.default_factory is MISSING else field.default_factory()


def _leaves(tree: Any, path: tuple[str, ...], group: str) -> Iterator[Leaf]:
    kind = tree if isinstance(tree, type) else type(tree)
    helps = _helps(kind)
    settings = dict(kinds(kind))
    for field in fields(kind):
        default = default_of(field) if tree is kind else getattr(tree, field.name)
        at = (*path, field.name)
        inner = group_of(field.type)
        if inner is None:
            setting = settings[field.name]
            yield Leaf(at, group, setting, default, helps.get(field.name, ""))
        elif Unnamed in get_args(field.type):
            yield from _leaves(inner if default is MISSING else default, at, group)
        else:
            name = f"{group}.{dashed(field.name)}" if group else dashed(field.name)
            yield from _leaves(inner if default is MISSING else default, at, name)


@functools.cache
def _helps(kind: type) -> dict[str, str]:
    """The string under each field of a class and of its bases, in one line."""
    helps: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        node = _classes(base.__module__).get(base.__qualname__)
        body = [] if node is None else node.body
        for field, text in itertools.pairwise(body):
            if (
                isinstance(field, ast.AnnAssign)
                and isinstance(field.target, ast.Name)
                and isinstance(text, ast.Expr)
                and isinstance(text.value, ast.Constant)
            ):
                helps[field.target.id] = " ".join(str(text.value.value).split())
    return helps


@functools.cache
def _classes(module: str) -> dict[str, ast.ClassDef]:
    """The classes at the top of a module's source, where that can be read."""
    try:
        source = inspect.getsource(sys.modules[module])
    except (OSError, TypeError):
        return {}
    return {n.name: n for n in ast.parse(source).body if isinstance(n, ast.ClassDef)}
