"""``geogs train``: trains the shipped networks."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from geogs.cli.options import parse_options
from geogs.config.setting import Positional, Settings
from geogs_train.depth.depth_options import DepthTraining
from geogs_train.flow.flow_options import FlowTraining
from geogs_train.training_options import TrainingRunOptions


@dataclass(frozen=True)
class _TrainOptions(Settings):
    """Options of the training of all networks."""

    network: Annotated[Literal["flow", "depth"], Positional()]
    """Network to train."""
    output: Annotated[Path, Positional()]
    """Folder to write."""
    device: str = "auto"
    """auto (a GPU where there is one), cpu, cuda or cuda:1."""
    run: TrainingRunOptions = field(default_factory=TrainingRunOptions)


@dataclass(frozen=True)
class TrainOptions(_TrainOptions):
    """Trains the flow network on random rooms that are rendered on the fly.

    Writes checkpoint.safetensors (--run.resume continues from it), log.jsonl, curves.png and
    flow.safetensors. geogs train depth OUTPUT trains the depth network (geogs train depth --help).
    On several GPUs:
    torchrun --nproc-per-node N -m geogs.cli.main train flow OUTPUT
    """

    network: Annotated[Literal["flow"], Positional()]
    training: FlowTraining = field(default_factory=FlowTraining)


@dataclass(frozen=True)
class TrainDepthOptions(_TrainOptions):
    """Trains the multi-view depth network on random rooms that are rendered on the fly.

    Writes checkpoint.safetensors (--run.resume continues from it), log.jsonl, curves.png and
    depth.safetensors. On several GPUs:
    torchrun --nproc-per-node N -m geogs.cli.main train depth OUTPUT
    """

    network: Annotated[Literal["depth"], Positional()]
    training: DepthTraining = field(default_factory=DepthTraining)


def main(argv: Sequence[str]) -> int:
    """Run the command; return the exit code."""
    options: TrainOptions | TrainDepthOptions
    if "depth" in argv[:1]:
        options = parse_options(TrainDepthOptions, argv, "train")
    else:
        options = parse_options(TrainOptions, argv, "train")

    from geogs_train.launch import launch

    launch(options.training, options.run, options.output, options.device)
    return 0
