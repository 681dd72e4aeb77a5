"""The weights files that can be used: their sources, the search for them, and their checksums.

Facts about public files are from their own pages; only the package's own files have checksums.
"""

import hashlib
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from geogs.errors import InputError
from geogs.gpu.cache import cache_folder
from geogs.guard.documents import open_file

PACKAGED = Path(__file__).parents[1] / "data" / "weights"
"""Weights that come with the package, and their ``SHA256SUMS``."""
VARIABLE = "GEOGS_WEIGHTS"
"""Environment variable with a weights file, or a folder of them."""

Purpose = Literal["own", "droid", "depth", "prior"]
"""Use of a weights file: a flow operator, the depth network, or a monocular prior."""

COMES_ALONG = "comes with geogs"


@dataclass(frozen=True)
class KnownWeights:
    """A weights file that is known by name."""

    name: str
    """File name that is searched."""
    purpose: Purpose
    """Use of the file."""
    what: str
    """Description in a few words."""
    origin: str
    """Source of the file."""
    licence: str


_HUB = "https://huggingface.co/"

CATALOGUE = (
    KnownWeights(
        "flow.safetensors", "own", "flow for static scenes, trained by geogs",
        COMES_ALONG, "Apache-2.0",
    ),
    KnownWeights(
        "droid.pth", "droid", "DROID-SLAM, TartanAir",
        "https://github.com/princeton-vl/DROID-SLAM (README, droid.pth)", "BSD-3-Clause",
    ),
    KnownWeights(
        "depth.safetensors", "depth", "multi-view depth of still scenes, trained by geogs",
        COMES_ALONG, "Apache-2.0",
    ),
    KnownWeights(
        "depth-anything-v2-small.onnx", "prior", "Depth Anything V2 small: inverse depth",
        _HUB + "onnx-community/depth-anything-v2-small (onnx/model.onnx)", "Apache-2.0",
    ),
    KnownWeights(
        "metric3d-vit-small.onnx", "prior", "Metric3D v2 small: depth and normals",
        _HUB + "onnx-community/metric3d-vit-small (onnx/model.onnx)",
        "CC0-1.0 by that page; BSD-2-Clause repository of the authors",
    ),
)  # fmt: skip
"""The known files, in order of preference for each purpose."""


def known_as(name: str) -> KnownWeights | None:
    """The catalogue's entry for a file name; None if there is none."""
    return next((known for known in CATALOGUE if known.name == name), None)


@dataclass(frozen=True)
class Checksum:
    """The SHA-256 of a file and the one published for its name."""

    actual: str
    published: str
    """Empty if none is known."""

    @property
    def is_wrong(self) -> bool:
        """Whether the file is not the published one."""
        return self.published not in ("", self.actual)

    @property
    def verdict(self) -> str:
        """The comparison in words."""
        if not self.published:
            return "no checksum is published, not verified"
        if self.is_wrong:
            return f"WRONG checksum, {self.published} is published"
        return "checksum verified"


def weights_folders() -> list[Path]:
    """Folders that are searched: ``$GEOGS_WEIGHTS``, the user's cache, the package."""
    chosen = os.environ.get(VARIABLE)
    folders = [Path(chosen)] if chosen and Path(chosen).is_dir() else []
    return [*folders, cache_folder() / "weights", PACKAGED]


def locate(known: KnownWeights) -> Path | None:
    """Path of a known file; None if it is nowhere."""
    chosen = Path(os.environ.get(VARIABLE) or ".")
    paths = [chosen] if chosen.name == known.name else []
    paths += [folder / known.name for folder in weights_folders()]
    return next((path for path in paths if path.is_file()), None)


def located(purpose: Purpose) -> Path | None:
    """Path of the first known file for a purpose; None if there is none."""
    paths = (locate(known) for known in CATALOGUE if known.purpose == purpose)
    return next((path for path in paths if path is not None), None)


def find_weights(purpose: Purpose, chosen: str = "") -> Path:
    """The weights file for a purpose: the chosen one, else what is found.

    ``$GEOGS_WEIGHTS`` may be a file (unless its name is known for another purpose) or a folder;
    then come the user's cache directory and the package.

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
    if (path := located(purpose)) is not None:
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
    with open_file(path) as file:
        actual = hashlib.file_digest(file, "sha256").hexdigest()
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
    """The checksum that ``SHA256SUMS`` gives for a file of the package."""
    if path.parent.resolve() != PACKAGED.resolve():
        return ""
    try:
        lines = (PACKAGED / "SHA256SUMS").read_text().splitlines()
    except OSError:
        return ""
    pairs = (line.split(maxsplit=1) for line in lines if line.strip())
    return {name.lstrip("*"): digest for digest, name in pairs}.get(path.name, "")
