"""Compile the kernels that a release ships, on any machine.

``python -m geogs.gpu.build_binaries`` needs NVRTC (``pip install nvidia-cuda-nvrtc``), but neither
a GPU nor a driver. All drivers of a major version of CUDA load code compiled by its oldest release.
"""

import os
import sys
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from geogs.errors import DeviceError
from geogs.gpu.binaries import FOLDER, MACHINE_CODE, PTX, name_of
from geogs.gpu.kernel_source import OPTIONS, PACKAGE, kernel_sources, read_source
from geogs.gpu.nvrtc import Nvrtc, load_nvrtc
from geogs.guard.terminal_text import say

CUDA = "13"
"""Major version; its drivers, and all later ones, load its code."""


def build(compiler: Nvrtc, sources: list[Path], folder: Path = FOLDER) -> int:
    """Write an archive for each architecture with all sources; return their size in bytes.

    Raises DeviceError with the compiler's message if a source has errors.
    """
    folder.mkdir(exist_ok=True)
    texts = {source: read_source(source) for source in sources}
    size = 0
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for architecture in (*MACHINE_CODE, PTX):
            codes = pool.map(
                lambda s, to=architecture: compiler.compile(texts[s], s.name, to, OPTIONS), texts
            )
            path = folder / f"{architecture}.zip"
            with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
                for text, code in zip(texts.values(), codes, strict=True):
                    # without a date, so that the same sources make the same file
                    entry = zipfile.ZipInfo(name_of(text))
                    archive.writestr(entry, code, zipfile.ZIP_DEFLATED, 9)
            size += path.stat().st_size
    return size


def main() -> int:
    """Build for all packages beside this one; return the exit code."""
    sources = kernel_sources(PACKAGE.parent)
    try:
        compiler = load_nvrtc(CUDA)
        size = build(compiler, sources)
    except DeviceError as error:
        say(f"error: {error}", is_error=True)
        return 2
    names = ", ".join((*MACHINE_CODE, PTX))
    say(f"{len(sources)} sources for {names} by NVRTC {compiler.version}: {size:,} bytes")
    return 0


if __name__ == "__main__":
    sys.exit(main())
