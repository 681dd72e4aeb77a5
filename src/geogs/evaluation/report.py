"""The errors as a table, as JSON, and as a page with the pictures."""

import html
import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from geogs.evaluation.reconstruction import ReconstructionScores
from geogs.evaluation.trajectory import TrajectoryErrors
from geogs.io.writers.atomic import write_text

if TYPE_CHECKING:
    from rich.table import Table


@dataclass(frozen=True)
class Evaluation:
    """All errors of a result; a part is none where its truth or its file was not there."""

    trajectory: TrajectoryErrors | None
    """Of every frame."""
    keyframes: TrajectoryErrors | None
    """Of the keyframes alone, with an alignment of their own."""
    reconstruction: ReconstructionScores | None
    settings: dict[str, Any]
    """What was compared and how."""

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "trajectory": None if self.trajectory is None else self.trajectory.as_dict(),
            "keyframes": None if self.keyframes is None else self.keyframes.as_dict(),
            "reconstruction": None
            if self.reconstruction is None
            else self.reconstruction.as_dict(),
            "settings": self.settings,
        }


def rows(evaluation: Evaluation) -> list[tuple[str, str]]:
    """Name with unit, and value, of everything that is shown."""
    result = []
    named = {"all frames": evaluation.trajectory, "keyframes": evaluation.keyframes}
    for name, errors in named.items():
        if errors is not None:
            result += _trajectory_rows(name, errors)
    if evaluation.reconstruction is not None:
        result += _surface_rows(evaluation.reconstruction)
    return result


def table(evaluation: Evaluation) -> "Table":
    """The rows for a terminal."""
    from rich.table import Table

    result = Table("measure", "value", title="errors")
    result.columns[1].justify = "right"
    for name, value in rows(evaluation):
        result.add_row(name, value)
    return result


def write_report(
    evaluation: Evaluation, json_file: Path, page: Path, pictures: list[tuple[str, Path]]
) -> None:
    """Write ``eval.json`` and an HTML page with the table and the pictures (title, file).

    Pictures are linked by their names, so they must lie beside the page.
    """
    write_text(json_file, json.dumps(evaluation.as_dict(), indent=2, default=str) + "\n")
    cells = "\n".join(
        f"<tr><td>{html.escape(name)}</td><td class=n>{html.escape(value)}</td></tr>"
        for name, value in rows(evaluation)
    )
    figures = "\n".join(
        f'<h2>{html.escape(title)}</h2><img src="{html.escape(file.name)}">'
        for title, file in pictures
        if file.is_file()
    )
    settings = html.escape(json.dumps(evaluation.settings, indent=2, default=str))
    write_text(page, _PAGE.format(cells=cells, figures=figures, settings=settings))


def _trajectory_rows(name: str, errors: TrajectoryErrors) -> list[tuple[str, str]]:
    how = {"sim3": "Sim(3)", "se3": "SE(3)", "none": "not"}[errors.alignment]
    return [
        (f"ATE RMSE, {name}, {how} aligned (cm)", f"{errors.ate_rmse_cm:.3f}"),
        ("  mean / median / max (cm)", f"{errors.ate_mean_cm:.3f} / {errors.ate_median_cm:.3f} / "
         f"{errors.ate_max_cm:.3f}"),
        ("  rotation RMSE (deg)", f"{errors.rotation_rmse_deg:.3f}"),
        ("  scale (m per map unit)", f"{errors.scale:.5f}"),
        ("  poses compared / estimated / true", f"{errors.pairs} / {errors.estimated} / "
         f"{errors.reference}"),
        ("  path length (m)", f"{errors.path_length_m:.2f}"),
    ]  # fmt: skip


def _surface_rows(s: ReconstructionScores) -> list[tuple[str, str]]:
    return [
        ("Acc (cm)", f"{s.accuracy_cm:.3f}"),
        ("Comp (cm)", f"{s.completeness_cm:.3f}"),
        (f"Comp.Rat (% < {s.threshold_cm:g} cm)", f"{s.completeness_ratio:.2f}"),
        (f"Prec (% < {s.threshold_cm:g} cm)", f"{s.precision_ratio:.2f}"),
        ("F-score (%)", f"{s.f_score:.2f}"),
        ("CD (cm)", f"{s.chamfer_cm:.3f}"),
        ("  medians of Acc / Comp (cm)", f"{s.accuracy_median_cm:.3f} / "
         f"{s.completeness_median_cm:.3f}"),
    ]  # fmt: skip


_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>geogs report</title><style>
body {{ font: 15px/1.5 system-ui, sans-serif; margin: 2em auto; max-width: 1100px; }}
td {{ padding: 0.1em 1em; border-bottom: 1px solid #ddd; white-space: pre; }}
td.n {{ text-align: right; font-variant-numeric: tabular-nums; }}
img {{ max-width: 100%; }} pre {{ color: #555; }}
</style></head><body><h1>geogs report</h1>
<table>
{cells}
</table>
{figures}
<h2>Settings</h2><pre>{settings}</pre>
</body></html>
"""
