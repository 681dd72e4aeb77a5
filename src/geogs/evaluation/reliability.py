"""Calibration of predicted standard deviations: comparison with the true position errors."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

LEVELS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99)
"""Predicted fractions of the frames at which the observed ones are given."""


@dataclass(frozen=True)
class Reliability:
    """Position errors and their predicted standard deviations."""

    error: Float[np.ndarray, "n"]
    """Length of each error."""
    sigma: Float[np.ndarray, "n"]
    """Predicted standard deviation, all axes together, in the same unit; finite."""

    @property
    def within_two_sigma(self) -> float:
        """Fraction of the frames whose error is at most two predicted standard deviations."""
        return float((self.error <= 2 * self.sigma).mean())

    @property
    def error_per_sigma(self) -> float:
        """Ratio of root mean squares of errors and standard deviations: 1 if as predicted."""
        variance = float(np.square(self.sigma).mean())
        return float(np.sqrt(np.square(self.error).mean() / max(variance, 1e-300)))

    def observed(self, predicted: Float[np.ndarray, "k"]) -> Float[np.ndarray, "k"]:
        """Observed fractions of frames within the error bounds of the predicted fractions.

        Errors are assumed normal and equal along the three axes, so that three times their square
        over the variance of all axes together follows a chi-squared distribution with three
        degrees of freedom.
        """
        from scipy.special import chdtr

        # Predicted fraction of frames with a smaller error than this one.
        edge = chdtr(3, 3 * np.square(self.error / np.maximum(self.sigma, 1e-300)))
        return (edge <= predicted[:, None]).mean(1)

    def as_dict(self) -> dict[str, Any]:
        """Values for JSON."""
        observed = self.observed(np.array(LEVELS))
        return {
            "frames": len(self.error),
            "within_two_sigma": self.within_two_sigma,
            "error_per_sigma": self.error_per_sigma,
            "foretold": list(LEVELS),
            "observed": observed.tolist(),
        }


def reliability(
    times: Float[np.ndarray, "n"],
    error: Float[np.ndarray, "n"],
    known_times: Float[np.ndarray, "m"],
    sigma: Float[np.ndarray, "m"],
) -> Reliability | None:
    """Pair errors with the standard deviations of the frames nearest in time.

    None where no deviation is finite.

    Args:
        times: times of the errors, seconds.
        error: lengths of the errors.
        known_times: times of the frames with a known position, ascending.
        sigma: their standard deviations, in the unit of the errors; infinite where unknown.
    """
    middle = (known_times[1:] + known_times[:-1]) / 2
    nearest = sigma[np.searchsorted(middle, times)] if len(sigma) else np.full(len(times), np.inf)
    known = np.isfinite(nearest)
    return Reliability(error[known], nearest[known]) if known.any() else None
