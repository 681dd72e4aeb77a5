"""``geogs train``: makes the networks that are shipped."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from geogs.cli.options import parse_options
from geogs.config.setting import Positional
from geogs_train.options import FlowTraining
from geogs_train.run import RunOptions


@dataclass(frozen=True)
class TrainOptions:
    """Trains the flow network on random rooms that are made on the fly.

    OUTPUT gets checkpoint/ (to go on with --run.resume), log.jsonl, curves.png and
    flow.safetensors. On several GPUs:
    torchrun --nproc-per-node N -m geogs.cli.main train flow OUTPUT
    """

    network: Annotated[Literal["flow"], Positional()]
    """What to train."""
    output: Annotated[Path, Positional()]
    """Folder to write."""
    device: str = "auto"
    """auto, cpu or cuda."""
    run: RunOptions = field(default_factory=RunOptions)
    training: FlowTraining = field(default_factory=FlowTraining)


def main(argv: Sequence[str]) -> int:
    """Runs the command; returns the exit code."""
    options = parse_options(TrainOptions, argv, "train")

    import torch

    from geogs_train.checkpoint import read_options
    from geogs_train.curves import draw_curves
    from geogs_train.run import train_flow
    from geogs_train.trainer import Worker

    worker = Worker(_device(options.device), *(int(os.environ.get(n, d)) for n, d in _PROCESSES))
    if worker.count > 1:
        torch.cuda.set_device(worker.device)
        torch.distributed.init_process_group("nccl", device_id=worker.device)
    training = read_options(options.output) if options.run.resume else options.training
    try:
        train_flow(training, options.run, options.output, worker, _say)
    finally:
        if worker.count > 1:
            torch.distributed.destroy_process_group()
    if worker.rank == 0:
        draw_curves(options.output)
    return 0


_PROCESSES = (("RANK", "0"), ("WORLD_SIZE", "1"))
"""Where torchrun says which of how many processes this is."""


def _device(name: str):  # type: ignore[no-untyped-def]
    import torch

    from geogs.errors import DeviceError

    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda" and not torch.cuda.is_available():
        raise DeviceError("There is no GPU that PyTorch can use; train with --device cpu.")
    if name == "cuda":
        return torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))
    return torch.device(name)


def _say(line: str) -> None:
    print(line, flush=True)
