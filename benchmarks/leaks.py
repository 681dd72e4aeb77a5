"""The same run again and again in one process: growth of its memory and of its open files.

    python benchmarks/leaks.py VIDEO [--repeats 8] [--minutes 60] [--folder FOLDER]

Prints a line of JSON: frames of a run, resident bytes and open files after each, bytes that are
lost a frame (the slope after the first two runs, in which kernels are compiled and pools are
filled), files that stay open. Ends with 1 where 1 kB a frame or a file is lost.
"""

import argparse
import gc
import json
import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from geogs.application.run import run
from geogs.application.settings import RunSettings
from geogs.config import preset

MOST_LEAKED = 1024.0
"""Bytes a frame."""
WARM_UP = 2
"""Runs before memory counts."""


def main() -> None:
    """The repetitions, then the line."""
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
    """Run so often, or as often as there is time for; what grew, none where that was too few."""
    memory, files, frames, end = list[int](), list[int](), 0, time.monotonic() + seconds
    for _ in range(repeats):
        begin = time.monotonic()
        settings = RunSettings((video,), preset("fast"), output=folder / "again", device="cpu")
        frames = run(settings).result.scene.frames
        gc.collect()
        memory.append(resident())
        files.append(len(os.listdir("/proc/self/fd")))
        if 2 * time.monotonic() - begin > end:
            break
    counted = memory[WARM_UP:]
    enough = len(counted) >= 3
    slope = float(np.polyfit(np.arange(len(counted)), counted, 1)[0]) if enough else 0.0
    return {
        "frames": frames,
        "resident_bytes": memory,
        "open_files": files,
        "bytes_a_frame": round(slope / max(frames, 1), 1) if enough else None,
        "files_grown": files[-1] - files[WARM_UP] if enough else None,
    }


def resident() -> int:
    """Bytes of this process in memory."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


if __name__ == "__main__":
    main()
