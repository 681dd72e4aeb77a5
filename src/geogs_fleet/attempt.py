"""One attempt at one source on any node: fetch, compute under supervision, deliver.

This file does not load PyTorch: another process computes.
"""

import json
import os
import pickle
import platform
import signal
import sys
import time
from dataclasses import dataclass, replace
from typing import Any

from geogs.application.run_settings import RunSettings
from geogs.errors import GeogsError
from geogs.evaluation.duration import duration
from geogs_fleet.row import FILE, Row, State, numbers_of, row_text
from geogs_fleet.sources import FleetSource
from geogs_fleet.storage import StoragePath
from geogs_fleet.supervise import Limits, ProcessEnd, supervise
from geogs_fleet.work_folder import WorkFolder, fetched

LOG = "run.log"
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
    try:
        state, sentence, summary = _attempt(job)
    except GeogsError as error:
        sentence, summary = str(error), {}
    except Exception as error:
        sentence, summary = f"The attempt failed ({type(error).__name__}: {error}).", {}
    judgement = summary.get("verdict")
    verdict: dict[str, Any] = judgement if isinstance(judgement, dict) else {}
    row = Row(
        job.source.name, job.source.address, state, verdict.get("sentence", sentence), job.digest,
        verdict.get("is_reliable"), round(time.monotonic() - begin, 3), job.attempt,
        platform.node(), numbers_of(summary),
    )  # fmt: skip
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
    settings = replace(job.settings, source=(source,), output=folder.path)
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
