"""``geogs weights``: list of the weights files, and check of a file."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from geogs.cli.options import parse_options
from geogs.config.setting import Positional
from geogs.errors import InputError
from geogs.guard.terminal_text import say
from geogs.networks.weights_files import (
    CATALOGUE,
    KnownWeights,
    checksum,
    known_as,
    locate,
    require_intact,
    weights_folders,
)


@dataclass(frozen=True)
class WeightsOptions:
    """List the weights files that can be used and where they are had, or verify one.

    Nothing is downloaded. It searches $GEOGS_WEIGHTS (a file or a folder),
    weights/ of the cache directory ($GEOGS_CACHE, else ~/.cache/geogs), and the package.
    """

    action: Annotated[Literal["list", "verify"], Positional(required=False)] = "list"
    """What to do."""
    file: Annotated[Path | None, Positional(required=False)] = None
    """The file to verify."""


def main(argv: Sequence[str]) -> int:
    """Run the command; returns 0, or raises InputError for a file that cannot be used."""
    options = parse_options(WeightsOptions, argv, "weights")

    file = options.file
    if options.action == "list":
        if file is not None:
            raise InputError(f"geogs weights list takes no file; did you mean verify {file}?")
        say(*listing().splitlines())
    else:
        if file is None:
            raise InputError("geogs weights verify needs a file.")
        say(*verification(file).splitlines())
    return 0


def listing() -> str:
    """List of all known files, with the paths of those found."""

    def entry(known: KnownWeights) -> list[str]:
        path = locate(known)
        state = "not here" if path is None else f"{path} ({checksum(path).verdict})"
        return [
            f"  {known.name}",
            f"      {known.what}",
            f"      file     {state}",
            f"      from     {known.origin}",
            f"      licence  {known.licence}",
        ]

    lines = ["searched: " + ", ".join(map(str, weights_folders()))]
    titles = {
        "own": "--tracking.operator own",
        "droid": "--tracking.operator droid",
        "depth": "--mapping.depth.engine network",
        "prior": "monocular priors",
    }
    for purpose, title in titles.items():
        lines += ["", title]
        for known in CATALOGUE:
            if known.purpose == purpose:
                lines += entry(known)
    return "\n".join(lines)


def verification(path: Path) -> str:
    """Content of a file, and whether it is the published one of its name.

    Raises InputError if it is missing, damaged or another.
    """
    found = require_intact(path)
    known = known_as(path.name)
    lines = [
        f"file     {path}, {path.stat().st_size / 2**20:.1f} MiB",
        f"sha256   {found.actual}",
        f"known    {f'{known.name}, {known.what}' if known else 'no file of this name is known'}",
        f"verdict  {found.verdict}",
    ]
    if path.suffix != ".onnx":
        from geogs.networks.tensor_files import read_tensors  # loads PyTorch

        tensors = read_tensors(path)
        numbers = sum(t.numel() for t in tensors.values())
        lines.append(
            f"content  {len(tensors)} tensors, {numbers:,} numbers, read without running code"
        )
    return "\n".join(lines)
