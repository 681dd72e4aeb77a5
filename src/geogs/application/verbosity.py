"""How much a command says, and where else it says it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from geogs.config.setting import Basic, Settings


@dataclass(frozen=True)
class Verbosity(Settings):
    """What is said on the terminal, and in a file."""

    verbose: Annotated[bool, Basic("-v")] = False
    """Say how long each phase took, and what else there is to know."""
    quiet: Annotated[bool, Basic("-q")] = False
    """Say nothing but warnings and errors."""
    log: Annotated[Path | None, Basic()] = None
    """File to which everything is also written, with the time of day; added to if it exists."""
