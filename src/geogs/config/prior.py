"""Settings of the monocular priors."""

from dataclasses import dataclass
from typing import Annotated

from geogs.config.setting import Basic, Positive, Range, Settings


@dataclass(frozen=True)
class PriorConfig(Settings, group="prior"):
    """Depth and normals that a network guesses from single keyframes; without a model, none."""

    model: Annotated[str, Basic()] = ""
    """Network for depth (or depth and normals): a file; none does without."""
    card: Annotated[str, Basic()] = ""
    """What it wants and gives: the name of a card that comes with geogs, or a YAML file."""
    normal_model: str = ""
    """Another network for normals, where the first has none: a file."""
    normal_card: str = ""
    """What that one wants and gives."""
    scale_rows: Annotated[int, Range(2, 64)] = 8
    """Nodes of the scale field from top to bottom."""
    scale_columns: Annotated[int, Range(2, 64)] = 10
    """Nodes from left to right. HI-SLAM2 has 2 by 2, with no bound on their difference."""
    scale_step: Positive = 0.1
    """Relative difference that is usual between neighbouring nodes."""
