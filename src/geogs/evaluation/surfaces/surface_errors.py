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
        """Its name."""
        ...

    @property
    def colour_limit_cm(self) -> float:
        """Distance that pictures show as the worst."""
        ...

    def rows(self) -> list[tuple[str, str]]:
        """Name with unit, and value, of what a table shows."""
        ...


S_co = TypeVar("S_co", bound=SurfaceScores, covariant=True)


@dataclass(frozen=True)
class SurfaceErrors(Generic[S_co]):
    """Scores, and errors of the reconstruction's points, in the unit and the frame of the truth."""

    scores: S_co
    reconstruction_points: Float[np.ndarray, "n 3"]
    accuracy: Float[np.ndarray, "n"]
    """Distance of each to the truth; inf where it is left out."""


@dataclass(frozen=True)
class SurfaceComparison:
    """Scores, and what pictures of the errors need, in the frame of the truth."""

    scores: SurfaceScores
    mesh: Surface
    truth: Surface | None
    """None where the truth is no surface."""
    points: Float[np.ndarray, "n 3"]
    """Where the reconstruction was compared."""
    distance: Float[np.ndarray, "n"]
    """To the truth, metres; inf where it did not count."""
    reach: float = np.inf
    """How far from the points the mesh was still compared; beyond, pictures show no error."""
