"""What work that is not done leaves behind: checkpoints with right checksums, and benchmarks'."""

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch

import mutations
from crafted_checkpoints import reseal
from geogs.application.checkpoints.checkpoint import (
    checkpoint_folder,
    has_checkpoint,
    write_checkpoint,
)
from geogs.application.checkpoints.run_state import RunMetadata, RunState, SavedRun
from geogs.application.run_settings import RunSettings
from geogs.config import Config
from geogs.geometry.camera import Camera
from geogs.slam import Slam
from geogs.types import Frame
from geogs_bench.harness import CompletedRun, completed_run, write_completed_run
from geogs_bench.results.record import Cost, Provenance, Record, read_record, write_json
from geogs_bench.results.result_folder import ResultFolder
from io_samples import gradient_image
from parsers.base import Damage, Parser
from parsers.results import complete

CAMERA = Camera(50.0, 50.0, 31.5, 23.5, 64, 48)
STATE = "checkpoint/state-1"
MANIFEST = "checkpoint/manifest.json"


def states() -> dict[str, Parser]:
    """Checkpoints of ``geogs run``, and what ``geogs bench`` keeps."""
    files: dict[str, tuple[str, Damage, Callable[[Path], object]]] = {
        "checkpoint-manifest": (MANIFEST, mutations.json_text, resumed),
        "checkpoint-values": (f"{STATE}.json", mutations.json_text, resealed_and_resumed),
        "checkpoint-tensors": (
            f"{STATE}.safetensors", mutations.safetensors, resealed_and_resumed
        ),
    }  # fmt: skip
    found = {k: Parser(begun, (file,), damage, use) for k, (file, damage, use) in files.items()}
    record = ("bench.json", "bench_run.json")
    found["bench-records"] = Parser(benched, record, mutations.json_text, records)
    found["bench-summary"] = Parser(
        complete, ("summary.json",), mutations.json_text, lambda f: ResultFolder(f).stages()
    )
    found["bench-uncertainty"] = Parser(
        complete, ("trajectory_uncertainty.csv",), mutations.text,
        lambda f: ResultFolder(f).states(),
    )  # fmt: skip
    return found


def system() -> Slam:
    return Slam(CAMERA, Config(), device="cpu")


def begun(folder: Path) -> None:
    """A run of a few frames."""
    slam = system()
    for k in range(3):
        image = np.roll(gradient_image(0), 2 * k, axis=1)
        slam.process(Frame(k, k / 30, image))
    facts = RunMetadata(RunSettings((folder / "v.mp4",)), "cpu", "0123456789abcdef", None)
    write_checkpoint(checkpoint_folder(folder), RunState(facts, slam.settled()))


def resumed(folder: Path) -> object:
    """A system with the state of the run."""
    if not has_checkpoint(folder):
        return None
    with SavedRun(folder).world(torch.device("cpu")) as world:
        return Slam(CAMERA, Config(), world=world, device="cpu")


def resealed_and_resumed(folder: Path) -> object:
    """The same, with the right sizes and checksums of what somebody changed."""
    path = folder / MANIFEST
    good = path.read_bytes()
    reseal(folder)
    try:
        return resumed(folder)
    finally:
        path.write_bytes(good)


def benched(folder: Path) -> None:
    """A row of a benchmark."""
    provenance = Provenance("geogs run", "0123456", "machine", "cpu", 0, "0123456789ab")
    write_json(folder / "bench.json", Record("room", "a", "fast", "a", provenance, Cost(3.0)))
    write_completed_run(folder, CompletedRun(str(folder), provenance, Cost(3.0)))


def records(folder: Path) -> object:
    """That row, and whether the run behind it is complete."""
    found = read_record(folder / "bench.json")
    return found and asdict(found), completed_run(folder, folder, "0123456789ab")
