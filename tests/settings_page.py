"""Writes docs/configuration.md: ``python tests/settings_page.py > docs/configuration.md``."""

import sys
from collections.abc import Mapping, Sequence
from typing import get_args

from geogs.cli.help import is_shown_first
from geogs.config.leaves import Leaf, default_text, leaves
from geogs.config.reconstruct_config import ReconstructConfig, reconstruct_preset
from geogs.config.run_config import Config, Preset, preset
from geogs.config.setting import Only, Settings

_INTRODUCTION = """\
# Settings

Made from the classes in `src/geogs/config` by `python tests/settings_page.py`; a test holds this
page to them.

No setting is needed. On the command line a setting is an option with its dotted name
(`--mapping.depth.planes 200`; a switch is turned off by `--mesh.no-colour`; numbers of a list
have commas between them), from Python a field of the same name
(`Config(mapping=MappingConfig(window=6))`). A value outside its range is refused when the settings
are made. The settings of a result stand in its `config.yaml`, which `--config` takes;
`--print-config` shows those of a command.

`geogs run --help` and `geogs reconstruct --help` show the options in **bold**, `--help-all` all of
them. Settings that only one of the two commands heeds say so, and the other does not offer them.
No command offers those of Python only: presets set them, and programs may.
Groups named `ablation` are there to be compared with.
"""

_ON_A_DEVICE = """\
Where no preset is given, `geogs run` takes `default`, on a GPU with the sizes of the second column
unless the images come live, and `geogs reconstruct` takes `accurate` on a GPU, `default` on a CPU.
Where `auto` stands, the setting's own line says what that is on either.
"""


def document() -> str:
    """The page: presets, then a table for every group of settings."""
    run, known_poses = Config(), ReconstructConfig()
    both = {leaf.name: leaf for leaf in leaves(run)}
    other = {leaf.name: leaf for leaf in leaves(known_poses)}
    groups: dict[str, list[list[str]]] = {}
    for leaf in (both | other | both).values():
        row = _row(leaf, both.get(leaf.name), other.get(leaf.name))
        groups.setdefault(leaf.group, []).append(row)
    words = {kind.group: kind.__doc__ or "" for kind in _classes(run) + _classes(known_poses)}
    named = {name: preset(name) for name in get_args(Preset)}
    named = {"default": preset("default"), "default, GPU": preset("default", on_gpu=True), **named}
    parts = [_INTRODUCTION, "## Presets\n", _presets("run", named)]
    named_known = {name: reconstruct_preset(name) for name in get_args(Preset)}
    parts.append(_presets("reconstruct", named_known) + "\n" + _ON_A_DEVICE)
    for group, rows in groups.items():
        where = [
            command
            for command, tree in (("run", both), ("reconstruct", other))
            if any(leaf.group == group for leaf in tree.values())
        ]
        only = f" (`{where[0]}` only)" if len(where) == 1 else ""
        parts.append(f"## {group or 'At the top'}{only}\n")
        parts += [_paragraphs(words[group])] if group else []
        parts.append(_table(("setting", "default", "may be", "meaning"), rows))
    return "\n".join(parts)


def _row(leaf: Leaf, run: Leaf | None, known_poses: Leaf | None) -> list[str]:
    only, default = leaf.mark(Only), _code(default_text(leaf))
    if only is None and run is not None and known_poses is not None:
        changed = _code(default_text(known_poses))
        default += "" if changed == default else f", {changed} in `reconstruct`"
    where = "Python" if only and only.command == "python" else _code(only.command if only else "")
    beside = f" ({where} only)" if only else ""
    name = _code(leaf.name)
    name = f"**{name}**" if is_shown_first(leaf) else name
    return [name, default, str(leaf.kind), leaf.help + beside]


def _presets(command: str, named: Mapping[str, Settings]) -> str:
    """What each preset has that is not usual."""
    rows = []
    for some in zip(*map(leaves, named.values()), strict=True):
        texts = [_code(default_text(leaf)) for leaf in some]
        if len(set(texts)) > 1:
            rows.append([_code(some[0].name), *texts])
    return _table((f"`geogs {command}`", *named), rows)


def _classes(tree: Settings) -> list[type[Settings]]:
    """The classes of all groups of a tree."""
    inner = [value for value in vars(tree).values() if isinstance(value, Settings)]
    return [type(tree), *(kind for group in inner for kind in _classes(group))]


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "".join(
        "| " + " | ".join(c.replace("|", "\\|") for c in cells) + " |\n" for cells in lines
    )


def _paragraphs(docstring: str) -> str:
    lines = [line.strip() for line in docstring.strip().splitlines()]
    return "\n".join(lines) + "\n"


def _code(text: str) -> str:
    return f"`{text}`" if text else ""


if __name__ == "__main__":
    sys.stdout.write(document())
