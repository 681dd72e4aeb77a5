"""Settings of the training of the flow network."""

from dataclasses import dataclass, field
from typing import Literal

from geogs.tracking.flow.own_options import NetworkOptions
from geogs_train.rooms.options import RoomOptions


@dataclass(frozen=True)
class BundleTraining:
    """The second stage, through the dense bundle adjustment."""

    rounds: int = 3
    """Of flow and adjustment."""
    reach: int = 2
    """Views of a clip at most so far apart are matched."""
    pose: float = 10.0
    """Weight of the error of relative poses, median depths plus radians."""
    flow: float = 0.05
    """Weight of the error of the flow that poses and depths induce, pixels."""
    likelihood: float = 0.3
    """Weight of the likelihood of the network's own flow."""


@dataclass(frozen=True)
class FlowTraining:
    """What a training run does; saved with every checkpoint."""

    stage: Literal["flow", "bundle"] = "flow"
    """Pairs of views with exact flow, or clips through the dense bundle adjustment."""
    steps: int = 20_000
    """Steps of the whole run; the learning rate ends at zero with the last."""
    batch: int = 16
    """Clips per step and device."""
    rooms: RoomOptions = field(default_factory=lambda: RoomOptions(width=416, height=288))
    """What the clips show; every ordered pair of neighbouring views is an edge."""
    iterations: int = 6
    """Of the network per edge."""
    learning_rate: float = 8e-4
    """Peak, reached after the warm-up."""
    warmup: int = 300
    """Steps in which the learning rate grows from zero."""
    weight_decay: float = 1e-4
    clip: float = 1.0
    """Largest norm of a gradient."""
    ema: float = 0.999
    """Decay of the running mean of the weights, which is what is validated and shipped."""
    decay: float = 0.8
    """Weight of an iteration's loss relative to the next."""
    likelihood: Literal["joint", "separate"] = "joint"
    """Whether the likelihood of the error trains the flow, too, or an absolute error does."""
    absolute: float = 0.3
    """Weight of log(1 + absolute error in pixels) beside a joint likelihood."""
    dense: float = 0.5
    """Weight of the same of the upsampled flow after the last iteration."""
    descriptors: float = 0.3
    """Weight of the cross-entropy between correlation windows and where the truth lies in them."""
    occluded: float = 0.3
    """Weight of cells that the other view does not see, relative to those that it sees."""
    seed: int = 0
    bundle: BundleTraining = field(default_factory=BundleTraining)
    network: NetworkOptions = field(default_factory=NetworkOptions)


@dataclass(frozen=True)
class RunOptions:
    """How a run is watched and when it pauses."""

    validate_every: int = 1000
    """Steps between validations, each with a checkpoint."""
    validation_batches: int = 8
    minutes: float = float("inf")
    """The run stops with a checkpoint after so many minutes; it goes on with ``resume``."""
    resume: bool = False
    """Go on from the checkpoint in the output folder, with its settings."""
    begin_with: str = ""
    """Weights file to begin with; "" for random ones."""
    fuse: bool = False
    """Whether the network is compiled; worth its minute on a GPU."""
