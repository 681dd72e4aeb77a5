"""Kernels shipped compiled with the package: machine code of several architectures, and PTX.

:mod:`geogs.gpu.build_binaries` makes them for a release; a clone of the sources has none.
"""

import zipfile
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path

from geogs.gpu.cache import cache_key
from geogs.gpu.kernel_source import OPTIONS, read_source

FOLDER = Path(__file__).with_name("compiled")
"""Folder with an archive for each architecture; the entries' names are hashes of the sources."""
MACHINE_CODE = ("sm_75", "sm_80", "sm_86", "sm_89", "sm_90", "sm_100", "sm_120")
"""Architectures; each runs on GPUs of the same major and no lower minor compute capability."""
PTX = "compute_75"
"""Architecture of the PTX, which the driver of every later GPU translates."""


def shipped_code(text: str, capability: tuple[int, int]) -> Iterator[bytes]:
    """Shipped code of a source (with its includes) for a GPU: machine code, then PTX, or none."""
    for architecture in usable_by(capability):
        archive = FOLDER / f"{architecture}.zip"
        try:
            with zipfile.ZipFile(archive) as codes:
                yield codes.read(name_of(text))
        except (OSError, KeyError, zipfile.BadZipFile, zlib.error):  # none, others, or damaged
            continue


def usable_by(capability: tuple[int, int]) -> list[str]:
    """The architectures that a GPU can use, the best first; at most one is machine code."""
    major, minor = capability
    number = 10 * major + minor
    same = [a for a in MACHINE_CODE if 10 * major <= _number(a) <= number]
    return [*same[-1:], *([PTX] if _number(PTX) <= number else [])]


def name_of(text: str) -> str:
    """Name of a source's entry, which depends on its text and the options."""
    return cache_key(text, *OPTIONS)


def shipped_sources(sources: Iterable[Path]) -> dict[str, int]:
    """Number of the sources that are shipped in their current form, for each architecture."""
    names = [name_of(read_source(source)) for source in sources]
    counts = {}
    for architecture in (*MACHINE_CODE, PTX):
        try:
            with zipfile.ZipFile(FOLDER / f"{architecture}.zip") as codes:
                kept = set(codes.namelist())
        except (OSError, zipfile.BadZipFile):
            kept = set()
        counts[architecture] = sum(name in kept for name in names)
    return counts


def _number(architecture: str) -> int:
    return int(architecture.split("_")[1])
