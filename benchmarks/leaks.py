"""Repeated runs in one process: growth of its memory and of its open files.

    python benchmarks/leaks.py VIDEO [--repeats 8] [--minutes 60] [--folder FOLDER]

Prints a line of JSON: frames of a run; after each, bytes in use, resident bytes and open files;
bytes that are lost a frame (the slope of those in use after the first two runs, in which kernels
are compiled and pools are filled), files that stay open. Ends with 1 if 1 kB a frame or a file is
lost. In use are bytes allocated from the C library and not freed, also by Python; resident bytes
include the library's free memory, which grows for some ten runs and is no leak.
"""

import argparse
import ctypes
import gc
import json
import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from geogs.application.run import run
from geogs.application.run_settings import RunSettings
from geogs.config import preset

MOST_LEAKED = 1024.0
"""Largest accepted loss, bytes a frame."""
WARM_UP = 2
"""Number of first runs that are not counted."""


class MallocInfo(ctypes.Structure):
    """Memory statistics of the C library (``mallinfo2`` of glibc 2.33)."""

    _fields_ = [
        (name, ctypes.c_size_t)
        for name in (
            "arena", "free_chunks", "fast_chunks", "mapped_chunks", "mapped_bytes", "unused",
            "fast_bytes", "used_bytes", "free_bytes", "releasable_bytes",
        )
    ]  # fmt: skip


def main() -> None:
    """Run the repetitions and print the line."""
    if os.environ.get("PYTHONMALLOC") != "malloc":  # Python reads it when it starts
        os.environ["PYTHONMALLOC"] = "malloc"
        os.execv(sys.executable, [sys.executable, *sys.argv])
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("video", type=Path)
    parser.add_argument("--repeats", type=int, default=8)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--folder", type=Path, default=None)
    options = parser.parse_args()
    folder = options.folder or Path(tempfile.mkdtemp(prefix="geogs-leaks-"))
    found = repetitions(options.video, folder, options.repeats, 60 * options.minutes)
    print(json.dumps(found))
    leak, grown = found["bytes_a_frame"], found["files_grown"]
    sys.exit(1 if (leak or 0) > MOST_LEAKED or (grown or 0) > 0 else 0)


def repetitions(video: Path, folder: Path, repeats: int, seconds: float) -> dict[str, object]:
    """Run ``repeats`` times, or as often as time allows; return the growth, none after too few."""
    used, resident, files = list[int](), list[int](), list[int]()
    frames, end = 0, time.monotonic() + seconds
    for _ in range(repeats):
        begin = time.monotonic()
        output = folder / "again"
        settings = RunSettings((video,), preset("fast"), output, "cpu", overwrite=True)
        frames = run(settings).scene.frames
        gc.collect()
        used.append(bytes_in_use())
        resident.append(resident_bytes())
        files.append(len(os.listdir("/proc/self/fd")))
        if 2 * time.monotonic() - begin > end:
            break
    counted = used[WARM_UP:]
    enough = len(counted) >= 3
    slope = float(np.polyfit(np.arange(len(counted)), counted, 1)[0]) if enough else 0.0
    return {
        "frames": frames,
        "bytes_in_use": used,
        "resident_bytes": resident,
        "open_files": files,
        "bytes_a_frame": round(slope / max(frames, 1), 1) if enough else None,
        "files_grown": files[-1] - files[WARM_UP] if enough else None,
    }


def bytes_in_use() -> int:
    """Allocated bytes."""
    tell = ctypes.CDLL(None).mallinfo2
    tell.restype = MallocInfo
    info = tell()
    return info.used_bytes + info.mapped_bytes


def resident_bytes() -> int:
    """Bytes of this process in memory."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


if __name__ == "__main__":
    main()
