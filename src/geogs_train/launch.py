"""A training as one of the processes that torchrun starts, or alone."""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from torch import distributed

from geogs.gpu.installation import require_device
from geogs_train.course import Course, Worker
from geogs_train.depth.depth_course import DepthCourse
from geogs_train.depth.depth_options import DepthTraining
from geogs_train.flow.flow_course import FlowCourse
from geogs_train.flow.flow_options import FlowTraining
from geogs_train.pace import shared
from geogs_train.training_checkpoint import read_options
from geogs_train.training_curves import draw_curves
from geogs_train.training_options import TrainingRunOptions
from geogs_train.training_run import train


def launch(
    training: FlowTraining | DepthTraining,
    run: TrainingRunOptions,
    out: Path,
    device: str,
    progress: Callable[[str], None],
) -> None:
    """Train, and draw the curves; a run that is gone on with keeps its settings.

    Raises:
        InputError: there is nothing to go on from.
        DeviceError: the device cannot be used.
    """
    with _worker(device) as worker:
        if run.resume:
            training = read_options(out, type(training))
        course = course_of(training, worker)
        train(course, run, out, worker, progress)
        shared(0.0, worker)  # nobody leaves before the first has written everything
    if worker.rank == 0:
        draw_curves(out, course.curves)


def course_of(training: FlowTraining | DepthTraining, worker: Worker) -> Course:
    """What the settings ask for."""
    if isinstance(training, DepthTraining):
        return DepthCourse(training, worker)
    return FlowCourse(training, worker)


@contextmanager
def _worker(device: str) -> Iterator[Worker]:
    """This process among the others, if there are any; each has the GPU of its number."""
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
