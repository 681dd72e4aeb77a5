"""Unit of lengths on a page, by the scale of a run."""

from collections.abc import Mapping
from typing import Any

from geogs.evaluation.model_view.shown_model import Lengths

METRES = {"metres": 1.0, "millimetres": 0.001}
"""Metres per unit of poses, by the name of the unit."""


def lengths(summary: Mapping[str, Any]) -> Lengths:
    """Metres where ``scale`` in ``summary.json`` is metric, else units of the sequence."""
    scale = summary.get("scale")
    said = scale if isinstance(scale, str) else ""
    kind, _, rest = said.partition(" (")
    origin = rest.removesuffix(")")
    if kind == "metric":
        return Lengths(1.0, f"Metres by {origin}{_uncertain(summary.get('metric_scale'))}.")
    if kind == "of the poses":
        metres = METRES.get(origin)
        what = "Metres by the poses that were given" if metres else "Units of the poses given"
        return Lengths(metres, f"{what}.")
    note = "The images alone do not tell metres: lengths are in units of this sequence."
    return Lengths(None, note)


def _uncertain(metric: object) -> str:
    """Relative uncertainty of the scale, two standard deviations."""
    deviation = metric.get("deviation") if isinstance(metric, Mapping) else None
    if not isinstance(deviation, int | float) or not 0 < deviation < 1:
        return ""
    return f", to about {200 * deviation:.2g} %"
