"""Working folder of a run on its node, and the transfer of its files to the output.

With an output on a local path, the run works there. Otherwise it works in a temporary folder, and
every new checkpoint and the results are copied; a checkpoint's manifest is copied last, so that an
incomplete one is recognised as damaged.
"""

import os
import shutil
import tempfile
from hashlib import sha256
from pathlib import Path
from secrets import token_hex

from geogs.errors import InputError, OutputError
from geogs_fleet.sources import FleetSource
from geogs_fleet.storage import StoragePath

_MANIFEST = "manifest.json"  # of geogs.application.checkpoints.folder, which loads PyTorch


class WorkFolder:
    """The folder of one source's results for a run on this node."""

    def __init__(self, place: StoragePath) -> None:
        self._place = place
        mark = sha256(place.address.encode("utf-8", "backslashreplace")).hexdigest()[:16]
        # The same path on every node: a checkpoint stores the path of its source.
        self.scratch = Path(tempfile.gettempdir()) / f"geogs-fleet-{os.getuid()}" / mark
        self.path = place.path or self.scratch / "result"
        self._kept: tuple[int, int] | None = None
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            reason = error.strerror or error
            raise OutputError(f"{self.path} cannot be written ({reason}).") from error
        if place.path is None:
            self._take_checkpoint()

    def keep_checkpoint(self) -> None:
        """Copy the checkpoint to the output, if it is new."""
        manifest = self.path / "checkpoint" / _MANIFEST
        if self._place.path is not None:
            return
        try:
            status = manifest.stat()
            if (status.st_mtime_ns, status.st_ino) == self._kept:
                return
            files = [path for path in manifest.parent.iterdir() if path.name[0] != "."]
            files.sort(key=lambda path: path.name == _MANIFEST)
            for path in files:
                (self._place / f"checkpoint/{path.name}").upload(path)
            self._kept = (status.st_mtime_ns, status.st_ino)
        except (OSError, OutputError):  # the next one may succeed
            return

    def keep(self, files: list[Path]) -> None:
        """Copy files of the folder to the output. Raises OutputError if that fails."""
        if self._place.path is None:
            for path in files:
                (self._place / path.relative_to(self.path).as_posix()).upload(path)

    def leave(self) -> None:
        """Remove temporary files and checkpoints after success."""
        if self._place.path is None:
            previous = self._place / "checkpoint"
            for name in previous.listed():
                (previous / name).delete()
        shutil.rmtree(self.scratch, ignore_errors=True)

    def _take_checkpoint(self) -> None:
        target = self.path / "checkpoint"
        shutil.rmtree(target, ignore_errors=True)
        previous = self._place / "checkpoint"
        if _MANIFEST in previous.listed():
            previous.download(target)


def fetched(source: FleetSource, scratch: Path) -> Path:
    """Download a source from elsewhere. Raises InputError if that fails."""
    place = StoragePath(source.address)
    target = scratch / "source" / (place.name or "source")
    if not target.exists():
        unfinished = target.with_name(f"{target.name}.{token_hex(6)}.part")
        place.download(unfinished)
        try:
            os.replace(unfinished, target)
        except OSError as error:
            raise InputError(f"{target} cannot be written ({error.strerror}).") from error
    return target
