"""Assignment of pixels to a side of a depth edge: colour decides where matching cannot.

A window over a silhouette matches at the silhouette's depth, and beside it, on a bare wall, nothing
contradicts: the foreground is fattened. But the wall's colour extends to the silhouette.
"""

import numpy as np
from jaxtyping import Float32

from geogs.depth import edge_kernels as kernels
from geogs.depth.plane_sweep import SweepResult
from geogs.depth.refinement import SlantedDepth
from geogs.threads import over_rows

REACH = 0.019
"""Half side of the window of pixels that vote, in long edges of the image: 6 pixels of 320."""
CONTRAST = 300.0
"""Rate c of a pixel's weight 1 / (1 + c |dI|^2)^2 by its colour difference."""
MIN_GAP = 0.015
"""Relative difference of inverse depth from which a nearby pixel is of another surface."""
WIDTH = 0.02
"""Relative width of the kernel of the mean shift to the mode of such pixels."""
MEAN_SHIFTS = 3
"""Steps of the mean shift."""
COST_TRUST = 6.0
"""Weight of a difference of matching costs against a log ratio of the votes."""
PASSES = 2
"""Rounds over all pixels; pixels that moved in one no longer vote for the foreground."""
MOVED_CONFIDENCE = 0.7
"""Measured confidence of a pixel that takes another plane, relative to that of its voters."""


def reach_of(shape: tuple[int, ...]) -> int:
    """``REACH`` in pixels of an image, at least four."""
    return max(4, round(REACH * max(shape)))


def resolve_edges(
    refined: SlantedDepth,
    confidence: Float32[np.ndarray, "h w"],
    guide: Float32[np.ndarray, "3 h w"],
    sweep: SweepResult,
) -> tuple[SlantedDepth, Float32[np.ndarray, "h w"]]:
    """Put each pixel on the surface that it most likely shows; return depth and confidence.

    A pixel may take the plane of farther or nearer pixels around. These are weighted by confidence
    and likeness in colour (adaptive support weights, Yoon and Kweon 2006). The modes of their
    planes' inverse depths at the pixel are candidates (mean shift), as in a weighted median filter
    of a disparity map (Ma et al. 2013); the sweep's aggregated cost of each counts, too. ``guide``
    is the image in [0, 1].
    """
    maps = [refined.inverse_depth, refined.slope_x, refined.slope_y, confidence]
    f = np.float32
    planes = sweep.planes
    spacing = (planes[-1] - planes[0]) / f(len(planes) - 1)
    settings = [f(x) for x in (CONTRAST, MIN_GAP, WIDTH, COST_TRUST)]
    for _ in range(PASSES):
        old, maps = maps, [np.empty_like(m) for m in maps]
        over_rows(
            lambda *rows, old=old, new=maps: kernels.resolve_edges(
                *rows, *old, guide, sweep.costs, planes[0], spacing, reach_of(confidence.shape),
                *settings, MEAN_SHIFTS, f(MOVED_CONFIDENCE), *new,
            ),
            len(confidence),
        )  # fmt: skip
    rho, slope_x, slope_y, confidence = maps
    return SlantedDepth(rho, slope_x, slope_y, refined.support), confidence
