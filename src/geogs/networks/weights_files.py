"""Finding weights files, and checking that they are what they should be."""

import hashlib
import os
from dataclasses import dataclass
from pathlib import Path

from geogs.errors import InputError
from geogs.gpu.cache import cache_folder
from geogs.networks.weights_catalogue import CATALOGUE, KnownWeights, Purpose, known_as

PACKAGED = Path(__file__).parents[1] / "data" / "weights"
"""Weights that come with the package, and their ``SHA256SUMS``."""
VARIABLE = "GEOGS_WEIGHTS"
"""Environment variable with a weights file, or a folder of them."""


@dataclass(frozen=True)
class Checksum:
    """The SHA-256 of a file beside that which is published for its name."""

    actual: str
    published: str
    """Whole, or the first digits; empty if none is known."""

    @property
    def is_wrong(self) -> bool:
        """Whether the file is not the published one."""
        return not self.actual.startswith(self.published)

    @property
    def verdict(self) -> str:
        """In words."""
        if not self.published:
            return "no checksum is published, not verified"
        if self.is_wrong:
            return f"WRONG checksum, {self.published} is published"
        if len(self.published) < len(self.actual):
            return f"first {len(self.published)} digits of the checksum verified"
        return "checksum verified"


def weights_folders() -> list[Path]:
    """Where weights are looked for: ``$GEOGS_WEIGHTS``, the user's cache, the package."""
    chosen = os.environ.get(VARIABLE)
    folders = [Path(chosen)] if chosen and Path(chosen).is_dir() else []
    return [*folders, cache_folder() / "weights", PACKAGED]


def locate(known: KnownWeights) -> Path | None:
    """Where a known file is, None if nowhere."""
    chosen = Path(os.environ.get(VARIABLE) or ".")
    paths = [chosen] if chosen.name == known.name else []
    paths += [folder / known.name for folder in weights_folders()]
    return next((path for path in paths if path.is_file()), None)


def find_weights(purpose: Purpose, chosen: str = "") -> Path:
    """The weights file for a purpose: the chosen one, else what is found.

    ``$GEOGS_WEIGHTS`` may be a file (of any name that does not say that it is for something else)
    or a folder; then come the user's cache directory and the package.

    Raises InputError if there is none.
    """
    if chosen:
        if not Path(chosen).is_file():
            raise InputError(f"There is no weights file {chosen}.")
        return Path(chosen)
    variable = os.environ.get(VARIABLE)
    if variable and not Path(variable).exists():
        raise InputError(f"{VARIABLE} is {variable}, which does not exist.")
    if variable and Path(variable).is_file():
        known = known_as(Path(variable).name)
        if known is None or known.purpose == purpose:
            return Path(variable)
    for known in CATALOGUE:
        if known.purpose == purpose and (path := locate(known)):
            return path
    places = ", ".join(map(str, weights_folders()))
    if purpose == "depth":
        raise InputError(
            f"No weights of the depth network were found in {places}; give --mapping.depth.weights "
            "FILE (geogs train depth makes one), or take --mapping.depth.engine classical."
        )
    raise InputError(
        f"No weights for the operator {purpose} were found in {places}; give "
        "--tracking.weights FILE (geogs weights says where such files are had)."
    )


def checksum(path: Path) -> Checksum:
    """SHA-256 of a file, and the published one for its name.

    Raises InputError if the file cannot be read.
    """
    try:
        with path.open("rb") as file:
            actual = hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(
            f"The weights file {path} cannot be read ({error.strerror or error})."
        ) from error
    return Checksum(actual, _published(path))


def require_intact(path: Path) -> Checksum:
    """The checksum of a file; raises InputError if its name has another one."""
    found = checksum(path)
    if found.is_wrong:
        raise InputError(
            f"{path} is not the published file of that name: its SHA-256 begins with "
            f"{found.actual[:8]}, not {found.published[:8]}; get it again."
        )
    return found


def _published(path: Path) -> str:
    if path.parent.resolve() == PACKAGED.resolve():
        return _packaged_sums().get(path.name, "")
    known = known_as(path.name)
    return known.sha256 if known else ""


def _packaged_sums() -> dict[str, str]:
    """Checksums by file name; the format is that of the ``sha256sum`` command."""
    try:
        lines = (PACKAGED / "SHA256SUMS").read_text().splitlines()
    except OSError:
        return {}
    pairs = (line.split(maxsplit=1) for line in lines if line.strip())
    return {name.lstrip("*"): digest for digest, name in pairs}
