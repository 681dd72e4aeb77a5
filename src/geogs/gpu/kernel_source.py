"""Kernel sources: their files, their includes and the kernels that they define."""

import re
from pathlib import Path

PACKAGE = Path(__file__).parents[1]
"""Folder with all kernel sources of ours."""
INCLUDE_FOLDER = Path(__file__).parent
"""Folder of ``#include "common.cuh"``."""
OPTIONS = ("--use_fast_math", "--std=c++17")
"""Compiler options of all kernels; whatever else they depend on is an argument of the launch."""

_KERNEL = re.compile(
    r'extern\s+"C"\s+__global__\s+void\s+(?:__launch_bounds__\([^)]*\)\s*)?(\w+)\s*\(([^)]*)\)',
    re.DOTALL,
)
_INCLUDE = re.compile(r'^\s*#include\s+"([^"]+)"', re.MULTILINE)


def kernel_sources(folder: Path) -> list[Path]:
    """Every file below a folder that is compiled."""
    return sorted(folder.rglob("*.cu"))


def read_source(path: Path) -> str:
    """The text with its own includes inserted, each once: all that the compiled code depends on."""
    seen: set[str] = set()

    def insert(text: str, folder: Path) -> str:
        def replace(match: re.Match[str]) -> str:
            name = match.group(1)
            if name in seen:
                return ""
            seen.add(name)
            near = folder / name
            file = near if near.is_file() else INCLUDE_FOLDER / name
            return insert(file.read_text(), file.parent)

        return _INCLUDE.sub(replace, text)

    return insert(path.read_text(), path.parent)


def kernel_signatures(source: str) -> dict[str, tuple[str, ...]]:
    """The ``extern "C" __global__`` functions of a source, each with the types of its parameters,
    as ``float*``, ``int``, ``float``, ..."""
    plain = re.sub(r"//[^\n]*|/\*.*?\*/", "", source, flags=re.DOTALL)
    return {
        name: tuple(_parameter_type(p) for p in parameters.split(",") if p.strip())
        for name, parameters in _KERNEL.findall(plain)
    }


def _parameter_type(declaration: str) -> str:
    """``const float* __restrict__ x`` -> ``float*``"""
    text = re.sub(r"\b(const|__restrict__)\b", " ", declaration)
    stars = text.count("*")
    words = text.replace("*", " ").split()
    return " ".join(words[:-1]) + "*" * stars
