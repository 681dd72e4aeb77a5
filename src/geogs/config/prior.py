"""Settings of the monocular priors."""

from dataclasses import dataclass
from typing import Annotated

from geogs.config.setting import Basic, Count, Positive, Range, Settings


@dataclass(frozen=True)
class PriorConfig(Settings, group="prior"):
    """Depth and normals that a network guesses from single keyframes; without a model, none.

    How far depth counts follows from the deviations below: beside a match whose inverse depth has
    the variance 1 / sum w |dp/dd|^2, the prior has that of its own deviation.
    """

    model: Annotated[str, Basic()] = ""
    """Network for depth (or depth and normals): a file; none does without."""
    card: Annotated[str, Basic()] = ""
    """What it wants and gives: the name of a card that comes with geogs, or a YAML file."""
    normal_model: str = ""
    """Another network for normals, where the first has none: a file."""
    normal_card: str = ""
    """What that one wants and gives."""
    depth: bool = True
    """Adjust the tracker's depth with the prior's; normals count by mapping.loss.normal_weight."""
    rounds: Count = 1
    """Last rounds of the local adjustment that are followed by it."""
    deviation: Positive = 0.05
    """Relative deviation of a good prior after its scale has been adjusted."""
    scale_rows: Annotated[int, Range(2, 64)] = 8
    """Nodes of the scale field from top to bottom."""
    scale_columns: Annotated[int, Range(2, 64)] = 10
    """Nodes from left to right. HI-SLAM2 has 2 by 2, with no bound on their difference."""
    scale_step: Positive = 0.1
    """Relative difference that is usual between neighbouring nodes."""
    reach: Annotated[float, Range(above=0, most=1)] = 0.06
    """Matched depth judges the prior around it within about this fraction of the grid's width."""
    max_deviation: Annotated[float, Range(above="deviation")] = 0.15
    """Cells where the prior seems to be worse than this go without it."""
    caution: Positive = 4.0
    """Factor on the deviation that mapping is told of, since it takes a tracker's deviations for
    larger than they are (mapping.depth.sigma_scale, tracker_scale)."""
    reject: Positive = 0.2
    """A prior that is off by more than this in a fifth of the matched cells is not used at all."""
