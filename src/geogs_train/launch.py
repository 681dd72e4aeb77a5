"""A training, as one of torchrun's processes or alone."""

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import distributed

from geogs.gpu.installation import require_device
from geogs_train.course import Panels, Worker
from geogs_train.depth.depth_course import DepthCourse
from geogs_train.depth.depth_options import DepthTraining
from geogs_train.flow.flow_course import FlowCourse
from geogs_train.flow.flow_options import FlowTraining
from geogs_train.network_trainer import Course
from geogs_train.training_checkpoint import read_options
from geogs_train.training_options import TrainingRunOptions
from geogs_train.training_run import LOG, train


def launch(
    training: FlowTraining | DepthTraining, run: TrainingRunOptions, out: Path, device: str
) -> None:
    """Train, and draw the curves; a resumed run keeps its settings.

    Raises:
        InputError: there is nothing to resume.
        DeviceError: the device cannot be used.
    """
    with _worker(device) as worker:
        if run.resume:
            training = read_options(out, type(training))
        course = course_of(training, worker)
        train(course, run, out, worker)
        worker.shared(0.0)  # no process ends before the first has written everything
    if worker.rank == 0:
        draw_curves(out, course.curves)


def course_of(training: FlowTraining | DepthTraining, worker: Worker) -> Course:
    """Make the course of these settings."""
    if isinstance(training, DepthTraining):
        return DepthCourse(training, worker)
    return FlowCourse(training, worker)


@contextmanager
def _worker(device: str) -> Iterator[Worker]:
    """This process among the others, if there are any; each has the GPU of its local rank."""
    rank, count = (int(os.environ.get(n, d)) for n, d in (("RANK", "0"), ("WORLD_SIZE", "1")))
    used = require_device(device)
    if used.type == "cuda":
        used = torch.device("cuda", int(os.environ.get("LOCAL_RANK", used.index or 0)))
    if count == 1:
        yield Worker(used)
        return
    if used.type == "cuda":
        torch.cuda.set_device(used)
        distributed.init_process_group("nccl", device_id=used)
    else:
        distributed.init_process_group("gloo")
    try:
        yield Worker(used, rank, count)
    finally:
        distributed.destroy_process_group()


def draw_curves(out: Path, panels: Panels) -> None:
    """Draw ``curves.png`` from the log of a run: the loss, then the panels of scores.

    Nested scores have names with dots; those that a run does not have are left out."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    entries = [json.loads(line) for line in (out / LOG).read_text().splitlines()]
    losses = [e for e in entries if "loss" in e]
    scores = [e for e in entries if "scores" in e]
    width = 13 / 3 * (1 + len(panels))
    figure, axes = plt.subplots(1, 1 + len(panels), figsize=(width, 3.6), layout="constrained")
    axes[0].plot([e["step"] for e in losses], [e["loss"] for e in losses], linewidth=0.7)
    axes[0].set_title("training loss")
    steps = [e["step"] for e in scores]
    for axis, (title, names, logarithmic) in zip(axes[1:], panels, strict=True):
        for name in names:
            values = [_score(e["scores"], name) for e in scores]
            if any(v is not None for v in values):
                axis.plot(steps, values, label=name.split(".", 1)[-1])
        if logarithmic:
            axis.set_yscale("log")
        if any(name.endswith("within") for name in names):
            axis.axhline(0.95, color="grey", linewidth=0.7)
        axis.set_title(title)
        axis.legend()
    for axis in axes:
        axis.set_xlabel("steps")
        axis.grid(alpha=0.3)
    figure.savefig(out / "curves.png", dpi=120)
    plt.close(figure)


def _score(scores: dict[str, Any], name: str) -> float | None:
    """The score of a name with dots; None if there is none."""
    found: Any = scores
    for part in name.split("."):
        found = found.get(part) if isinstance(found, dict) else None
    return found
