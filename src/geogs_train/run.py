"""A training run from the first step or a checkpoint to its end: validation, curves, weights."""

import json
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import distributed

from geogs.errors import GeogsError
from geogs_train.checkpoint import load_checkpoint, save_checkpoint
from geogs_train.course import Course, Examination, Scores, Worker
from geogs_train.options import RunOptions
from geogs_train.trainer import Trainer

LOG = "log.jsonl"
REPORT_EVERY = 50
"""Steps between lines of the log."""


Progress = Callable[[str], None]
"""Called with a line of text."""


def train(
    course: Course, run: RunOptions, out: Path, worker: Worker, progress: Progress
) -> Scores | None:
    """Train until the last step or the last minute; returns the last validation's scores.

    The first worker writes ``checkpoint.safetensors``, ``log.jsonl`` and the course's weights
    (their running mean in half precision) to ``out``. Ctrl-C ends it as the last minute does.

    Raises:
        GeogsError: the weights are no longer finite.
    """
    begin = time.monotonic()
    trainer, options = Trainer(course, worker, run.fuse), course.options
    if run.begin_with:
        trainer.begin_with(course.load(Path(run.begin_with)))
    if run.resume:
        load_checkpoint(trainer, out)
    first = worker.rank == 0
    validation = course.examination(run.validation_batches) if first else None
    out.mkdir(parents=True, exist_ok=True)
    scores, since, at = None, time.monotonic(), trainer.step
    try:
        while trainer.step < options.steps:
            loss = trainer.advance()
            if trainer.step % REPORT_EVERY == 0:
                value, now = float(loss), time.monotonic()
                if not trainer.is_finite():
                    raise GeogsError(f"The weights are no longer finite at step {trainer.step}.")
                rate = (trainer.step - at) / (now - since)
                since, at = now, trainer.step
                if first:
                    left = (options.steps - trainer.step) / rate / 60
                    _log(out, {"step": trainer.step, "loss": value, "rate": rate})
                    progress(f"step {trainer.step}/{options.steps}  loss {value:.3f}  "
                             f"{rate:.1f} steps/s  {left:.0f} min left")  # fmt: skip
                if _all(worker, run.minutes is not None and now - begin > 60 * run.minutes):
                    break
            if trainer.step % run.validate_every == 0 and validation is not None:
                scores = _validate(trainer, validation, out, progress)
                save_checkpoint(trainer, out)
                since, at = time.monotonic(), trainer.step
    except KeyboardInterrupt:
        progress("interrupted; writing what there is")
    finally:
        course.close()
    if validation is not None:
        scores = _validate(trainer, validation, out, progress)
        save_checkpoint(trainer, out)
        course.export(trainer.mean, out / course.weights, trainer.step, scores)
    return scores


def _validate(trainer: Trainer, validation: Examination, out: Path, progress: Progress) -> Any:
    scores = validation.score(trainer.mean)
    _log(out, {"step": trainer.step, "scores": asdict(scores)})
    progress(f"validation at step {trainer.step}: {scores.line()}")
    return scores


def _all(worker: Worker, here: bool) -> bool:
    """Whether the first worker says so; all must stop at the same step."""
    if worker.count == 1:
        return here
    flag = torch.tensor([float(here)], device=worker.device)
    distributed.broadcast(flag, 0)
    return bool(flag.item())


def _log(out: Path, entry: dict) -> None:
    with (out / LOG).open("a") as file:
        file.write(json.dumps(entry) + "\n")
