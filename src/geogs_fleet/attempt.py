"""One attempt at one source on any node: fetch, compute under supervision, deliver.

This file does not load PyTorch: another process computes.
"""

import json
import os
import pickle
import platform
import shutil
import signal
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from secrets import token_hex
from typing import Any

from geogs.application.run_settings import RunSettings
from geogs.errors import GeogsError, InputError, OutputError
from geogs.evaluation.duration import duration
from geogs_fleet.sources import FleetSource
from geogs_fleet.storage import StoragePath
from geogs_fleet.supervise import Limits, ProcessEnd, supervise
from geogs_fleet.table import FILE, Row, State, numbers_of, row_text

LOG = "run.log"
_MANIFEST = "manifest.json"  # of geogs.application.checkpoints.folder, which loads PyTorch
CHILD = (sys.executable, "-m", "geogs_fleet.child")


@dataclass(frozen=True)
class FleetJob:
    """One source for a node to compute."""

    source: FleetSource
    output: str
    """Address of the folder of this source's results."""
    settings: RunSettings
    """Settings of the run, without source and folder."""
    digest: str
    """Digest of the settings."""
    limits: Limits
    command: tuple[str, ...] = CHILD
    attempt: int = 1
    threads: int = 1


def attempt(job: FleetJob) -> Row:
    """Compute a source, from its checkpoint if there is one; its row is stored last.

    Errors become a row with their message.
    """
    begin = time.monotonic()
    state: State = "failed"
    summary: dict[str, Any] = {}
    try:
        state, sentence, summary = _attempt(job)
    except GeogsError as error:
        sentence = str(error)
    except Exception as error:
        sentence = f"The attempt failed ({type(error).__name__}: {error})."
    judgement = summary.get("verdict")
    verdict: dict[str, Any] = judgement if isinstance(judgement, dict) else {}
    row = Row(
        job.source.name,
        job.source.address,
        state,
        verdict.get("sentence", sentence),
        job.digest,
        verdict.get("is_reliable"),
        round(time.monotonic() - begin, 3),
        job.attempt,
        platform.node(),
        numbers_of(summary),
    )
    if state == "done":
        try:
            (StoragePath(job.output) / FILE).write(row_text(row))
        except GeogsError as error:
            return replace(row, state="failed", sentence=str(error))
    return row


def _attempt(job: FleetJob) -> tuple[State, str, dict[str, Any]]:
    """Compute a source; return its state, the reason and the summary of its result."""
    place = StoragePath(job.output)
    (place / FILE).delete()  # row of a previous result, which is about to be replaced
    folder = WorkFolder(place)
    source = StoragePath(job.source.address).path or fetched(job.source, folder.scratch)
    # A local folder is replaced only where an earlier attempt of a fleet has worked in it.
    is_own = place.path is None or (folder.path / LOG).exists()
    settings = replace(job.settings, source=(source,), output=folder.path, overwrite=is_own)
    environment = os.environ | {"OMP_NUM_THREADS": str(job.threads)}
    log = folder.path / LOG
    ending = supervise(
        job.command, pickle.dumps(settings), log, job.limits, environment, folder.keep_checkpoint
    )
    state, sentence = judged(ending, job.limits, f"{job.output}/{LOG}")
    folder.keep_checkpoint()
    if state != "done":
        folder.keep([log])
        return state, sentence, {}
    folder.keep([p for p in sorted(folder.path.rglob("*")) if p.is_file()])
    try:
        summary = json.loads((folder.path / "summary.json").read_bytes())
    except (OSError, ValueError):
        return "failed", f"The run left no summary; {job.output}/{LOG} may say why.", {}
    folder.leave()
    return state, sentence, summary


def judged(ending: ProcessEnd, limits: Limits, log: str) -> tuple[State, str]:
    """State for the ending of a process, with a sentence unless it is done."""
    if ending.exceeded == "time":
        limit = duration(limits.seconds or 0)
        return "failed", f"It took longer than {limit}; with more --time-limit it goes on."
    if ending.exceeded == "memory":
        limit = f"{(limits.memory or 0) / 2**30:.3g} GiB"
        return "failed", (
            f"It needed more than {limit} of memory; give more (--memory-limit), or use a smaller "
            "--long-edge."
        )
    try:
        said = json.loads(ending.said)
        if said["state"] in ("done", "failed", "crashed"):
            return said["state"], str(said["sentence"])
    except (ValueError, TypeError, LookupError):
        pass
    if ending.code < 0:
        try:
            name = signal.Signals(-ending.code).name
        except ValueError:
            name = f"signal {-ending.code}"
        return "crashed", f"The process was ended by {name}; is the memory of the machine full?"
    return "failed", f"The run broke off by an error of the program; {log} says where."


class WorkFolder:
    """The folder of one source's results for a run on this node.

    With an output on a local path, the run works there. Otherwise it works in a temporary folder,
    and every new checkpoint and the results are copied; a checkpoint's manifest is copied last, so
    that an incomplete one is recognised as damaged.
    """

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
            shutil.rmtree(self.path / "checkpoint", ignore_errors=True)
            previous = place / "checkpoint"
            if _MANIFEST in previous.listed():
                previous.download(self.path / "checkpoint")

    def keep_checkpoint(self) -> None:
        """Copy the checkpoint to the output, if it is new."""
        if self._place.path is not None:
            return
        manifest = self.path / "checkpoint" / _MANIFEST
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
