"""Settings of the training of the flow network."""

from dataclasses import dataclass, field
from typing import Annotated

from geogs.config.setting import Count, Fraction, Range, Weight
from geogs.tracking.flow.own_options import NetworkOptions
from geogs_synth.clips.room_options import RoomOptions, SceneWeights
from geogs_train.training_options import TrainingSchedule


@dataclass(frozen=True)
class FlowTraining(TrainingSchedule):
    """Settings of the training of the flow network."""

    batch: Count = 16
    """Number of clips per step and device."""
    rooms: RoomOptions = field(
        default_factory=lambda: RoomOptions(
            width=416, height=288, scenes=SceneWeights(0.5, 0.12, 0.08, 0.08, 0.04, 0.18)
        )
    )
    """The rooms and their clips; every ordered pair of neighbouring views is an edge."""
    far: Fraction = 0.2
    """Fraction of the edges, besides those that start at zero motion, with starts wrong by 16 to 64
    pixels."""
    iterations: Count = 6
    """Number of iterations of the network per edge."""
    decay: Annotated[float, Range(1e-9, 1)] = 0.8
    """Weight of an iteration's loss relative to that of the next."""
    absolute: Weight = 0.3
    """Weight of log(1 + absolute error in pixels) of the cells, relative to its likelihood."""
    dense: Weight = 0.5
    """Weight of log(1 + absolute error in pixels) of the upsampled flow."""
    descriptors: Weight = 0.3
    """Weight of the cross-entropy between correlation windows and the true position in them."""
    occluded: Weight = 0.3
    """Weight of occluded cells, relative to visible ones."""
    network: NetworkOptions = field(default_factory=NetworkOptions)
