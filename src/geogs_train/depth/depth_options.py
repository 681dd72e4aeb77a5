"""Settings of the training of the depth network."""

from dataclasses import dataclass, field
from typing import Annotated

from geogs.config.setting import Count, Fraction, Positive, Range, Settings, Weight
from geogs.depth.network.network_sizes import DepthNetworkOptions
from geogs_synth.clips.room_options import MotionWeights, RoomOptions
from geogs_train.training_options import TrainingSchedule


@dataclass(frozen=True)
class PoolOptions(Settings, group="training.pool"):
    """The pool of clips kept on the device, from which each step draws its keyframes."""

    plans: Count = 64
    """Number of batches of clips in the pool."""
    rooms: Count = 16
    """Number of clips in a batch, each of another room."""
    refresh: Count = 4
    """Steps after which a new batch replaces the oldest."""


@dataclass(frozen=True)
class TupleOptions(Settings, group="training.tuples"):
    """Choice of the views of a sample, and the errors of their poses, lens, light and depths."""

    least_neighbours: Annotated[int, Range(1, 16)] = 3
    """Least number of neighbours of a keyframe; all keyframes of a batch have as many."""
    most_neighbours: Annotated[int, Range("least_neighbours", 16)] = 8
    """Largest number of neighbours of a keyframe."""
    least_baseline: Positive = 0.015
    """Least baseline of a good neighbour, over the median depth."""
    most_baseline: Annotated[float, Range(above="least_baseline", most=10)] = 0.5
    """Largest baseline of a good neighbour, over the median depth."""
    dud: Fraction = 0.05
    """Fraction of the neighbours that show another room."""
    missing: Fraction = 0.05
    """Fraction of the neighbours that are missing."""
    disturbed: Fraction = 0.5
    """Fraction of the keyframes whose neighbours' poses are wrong; as many have a wrong lens."""
    rotation: tuple[Annotated[float, Range(0, 10)], ...] = (0.02, 0.3)
    """Range of the standard deviation of the rotation error about each axis, degrees."""
    translation: tuple[Annotated[float, Range(0, 1)], ...] = (0.003, 0.05)
    """Range of the standard deviation of the translation error per axis, over the baseline."""
    focal: Fraction = 0.01
    """Largest relative error of a wrong focal length."""
    photometric: Weight = 0.5
    """Strength of the changes of exposure, colour and noise of a view, on top of the camera's."""
    typical_error: tuple[Positive, ...] = (0.75, 1.35)
    """Range of the factor by which the given median depth is wrong."""
    range_error: tuple[Positive, ...] = (0.7, 1.6)
    """Range of the factor by which either end of the search range is too far out."""


@dataclass(frozen=True)
class DepthLossOptions(Settings, group="training.loss"):
    """Weights of the parts of the loss."""

    edges: Weight = 2.0
    """Additional weight of pixels near depth discontinuities."""
    choice: Weight = 0.1
    """Weight of the cross-entropy of the depths tried in the fine search at 1/2."""
    gradient: Weight = 0.5
    """Weight of the errors of log-depth differences at four scales."""
    bent: Weight = 0.5
    """Weight of the normals that follow from the estimated depth."""
    normal: Weight = 0.5
    """Weight of the angle between estimated and true normals, radians."""
    spread: Weight = 0.05
    """Weight of the likelihood of the normals, which trains their concentration only."""
    planes: Weight = 0.2
    """Weight of the cross-entropy of the final scores of the planes."""
    scores: Weight = 0.1
    """Weight of the cross-entropy of the planes' scores before the keyframe's context is added."""
    likelihood: Weight = 0.1
    """Weight of the likelihood of depth, which trains its deviation and outliers only."""
    agreement: Weight = 0.1
    """Weight of the difference between the estimated normals and those of the estimated depth."""
    late: Fraction = 0.05
    """Fraction of the run before the likelihoods count."""


@dataclass(frozen=True)
class DepthTraining(TrainingSchedule):
    """Settings of the training of the depth network."""

    steps: Annotated[int, Range(1)] = 12_000
    learning_rate: Positive = 6e-4
    weight_decay: Weight = 1e-2
    batch: Count = 12
    """Number of keyframes per step and device."""
    small_batch: Count = 24
    """Number of keyframes per step and device while images are small."""
    small: Fraction = 0.6
    """Fraction of the run, at its start, with small images."""
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
    """The rooms and the clips filmed in them."""
    small_width: Annotated[int, Range(16, 8192)] = 320
    """Width of the small images, pixels."""
    small_height: Annotated[int, Range(16, 8192)] = 224
    """Height of the small images, pixels."""
    pool: PoolOptions = field(default_factory=PoolOptions)
    tuples: TupleOptions = field(default_factory=TupleOptions)
    loss: DepthLossOptions = field(default_factory=DepthLossOptions)
    network: DepthNetworkOptions = field(default_factory=DepthNetworkOptions)
