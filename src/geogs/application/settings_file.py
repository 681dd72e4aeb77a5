"""All settings as YAML: ``config.yaml`` of a result, which ``--config`` takes."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

from geogs.application.named_files import with_absolute_paths
from geogs.config import Config, ReconstructConfig
from geogs.config.leaves import Leaf, former_words, leaves, with_values
from geogs.config.setting import dashed
from geogs.errors import InputError
from geogs.guard.documents import in_short, read_yaml

T = TypeVar("T", Config, ReconstructConfig)


def settings_text(config: Config | ReconstructConfig) -> str:
    """All settings as YAML; files that they name have absolute paths."""
    import yaml

    plain = json.loads(json.dumps(asdict(with_absolute_paths(config)), default=str))
    text: str = yaml.safe_dump(plain, sort_keys=False)
    return text


def read_settings(path: Path, base: T) -> T:
    """The settings of a file in place of those of ``base``, which has all that the file leaves out.

    Raises:
        InputError: the file cannot be read, or a setting in it is unknown or out of its range.
    """
    known = {leaf.path: leaf for leaf in leaves(base)}
    options = {f"--{leaf.name}": leaf.path for leaf in known.values()}
    former = {old: options.get(new) for old, new in former_words(known.values()).items()}
    values = dict[tuple[str, ...], object]()
    for at, value in _flat(read_yaml(path), ()):
        at = former.get("--" + dashed(".".join(at))) or at
        if at not in known:
            name = in_short(".".join(at)) if at else "a value without a name"
            raise InputError(f"{path} has {name}, which is no setting here; leave it out.")
        values[at] = _value(known[at], value)
    return with_values(base, values) if values else base


def _flat(tree: Any, at: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    """The values of nested groups, with the names that lead to them."""
    if isinstance(tree, Mapping):
        for name, inner in tree.items():
            yield from _flat(inner, (*at, str(name).replace("-", "_")))
    elif at or tree is not None:
        yield at, tree


def _value(leaf: Leaf, value: Any) -> object:
    """A value of YAML as the setting has it; what it cannot have stays, and is refused later."""
    if isinstance(value, list):
        return tuple(_value(leaf, part) for part in value)
    is_text = isinstance(value, str) and leaf.kind.base is not bool
    return leaf.kind.read(value) if is_text else value
