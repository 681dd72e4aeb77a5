"""Common settings of the training of all networks."""

from dataclasses import dataclass
from typing import Annotated

from geogs.config import Seed
from geogs.config.setting import Count, Positive, Range, Settings, Weight


@dataclass(frozen=True)
class TrainingSchedule(Settings, group="training"):
    """Settings of the training of every network, saved with each checkpoint."""

    steps: Annotated[int, Range(1)] = 20_000
    """Number of steps of the whole run; the learning rate falls to nearly zero at the last."""
    learning_rate: Positive = 8e-4
    """Largest learning rate, reached after the warm-up."""
    warmup: Count = 300
    """Number of first steps over which the learning rate grows from zero."""
    weight_decay: Weight = 1e-4
    """Weight decay of AdamW."""
    clip: Positive = 1.0
    """Largest norm of the gradient; a longer one is scaled down to it."""
    ema: Annotated[float, Range(0, below=1)] = 0.999
    """Decay per step of the running mean of the weights, which is validated and shipped."""
    seed: Seed = 0
    """Seed of all random numbers."""


@dataclass(frozen=True)
class TrainingRunOptions(Settings, group="run"):
    """Validation, duration and start of a run."""

    validate_every: Count = 1000
    """Steps between validations; each writes a checkpoint."""
    validation_batches: Count = 8
    """Number of batches of the validation set."""
    minutes: Annotated[float | None, Range(above=0)] = None
    """Minutes after which the run stops with a checkpoint, from which ``resume`` continues."""
    paced: bool = False
    """Whether ``minutes`` instead of ``steps`` set the length of the run, and with it the learning
    rate. The number of steps then depends on the machine. A resumed run spends the same minutes on
    the rest."""
    resume: bool = False
    """Whether to continue from the checkpoint in the output folder, with its settings."""
    begin_with: str = ""
    """File of the first weights; "" for random weights."""
    fuse: bool = False
    """Whether the network is compiled: that takes a minute and makes steps on a GPU faster."""
