"""Settings of the training of the depth network."""

from dataclasses import dataclass, field
from typing import Annotated

from geogs.config.setting import Count, Fraction, Positive, Range, Settings, Weight
from geogs.depth.network.network_sizes import DepthNetworkOptions
from geogs_synth.clips.room_options import MotionWeights, RoomOptions
from geogs_train.training_options import TrainingSchedule


@dataclass(frozen=True)
class PoolOptions(Settings, group="training.pool"):
    """Clips that are kept on the device; each step draws its keyframes from them."""

    plans: Count = 64
    """Batches of rooms that are there at once."""
    rooms: Count = 16
    """Rooms of a batch, a clip each."""
    refresh: Count = 4
    """Steps after which another batch takes the place of the oldest."""


@dataclass(frozen=True)
class TupleOptions(Settings, group="training.tuples"):
    """Which views make a sample, and what is wrong with what is known of them."""

    least_neighbours: Annotated[int, Range(1, 16)] = 3
    """Fewest neighbours; their number is that of a whole batch."""
    most_neighbours: Annotated[int, Range("least_neighbours", 16)] = 8
    """Most neighbours."""
    least_baseline: Positive = 0.015
    """Baseline over the median depth from which on a view is a good neighbour."""
    most_baseline: Annotated[float, Range(above="least_baseline", most=10)] = 0.5
    """Baseline over the median depth up to which it is."""
    dud: Fraction = 0.05
    """Fraction of the neighbours that show another room."""
    missing: Fraction = 0.05
    """Fraction of the neighbours that are not there."""
    disturbed: Fraction = 0.5
    """Fraction of the keyframes whose neighbours' poses are wrong."""
    rotation: tuple[Annotated[float, Range(0, 10)], ...] = (0.02, 0.3)
    """Range of the deviation of a wrong pose's rotation about each axis, degrees."""
    translation: tuple[Annotated[float, Range(0, 1)], ...] = (0.003, 0.05)
    """Range of the deviation of its translation along each axis, over the baseline."""
    focal: Fraction = 0.01
    """Largest relative error of the focal length, in as many."""
    photometric: Weight = 0.5
    """Strength of what each view's light and colours are changed by, beside the camera's flaws."""
    typical_error: tuple[Positive, ...] = (0.75, 1.35)
    """Range of the factor on the median depth that is known."""
    range_error: tuple[Positive, ...] = (0.7, 1.6)
    """Range of the factors by which either end of the search lies beyond what it should be."""


@dataclass(frozen=True)
class DepthLossOptions(Settings, group="training.loss"):
    """Weights of the parts of the loss."""

    edges: Weight = 2.0
    """How much more the pixels near jumps of depth count."""
    choice: Weight = 0.1
    """Weight of the cross-entropy of the depths that are tried near what the planes say."""
    gradient: Weight = 0.5
    """Weight of differences of log depth at four scales."""
    bent: Weight = 0.5
    """Weight of the normals of depth."""
    normal: Weight = 0.5
    """Weight of the angle between normals, radians."""
    spread: Weight = 0.05
    """Weight of the normals' likelihood, which only their concentration learns from."""
    planes: Weight = 0.2
    """Weight of the cross-entropy of the planes."""
    scores: Weight = 0.1
    """Weight of the same of the scores before the keyframe's context joins them."""
    likelihood: Weight = 0.1
    """Weight of the likelihood of depth, which only deviation and outliers learn from."""
    agreement: Weight = 0.1
    """Weight of what normals and normals of depth differ by."""
    late: Fraction = 0.05
    """Fraction of the run after which the likelihoods count."""


@dataclass(frozen=True)
class DepthTraining(TrainingSchedule):
    """What a training run of the depth network does."""

    steps: Annotated[int, Range(1)] = 12_000
    learning_rate: Positive = 6e-4
    weight_decay: Weight = 1e-2
    batch: Count = 12
    """Keyframes per step and device."""
    small_batch: Count = 24
    """The same in the steps with small images."""
    small: Fraction = 0.6
    """Fraction of the run, its first, with small images."""
    rooms: RoomOptions = field(
        default_factory=lambda: RoomOptions(
            width=512,
            height=352,
            views=9,
            sway=0.25,
            least_density=0.05,
            most_density=0.8,
            thin=0.9,
            motions=MotionWeights(0.3, 0.35, 0.12, 0.05, 0.18),
        )
    )
    """What the clips show."""
    small_width: Annotated[int, Range(16, 8192)] = 320
    """Width of the small images, pixels."""
    small_height: Annotated[int, Range(16, 8192)] = 224
    """Height of the small images, pixels."""
    pool: PoolOptions = field(default_factory=PoolOptions)
    tuples: TupleOptions = field(default_factory=TupleOptions)
    loss: DepthLossOptions = field(default_factory=DepthLossOptions)
    network: DepthNetworkOptions = field(default_factory=DepthNetworkOptions)
