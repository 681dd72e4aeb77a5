"""Errors of the reconstruction of one object with a known true mesh."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from geogs.errors import InputError
from geogs.evaluation.surfaces.silhouettes import Silhouette, inside_masks
from geogs.evaluation.surfaces.surface import Surface, sample_surface
from geogs.evaluation.surfaces.surface_distance import TriangleTree
from geogs.evaluation.surfaces.surface_errors import SurfaceErrors
from geogs.threads import on_one_torch_thread

MAX_DISTANCE = 0.02
"""Distances from this on are left out, as in DTU; metres."""
ON_OBJECT = 0.001
"""Largest distance of a seen point of the object, not of its support; metres."""


@dataclass(frozen=True)
class ObjectScores:
    """Errors of an object, in millimetres and percent."""

    accuracy_mm: float
    """Mean distance of the result to the true mesh."""
    completeness_mm: float
    """Mean distance of the truth to the result."""
    chamfer_mm: float
    """Mean of the two."""
    accuracy_median_mm: float
    completeness_median_mm: float
    precision: float
    """Percentage of the result nearer than the threshold to the true mesh."""
    recall: float
    """Percentage of the truth nearer than the threshold to the result."""
    f_score: float
    """Harmonic mean of the two, %."""
    threshold_mm: float
    accuracy_left_out: float
    """Percentage of the result 20 mm or more away, which counts in no other number."""
    completeness_left_out: float
    """Percentage of the truth 20 mm or more away, which counts in no other number."""
    outside_masks: float
    """Percentage of the result's area outside the masks, which does not count."""
    accuracy_samples: int
    completeness_samples: int
    protocol: str = "object in its masks, distances to the surface"

    @property
    def colour_limit_cm(self) -> float:
        """Largest distance on the colour scale."""
        return 0.2 * self.threshold_mm

    def rows(self) -> list[tuple[str, str]]:
        """Rows of a table."""
        return [
            ("Acc (mm)", f"{self.accuracy_mm:.3f}"),
            ("Comp (mm)", f"{self.completeness_mm:.3f}"),
            ("CD (mm)", f"{self.chamfer_mm:.3f}"),
            (
                "  medians of Acc / Comp (mm)",
                f"{self.accuracy_median_mm:.3f} / {self.completeness_median_mm:.3f}",
            ),
            (
                f"Prec / Rec (% < {self.threshold_mm:g} mm)",
                f"{self.precision:.2f} / {self.recall:.2f}",
            ),
            (f"F-score at {self.threshold_mm:g} mm (%)", f"{self.f_score:.2f}"),
            (
                "  left out, 20 mm or more (%)",
                f"{self.accuracy_left_out:.2f} / {self.completeness_left_out:.2f}",
            ),
            ("  outside the masks (% of the area)", f"{self.outside_masks:.2f}"),
        ]


@on_one_torch_thread
def evaluate_object(
    reconstruction: Surface,
    truth: Surface,
    silhouettes: Sequence[Silhouette],
    truth_points: Surface | None = None,
    threshold: float = 0.001,
    samples: int = 4_000_000,
    seed: int = 0,
) -> SurfaceErrors[ObjectScores]:
    """Compare a mesh with an object's, both in metres and in one frame.

    Accuracy: exact distances of ``samples`` points of the reconstruction, uniform by area, to the
    true triangles; those inside every mask count (:func:`inside_masks`). Completeness: exact
    distances of ``truth_points`` (seen by the cameras; those within 1 mm of the true mesh count;
    without any, three quarters as many samples of the mesh) to the triangles of the
    reconstruction. Distances of 2 cm or more are left out of all means, medians and ratios, as in
    DTU; their percentage is reported.

    Args:
        reconstruction: the result.
        truth: the object's mesh.
        silhouettes: its masks, widened as the protocol wants (:meth:`Silhouette.dilated`).
        truth_points: points of the truth for completeness.
        threshold: threshold for precision, recall and F-score, metres.
        samples: number of samples on the reconstruction.
        seed: seed of the sampling.

    Raises:
        InputError: a mesh has no triangles, or nothing of the result is inside the masks or near.
    """
    rng = np.random.default_rng(seed)
    to_truth = TriangleTree(truth)
    to_result = TriangleTree(reconstruction)
    points = sample_surface(reconstruction, samples, rng)[0]
    inside = inside_masks(points, silhouettes)
    outside = 100 * (1 - float(inside.mean()))
    points = points[inside]
    if truth_points is not None:
        true_points = truth_points.vertices
        true_points = true_points[to_truth(true_points, ON_OBJECT) <= ON_OBJECT]
    else:
        true_points = sample_surface(truth, max(3 * samples // 4, 1), rng)[0]
    accuracy = _distances(to_truth, points)
    completeness = _distances(to_result, true_points)
    scores = _scores(accuracy, completeness, threshold, outside)
    return SurfaceErrors(scores, points, accuracy)


def _distances(tree: TriangleTree, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    distance = tree(points, MAX_DISTANCE)
    return np.where(distance < MAX_DISTANCE, distance, np.inf)


def _scores(
    accuracy: Float[np.ndarray, "n"],
    completeness: Float[np.ndarray, "m"],
    threshold: float,
    outside: float,
) -> ObjectScores:
    acc = accuracy[np.isfinite(accuracy)]
    comp = completeness[np.isfinite(completeness)]
    if not len(acc) or not len(comp):
        raise InputError(
            "Nothing of the result is inside the masks and within 2 cm of the object; is it in "
            "metres and in the frame of the true poses?"
        )
    precision = 100 * float((acc < threshold).mean())
    recall = 100 * float((comp < threshold).mean())
    return ObjectScores(
        accuracy_mm=1000 * float(acc.mean()),
        completeness_mm=1000 * float(comp.mean()),
        chamfer_mm=500 * float(acc.mean() + comp.mean()),
        accuracy_median_mm=1000 * float(np.median(acc)),
        completeness_median_mm=1000 * float(np.median(comp)),
        precision=precision,
        recall=recall,
        f_score=2 * precision * recall / max(precision + recall, 1e-12),
        threshold_mm=1000 * threshold,
        accuracy_left_out=100 * (1 - len(acc) / len(accuracy)),
        completeness_left_out=100 * (1 - len(comp) / len(completeness)),
        outside_masks=outside,
        accuracy_samples=len(accuracy),
        completeness_samples=len(completeness),
    )
