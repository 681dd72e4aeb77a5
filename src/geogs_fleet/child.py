"""The process that computes one source: ``python -m geogs_fleet.child``, started by a node.

The parent process sends the settings as a pickle on the standard input; one line of JSON on the
standard output reports the outcome. Everything else goes to the standard error. When the standard
input closes, the parent is gone, and this process ends at once: another node goes on from the last
checkpoint.
"""

import json
import os
import pickle
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

from geogs.application.run_settings import RunSettings
from geogs.errors import DeviceError, GeogsError, InputError, OutputError

PATIENCE = 60.0
"""Seconds to wait for an earlier attempt that still writes into the folder."""
THUMBNAIL = "thumbnail.webp"
_LARGEST = (320, 200)
_PICTURES = ("keyframes.png", "trajectory.png")


def main() -> int:
    """Compute by the settings on the standard input; return 0 once the outcome is reported."""
    said = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    settings: RunSettings = pickle.load(sys.stdin.buffer)
    threading.Thread(target=_end_with, args=(sys.stdin.buffer,), daemon=True).start()
    try:
        compute(settings)
        ending = {"state": "done", "sentence": ""}
    except DeviceError as error:  # another GPU may work
        ending = {"state": "crashed", "sentence": str(error)}
    except GeogsError as error:
        ending = {"state": "failed", "sentence": str(error)}
    said.write(json.dumps(ending))
    said.close()
    return 0


def compute(settings: RunSettings) -> None:
    """Run, or go on from the checkpoint in the folder if it has the same settings.

    Raises:
        InputError, TrackingLost, OutputError, DeviceError: as of a run.
    """
    from geogs.application.progress.terminal_progress import TerminalProgress
    from geogs.application.run import resume, run

    output = settings.output
    assert output is not None, "a fleet gives every source a folder"
    _wait_for_others(output)
    with TerminalProgress() as progress:
        if _is_begun(output, settings):
            try:
                resume(output, settings, progress)
            except InputError as error:  # for example, the source has changed
                progress.write(f"Starting anew: {error}")
                run(replace(settings, overwrite=True), progress)
        else:
            run(settings, progress)
    write_thumbnail(output)


def write_thumbnail(output: Path) -> None:
    """Write a small picture of the result, if its report has any. Raises OutputError."""
    import cv2
    from PIL import Image

    from geogs.application.results.output_folder import claimed
    from geogs.guard.atomic import atomic_file
    from geogs.guard.replacement import replaced
    from geogs.io.pictures import decoded

    pictures = (decoded(output / "report" / name, cv2.IMREAD_COLOR).rgb for name in _PICTURES)
    rgb = next((picture for picture in pictures if picture is not None), None)
    if rgb is not None:
        small = Image.fromarray(rgb)
        small.thumbnail(_LARGEST)
        with (
            claimed(output),
            replaced(output, "part") as new,
            atomic_file(new / THUMBNAIL) as stream,
        ):
            small.save(stream, "WEBP", quality=80)


def _is_begun(output: Path, settings: RunSettings) -> bool:
    from geogs.application.checkpoints.checkpoint import has_checkpoint
    from geogs.application.checkpoints.run_state import SavedRun

    if not has_checkpoint(output):
        return False
    try:
        return SavedRun(output).metadata.settings.deciding() == settings.deciding()
    except InputError:
        return False


def _wait_for_others(output: Path) -> None:
    """Wait until an attempt that is about to end has left the folder. Raises OutputError if not."""
    from geogs.application.results.output_folder import only_writer
    from geogs.guard.atomic import prepare_output_folder

    prepare_output_folder(output)
    last = time.monotonic() + PATIENCE
    while True:
        try:
            with only_writer(output):
                return
        except OutputError:
            if time.monotonic() > last:
                raise
            time.sleep(0.5)


def _end_with(stream: BinaryIO) -> None:
    stream.read()
    os._exit(1)


if __name__ == "__main__":
    sys.exit(main())
