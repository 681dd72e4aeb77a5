"""A training run from the first step or a checkpoint to its end: validation, curves, weights."""

import json
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

from geogs.errors import GeogsError, InputError
from geogs.guard.terminal_text import say
from geogs_train.course import Worker
from geogs_train.depth.depth_validation import DepthValidation
from geogs_train.flow.flow_validation import SceneValidation
from geogs_train.network_trainer import Course, NetworkTrainer
from geogs_train.training_checkpoint import load_checkpoint, save_checkpoint
from geogs_train.training_options import TrainingRunOptions

LOG = "log.jsonl"
REPORT_EVERY = 50
"""Steps between lines of the log."""
CLOCK_EVERY = 10
"""Steps between readings of the clock; each waits for the device."""


class Clock:
    """Finished fraction of a run of given minutes; the fraction ``begun`` was done before."""

    def __init__(self, minutes: float, begun: float, worker: Worker) -> None:
        self._seconds = 60 * minutes
        self._begun = begun
        self._worker = worker
        self._start = time.monotonic()

    def progress(self) -> float:
        """0 to 1, by the clock of the first worker."""
        done = min((time.monotonic() - self._start) / self._seconds, 1.0)
        return self._worker.shared(self._begun + (1 - self._begun) * done)


def train(course: Course, run: TrainingRunOptions, out: Path, worker: Worker) -> None:
    """Train until the last step or the last minute.

    The first worker writes ``checkpoint.safetensors``, ``log.jsonl`` and the course's weights
    (their running mean in half precision) to ``out``. Ctrl-C ends it like the last minute.

    Raises:
        InputError: the run is paced, but has no minutes.
        GeogsError: the weights are no longer finite.
    """
    begin = time.monotonic()
    if run.paced and run.minutes is None:
        raise InputError("A paced run needs --run.minutes.")
    trainer = NetworkTrainer(course, worker, run.fuse, run.paced)
    if run.begin_with:
        trainer.begin_with(course.load(Path(run.begin_with)))
    if run.resume:
        load_checkpoint(trainer, out)
    first = worker.rank == 0
    validation = course.validation(run.validation_batches) if first else None
    out.mkdir(parents=True, exist_ok=True)
    since = time.monotonic()
    at = trainer.step
    clock = Clock(run.minutes, trainer.progress, worker) if run.paced and run.minutes else None
    try:
        while trainer.progress < 1:
            if clock is not None and trainer.step % CLOCK_EVERY == 0:
                trainer.progress = clock.progress()
            loss = trainer.advance()
            if trainer.step % REPORT_EVERY == 0:
                value = float(loss)
                now = time.monotonic()
                if not trainer.is_finite():
                    raise GeogsError(f"The weights are no longer finite at step {trainer.step}.")
                rate = (trainer.step - at) / (now - since)
                since = now
                at = trainer.step
                if first:
                    entry = {"step": trainer.step, "loss": value, "rate": rate}
                    _log(out, {**entry, "minutes": (now - begin) / 60})
                    say(
                        f"step {trainer.step}  {100 * trainer.progress:.0f} %  "
                        f"loss {value:.3f}  {rate:.1f} steps/s"
                    )
                late = run.minutes is not None and now - begin > 60 * run.minutes
                if clock is None and worker.shared(late):
                    break
            if trainer.step % run.validate_every == 0 and validation is not None:
                _save(trainer, validation, out)
                since = time.monotonic()
                at = trainer.step
    except KeyboardInterrupt:
        say("interrupted; writing what there is")
    finally:
        course.close()
    if validation is not None:
        _save(trainer, validation, out)


def _save(
    trainer: NetworkTrainer, validation: SceneValidation | DepthValidation, out: Path
) -> None:
    """Validate, and write the checkpoint and the weights."""
    scores: Any = validation.score(trainer.mean)
    _log(out, {"step": trainer.step, "scores": asdict(scores)})
    say(f"validation at step {trainer.step}: {scores.line()}")
    save_checkpoint(trainer, out)
    trainer.course.export(trainer.mean, out / trainer.course.weights, trainer.step, scores)


def _log(out: Path, entry: dict[str, Any]) -> None:
    with (out / LOG).open("a") as file:
        file.write(json.dumps(entry) + "\n")
