"""Settings of the training of the flow network."""

from dataclasses import dataclass, field
from typing import Annotated

from geogs.config.setting import Count, Fraction, Range, Weight
from geogs.tracking.flow.own_options import NetworkOptions
from geogs_synth.clips.room_options import RoomOptions, SceneWeights
from geogs_train.training_options import TrainingSchedule


@dataclass(frozen=True)
class FlowTraining(TrainingSchedule):
    """What a training run of the flow network does."""

    batch: Count = 16
    """Clips per step and device."""
    rooms: RoomOptions = field(
        default_factory=lambda: RoomOptions(
            width=416, height=288, scenes=SceneWeights(0.5, 0.12, 0.08, 0.08, 0.04, 0.18)
        )
    )
    """What the clips show; every ordered pair of neighbouring views is an edge."""
    far: Fraction = 0.2
    """Fraction of the edges, beside those from nothing, whose start is off by 16 to 64 pixels."""
    iterations: Count = 6
    """Iterations of the network per edge."""
    decay: Annotated[float, Range(1e-9, 1)] = 0.8
    """Weight of an iteration's loss relative to the next."""
    absolute: Weight = 0.3
    """Weight of log(1 + absolute error in pixels) beside the likelihood of the error."""
    dense: Weight = 0.5
    """Weight of the same of the upsampled flow after the last iteration."""
    descriptors: Weight = 0.3
    """Weight of the cross-entropy between correlation windows and where the truth lies in them."""
    occluded: Weight = 0.3
    """Weight of cells that the other view does not see, relative to those that it sees."""
    network: NetworkOptions = field(default_factory=NetworkOptions)
