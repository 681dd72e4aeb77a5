"""``geogs weights``: which weights files there are, and whether a file is intact."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from geogs.cli.options import parse_options
from geogs.config.setting import Positional
from geogs.errors import InputError


@dataclass(frozen=True)
class WeightsOptions:
    """List the weights files that can be used and where they are had, or verify one.

    Nothing is downloaded. Files are looked for in $GEOGS_WEIGHTS (a file or a folder), in
    weights/ of the cache directory ($GEOGS_CACHE, else ~/.cache/geogs), and in the package.
    """

    action: Annotated[Literal["list", "verify"], Positional(required=False)] = "list"
    """What to do."""
    file: Annotated[Path | None, Positional(required=False)] = None
    """The file to verify."""


def main(argv: Sequence[str]) -> int:
    """Run the command; returns 0, or raises InputError for a file that cannot be used."""
    options = parse_options(WeightsOptions, argv, "weights")

    from geogs.application.machine.weights import listing, verification

    if options.action == "list":
        if options.file is not None:
            raise InputError(
                f"geogs weights list takes no file; did you mean verify {options.file}?"
            )
        print(listing())
    else:
        if options.file is None:
            raise InputError("geogs weights verify needs a file.")
        print(verification(options.file))
    return 0
