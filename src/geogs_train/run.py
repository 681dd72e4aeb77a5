"""A training run from the first step or a checkpoint to its end: validation, curves, weights."""

import json
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import torch
from torch import distributed

from geogs.errors import GeogsError
from geogs.tracking.flow.own import load_network
from geogs_train.checkpoint import load_checkpoint, save_checkpoint
from geogs_train.export import export_weights
from geogs_train.options import FlowTraining, RunOptions
from geogs_train.scores import FlowScores
from geogs_train.trainer import FlowTrainer, Worker
from geogs_train.validation import Validation

LOG = "log.jsonl"
REPORT_EVERY = 50
"""Steps between lines of the log."""


Progress = Callable[[str], None]
"""Called with a line of text."""


def train_flow(
    options: FlowTraining, run: RunOptions, out: Path, worker: Worker, progress: Progress
) -> FlowScores | None:
    """Train until the last step or the last minute; returns the last validation's scores.

    The first worker writes ``checkpoint.safetensors``, ``log.jsonl`` and ``flow.safetensors`` (the
    running mean of the weights in half precision) to ``out``. Ctrl-C ends it as the last minute
    does.

    Raises:
        GeogsError: the weights are no longer finite.
    """
    begin = time.monotonic()
    trainer = FlowTrainer(options, worker, run.fuse)
    if run.begin_with:
        trainer.begin_with(load_network(Path(run.begin_with)))
    if run.resume:
        load_checkpoint(trainer, out)
    first = worker.rank == 0
    validation = Validation(options, worker.device, run.validation_batches) if first else None
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
                if _all(worker, now - begin > 60 * run.minutes):
                    break
            if trainer.step % run.validate_every == 0 and validation is not None:
                scores = _validate(trainer, validation, out, progress)
                save_checkpoint(trainer, out)
                since, at = time.monotonic(), trainer.step
    except KeyboardInterrupt:
        progress("interrupted; writing what there is")
    finally:
        trainer.close()
    if validation is not None:
        scores = _validate(trainer, validation, out, progress)
        save_checkpoint(trainer, out)
        export_weights(trainer.mean, out / "flow.safetensors", trainer.step, scores)
    return scores


def _validate(
    trainer: FlowTrainer, validation: Validation, out: Path, progress: Progress
) -> FlowScores:
    scores = validation.score(trainer.mean, trainer.options.iterations)
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
