"""Scores of a surface by one protocol, and the points they come from."""

from dataclasses import dataclass
from typing import Any, ClassVar, Generic, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Float

from geogs.evaluation.surfaces.surface import Surface


@runtime_checkable
class SurfaceScores(Protocol):
    """Errors of a surface by one protocol: a dataclass of numbers."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def protocol(self) -> str:
        """Name of the protocol."""
        ...

    @property
    def colour_limit_cm(self) -> float:
        """Largest distance on the colour scale."""
        ...

    def rows(self) -> list[tuple[str, str]]:
        """Rows of a table: name with unit, and value."""
        ...


S_co = TypeVar("S_co", bound=SurfaceScores, covariant=True)


@dataclass(frozen=True)
class SurfaceErrors(Generic[S_co]):
    """Scores, and errors of the reconstruction's points, in the unit and the frame of the truth."""

    scores: S_co
    reconstruction_points: Float[np.ndarray, "n 3"]
    accuracy: Float[np.ndarray, "n"]
    """Distance of each point to the truth; inf where it is left out."""


@dataclass(frozen=True)
class SurfaceComparison:
    """Scores, and data for pictures of the errors, in the frame of the truth."""

    scores: SurfaceScores
    mesh: Surface
    truth: Surface | None
    """None where the truth is no surface."""
    points: Float[np.ndarray, "n 3"]
    """Compared points of the reconstruction."""
    distance: Float[np.ndarray, "n"]
    """Distance to the truth, metres; inf where it did not count."""
    reach: float = np.inf
    """Largest distance from these points at which pictures show the mesh's error."""
