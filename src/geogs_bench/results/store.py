"""Files of the harness in the folder of each result, so that nothing is done twice."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from geogs.documents import UNUSABLE, read_json
from geogs.errors import InputError
from geogs.io.writers.atomic import prepare_output_folder
from geogs_bench.results.record import (
    Cost,
    Provenance,
    Record,
    read_dataclass,
    read_record,
    write_json,
)
from geogs_bench.runners.task import Command

RECORD_FILE = "bench.json"
"""The record of the result."""

_RUN_FILE = "bench_run.json"
_LEFT_BY_EARLIER_RUNS = (
    _RUN_FILE, RECORD_FILE, "mesh.ply", "map.safetensors", "summary.json", "online/trajectory.tum",
    "online/keyframes.tum", "online/mesh.ply", "adjusted/trajectory.tum",
    "adjusted/keyframes.tum", "adjusted/mesh.ply", "depth_fusion/mesh.ply", "snapshots/*/mesh.ply",
    "snapshots/*/map.safetensors",
)  # fmt: skip
"""Files of an earlier result that would be scored."""


@dataclass(frozen=True)
class CompletedRun:
    """A complete run: its source, provenance and cost."""

    source: str
    provenance: Provenance
    cost: Cost


def config_hash(command: Command, settings: Mapping[str, object]) -> str:
    """Twelve digits that change with any setting."""
    text = json.dumps([command, settings], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def completed_run(folder: Path, source: Path, digest: str) -> CompletedRun | None:
    """The run in a folder, if it is of this source with these settings."""
    try:
        run = read_dataclass(CompletedRun, read_json(folder / _RUN_FILE))
    except (InputError, *UNUSABLE):
        return None
    if not isinstance(run.provenance, Provenance):
        return None
    fits = run.source == str(source.resolve()) and run.provenance.config_hash == digest
    return run if fits else None


def write_completed_run(folder: Path, run: CompletedRun) -> None:
    """Mark the folder's run as complete. Raises OutputError if that fails."""
    write_json(folder / _RUN_FILE, run)


def clear(folder: Path) -> Path:
    """Prepare the folder for a new run: delete the files of an earlier one that would be scored.

    No other file is touched, and no link to another folder is followed.

    Raises:
        OutputError: it cannot be made or written.
    """
    prepare_output_folder(folder)
    for pattern in _LEFT_BY_EARLIER_RUNS:
        for path in folder.glob(pattern):
            if path.parent.resolve() == folder.resolve() / path.parent.relative_to(folder):
                path.unlink()
    return folder


def records_below(output: Path, benchmark: str) -> list[Record]:
    """The records of a benchmark in the folders of its results."""
    files = [*output.glob(f"*/{RECORD_FILE}"), *output.glob(f"*/*/{RECORD_FILE}")]
    records = [record for path in sorted(files) if (record := read_record(path)) is not None]
    return [record for record in records if record.benchmark == benchmark]
