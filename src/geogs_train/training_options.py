"""Common settings of the training of all networks."""

from dataclasses import dataclass
from typing import Annotated

from geogs.config import Seed
from geogs.config.setting import Count, Positive, Range, Settings, Weight


@dataclass(frozen=True)
class TrainingSchedule(Settings, group="training"):
    """What a training run does, whatever it trains; saved with every checkpoint."""

    steps: Annotated[int, Range(1)] = 20_000
    """Steps of the whole run; the learning rate ends at zero with the last."""
    learning_rate: Positive = 8e-4
    """Peak, reached after the warm-up."""
    warmup: Count = 300
    """Steps in which the learning rate grows from zero."""
    weight_decay: Weight = 1e-4
    """Weight decay of AdamW."""
    clip: Positive = 1.0
    """Largest norm of a gradient."""
    ema: Annotated[float, Range(0, below=1)] = 0.999
    """Decay of the running mean of the weights, which is what is validated and shipped."""
    seed: Seed = 0
    """Seed of everything random."""


@dataclass(frozen=True)
class TrainingRunOptions(Settings, group="run"):
    """How a run is watched and when it pauses."""

    validate_every: Count = 1000
    """Steps between validations, each with a checkpoint."""
    validation_batches: Count = 8
    minutes: Annotated[float | None, Range(above=0)] = None
    """The run stops with a checkpoint after so many minutes, if any; it goes on with ``resume``."""
    paced: bool = False
    """Whether the run is as long as its minutes instead of its steps: the learning rate ends at
    zero with the last minute. How many steps that are depends on the machine, and a run that goes
    on has its minutes again for what was left."""
    resume: bool = False
    """Go on from the checkpoint in the output folder, with its settings."""
    begin_with: str = ""
    """Weights file to begin with; "" for random ones."""
    fuse: bool = False
    """Whether the network is compiled; worth its minute on a GPU."""
