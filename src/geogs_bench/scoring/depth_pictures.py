"""Views of a result beside their true depth: image, both depths, signed error, kinds of region."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8

from geogs.evaluation.pages.run_pictures import depth_colours, save_picture
from geogs_bench.results.record import Place
from geogs_bench.scoring.depth_scores import ComparedView

DEPTH_PICTURE = "bench_depth.png"
"""File in the report of a result."""
DEPTH_TITLE = (
    "image; true depth; depth of the mesh; error up to 15 % (red in front, blue behind, black "
    "missing, grey not judged); places (yellow edge, magenta thin, cyan behind thin, green bare, "
    "orange grazing, blue sky)"
)
_WORST = 0.15
"""Relative error at which colours saturate."""
_FRONT = (200, 0, 0)
_BEHIND = (0, 60, 220)
_COLOURS: dict[Place, tuple[int, int, int]] = {
    "bare": (90, 190, 90),
    "grazing": (240, 150, 40),
    "edge": (240, 230, 60),
    "behind thin": (60, 210, 220),
    "thin": (230, 40, 210),
    "sky": (80, 120, 230),
}
"""Colours of the kinds of region; later ones are drawn over earlier ones."""


def draw_depths(path: Path, views: Sequence[ComparedView], most: int = 5) -> None:
    """Draw a row for each of some views, spread over the sequence.

    Raises:
        OutputError: the file cannot be written.
    """
    chosen = np.unique(np.linspace(0, len(views) - 1, min(most, len(views))).round().astype(int))
    save_picture(path, np.concatenate([_row(views[k]) for k in chosen]))


def _row(compared: ComparedView) -> UInt8[np.ndarray, "h w2 3"]:
    true = compared.view.depth
    known = true[(true > 0) & np.isfinite(true)]
    ends = np.quantile(1 / known, [0.02, 0.98]) if len(known) else np.array([0.0, 1.0])
    panels = [
        compared.view.image,
        _depth_colours(true, ends),
        _depth_colours(np.where(np.isfinite(compared.found), compared.found, 0), ends),
        error_colours(true, compared.found),
        _place_colours(compared.view.image, compared.places),
    ]
    return np.concatenate(panels, 1)


def _depth_colours(
    depth: Float[np.ndarray, "h w"], ends: Float[np.ndarray, "2"]
) -> UInt8[np.ndarray, "h w 3"]:
    """Colours of inverse depth from far (blue) to near (red); black where there is none."""
    inverse = np.where(depth > 0, 1 / np.where(depth > 0, depth, 1), 0)
    return depth_colours(inverse, float(ends[0]), float(ends[1]), background=0)


def error_colours(
    true: Float[np.ndarray, "h w"], found: Float[np.ndarray, "h w"]
) -> UInt8[np.ndarray, "h w 3"]:
    """Colours of the error: white where the depth is right, red too near, blue too far.

    Holes are black, but in the sky, where a hole is right and a surface is too near.
    """
    sky = np.isinf(true)
    unknown = ~(true > 0)
    hole = ~np.isfinite(found)
    depth = np.where(sky | unknown, 1.0, true)
    error = np.where(hole, 0.0, found) / depth - 1
    error = np.where(sky, np.where(hole, 0.0, -1.0), error)
    worst = np.where((error < 0)[..., None], _FRONT, _BEHIND)
    strength = np.minimum(np.abs(error) / _WORST, 1)[..., None]
    colours = 255 + strength * (worst - 255.0)
    colours[hole & ~sky] = 0
    colours[unknown] = 128
    return np.asarray(colours.round().astype(np.uint8))


def _place_colours(
    image: UInt8[np.ndarray, "h w 3"], places: dict[Place, Bool[np.ndarray, "h w"]]
) -> UInt8[np.ndarray, "h w 3"]:
    grey = np.repeat(image.mean(-1, keepdims=True), 3, -1)
    for place, colour in _COLOURS.items():
        mask = places[place]
        grey[mask] = 0.35 * grey[mask] + 0.65 * np.array(colour)
    return np.asarray(grey.round().astype(np.uint8))
