"""Errors of a reconstructed surface against the true one."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from geogs.errors import InputError
from geogs.evaluation.surfaces.icp import icp
from geogs.evaluation.surfaces.surface import Surface, sample_surface
from geogs.evaluation.surfaces.surface_distance import SurfaceDistance
from geogs.evaluation.surfaces.surface_errors import SurfaceErrors
from geogs.evaluation.surfaces.visibility import Visibility
from geogs.threads import on_one_torch_thread

_ICP_POINTS = 40_000


@dataclass(frozen=True)
class ReconstructionScores:
    """Surface errors; lengths in cm, ratios in percent."""

    accuracy_cm: float
    """Mean distance of the reconstruction to the truth."""
    completeness_cm: float
    """Mean distance of the truth to the reconstruction."""
    completeness_ratio: float
    """Percentage of the truth nearer than the threshold to the reconstruction."""
    precision_ratio: float
    """Percentage of the reconstruction nearer than the threshold to the truth."""
    f_score: float
    """Harmonic mean of the two ratios, %."""
    chamfer_cm: float
    """Mean of accuracy and completeness."""
    accuracy_median_cm: float
    completeness_median_cm: float
    threshold_cm: float
    accuracy_samples: int
    completeness_samples: int
    icp_shift_cm: float
    """Mean motion of the samples by ICP; 0 where it was not used."""
    protocol: str = "area-weighted (NICE-SLAM), distances to the surface"
    """Definition of the errors."""

    @property
    def colour_limit_cm(self) -> float:
        """Largest distance on the colour scale."""
        return 2 * self.threshold_cm

    def rows(self) -> list[tuple[str, str]]:
        """Rows of a table."""
        return [
            ("Acc (cm)", f"{self.accuracy_cm:.3f}"),
            ("Comp (cm)", f"{self.completeness_cm:.3f}"),
            (f"Comp.Rat (% < {self.threshold_cm:g} cm)", f"{self.completeness_ratio:.2f}"),
            (f"Prec (% < {self.threshold_cm:g} cm)", f"{self.precision_ratio:.2f}"),
            ("F-score (%)", f"{self.f_score:.2f}"),
            ("CD (cm)", f"{self.chamfer_cm:.3f}"),
            (
                "  medians of Acc / Comp (cm)",
                f"{self.accuracy_median_cm:.3f} / {self.completeness_median_cm:.3f}",
            ),
        ]


@on_one_torch_thread
def evaluate_reconstruction(
    reconstruction: Surface,
    truth: Surface,
    truth_points: Surface | None = None,
    visibility: Visibility | None = None,
    cull_reconstruction: bool = False,
    use_icp: bool = False,
    threshold: float = 0.05,
    samples: int = 200_000,
    seed: int = 0,
) -> SurfaceErrors[ReconstructionScores]:
    """Compare a reconstruction with the truth, both in metres and in the truth's frame.

    The area-weighted measure of NICE-SLAM and iMAP: ``samples`` points uniform by area on each
    side, unsquared nearest distances, means and the fraction below ``threshold`` (metres). Two
    details differ from the usual scripts and make the result independent of sampling density:
    distances go to the surface itself, exactly (see :class:`SurfaceDistance`), not to samples of
    it; and culling acts on samples, not on whole triangles.
    :mod:`geogs.evaluation.surfaces.toolbox` has the scripts' own measures.

    Accuracy is measured against ``truth``, completeness on ``truth_points`` where given (say, only
    points seen by the camera). With ``visibility`` the samples of the truth are limited to the
    region seen by the camera (and, with ``cull_reconstruction``, those of the reconstruction,
    too). With ``use_icp`` a rigid motion by ICP (0.1 m) is applied first, as those scripts do.
    """
    rng = np.random.default_rng(seed)
    if not reconstruction.is_mesh or not reconstruction.areas.sum() > 0:
        raise InputError("The reconstruction has no triangles with an area; nothing to evaluate.")
    to_truth = SurfaceDistance(truth)
    shift = 0.0
    if use_icp:
        probe = sample_surface(reconstruction, _ICP_POINTS, rng)[0]
        T = icp(probe, to_truth)
        shift = float(np.linalg.norm(probe @ T[:3, :3].T + T[:3, 3] - probe, axis=1).mean())
        reconstruction = reconstruction.transformed(T)
    points = sample_surface(reconstruction, samples, rng)[0]
    if visibility is not None and cull_reconstruction:
        points = _cull(points, visibility.seen(points), "the reconstruction")
    reference = _reference_samples(truth_points or truth, visibility, samples, rng)
    accuracy = to_truth(points)
    completeness = SurfaceDistance(reconstruction)(reference)
    scores = surface_scores(accuracy, completeness, threshold, shift)
    return SurfaceErrors(scores, points, accuracy)


def _reference_samples(
    truth: Surface, visibility: Visibility | None, samples: int, rng: np.random.Generator
) -> Float[np.ndarray, "n 3"]:
    """Samples of the truth; with ``visibility``, about ``samples`` that the camera saw."""
    if visibility is None:
        return sample_surface(truth, samples, rng)[0]
    points = sample_surface(truth, 5 * samples, rng)[0]
    points = _cull(points, visibility.seen(points), "the truth")
    keep = rng.choice(len(points), min(samples, len(points)), replace=False)
    return points[keep]


def _cull(
    points: Float[np.ndarray, "n 3"], seen: Bool[np.ndarray, "n"], what: str
) -> Float[np.ndarray, "m 3"]:
    if not seen.any():
        raise InputError(f"The cameras see no part of {what}; are the poses in its frame?")
    return points[seen]


def surface_scores(
    accuracy: Float[np.ndarray, "n"],
    completeness: Float[np.ndarray, "m"],
    threshold: float,
    icp_shift: float = 0.0,
) -> ReconstructionScores:
    """Means, medians and ratios of distances in metres, as cm and %."""
    acc = 100 * float(accuracy.mean())
    comp = 100 * float(completeness.mean())
    precision = 100 * float((accuracy < threshold).mean())
    recall = 100 * float((completeness < threshold).mean())
    return ReconstructionScores(
        accuracy_cm=acc,
        completeness_cm=comp,
        completeness_ratio=recall,
        precision_ratio=precision,
        f_score=2 * precision * recall / max(precision + recall, 1e-12),
        chamfer_cm=(acc + comp) / 2,
        accuracy_median_cm=100 * float(np.median(accuracy)),
        completeness_median_cm=100 * float(np.median(completeness)),
        threshold_cm=100 * threshold,
        accuracy_samples=len(accuracy),
        completeness_samples=len(completeness),
        icp_shift_cm=100 * icp_shift,
    )
