"""The machine of a measurement, and the version of the program."""

import ctypes
import gc
import platform
import re
import subprocess
from contextlib import suppress
from pathlib import Path

from geogs.gpu.kernel_source import PACKAGE
from geogs.threads import available_cores
from geogs.version import __version__


def machine_name() -> str:
    """Processor and the number of cores that may be used."""
    processor = platform.processor() or platform.machine()
    with suppress(OSError):  # Linux alone has this file
        found = re.search(r"^model name\s*: *(.+)$", Path("/proc/cpuinfo").read_text(), re.M)
        processor = found[1].strip() if found else processor
    return f"{processor}, {available_cores()} cores"


def program_version() -> str:
    """Commit of the running checkout, with ``+`` if files are changed; else the version."""
    package = PACKAGE.resolve()
    if _git(package.parent, "ls-files", "--error-unmatch", package.name) is None:
        return __version__  # installed, perhaps inside a repository of something else
    commit = _git(package.parent, "rev-parse", "--short=12", "HEAD")
    changed = _git(package.parent, "status", "--porcelain", "--untracked-files=no", "--", ".")
    return f"{commit}{'+' if changed else ''}" if commit else __version__


def forget_peak_memory() -> None:
    """Reset the peak memory use, so that each run reports its own.

    On systems that cannot do so, the figure is that of all runs of this process so far; memory that
    earlier runs still hold counts everywhere.
    """
    gc.collect()
    with suppress(OSError, AttributeError):  # the C library of Linux keeps freed memory otherwise
        ctypes.CDLL(None).malloc_trim(0)
    with suppress(OSError):  # Linux alone has it; see proc(5)
        Path("/proc/self/clear_refs").write_text("5")
    import torch

    if torch.cuda.is_available():
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()


def _git(folder: Path, *arguments: str) -> str | None:
    """Output of a git command; none if it fails or git is missing."""
    try:
        done = subprocess.run(
            ["git", "-C", str(folder), *arguments],
            capture_output=True,
            text=True,
            check=True,
            timeout=20,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()
