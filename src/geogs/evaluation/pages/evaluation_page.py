"""The errors as a table, as JSON, and as a page with the pictures."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from geogs.evaluation.model_view.model_section import model_section
from geogs.evaluation.model_view.shown_model import ShownModel
from geogs.evaluation.pages.page import (
    FiguresSection,
    HtmlSection,
    PictureSection,
    Section,
    TableSection,
    TextSection,
    write_page,
)
from geogs.evaluation.reliability import Reliability
from geogs.evaluation.surfaces.photoconsistency import PhotoScores
from geogs.evaluation.surfaces.surface_errors import SurfaceScores
from geogs.evaluation.trajectory_errors import TrajectoryErrors
from geogs.guard.atomic import write_text

if TYPE_CHECKING:
    from rich.table import Table

SAME_POSES_CM = 1e-4
"""Largest error in cm of poses that equal the true ones, which need no table or picture."""


@dataclass(frozen=True)
class Evaluation:
    """All errors of a result; a part is none where its truth or its file is missing."""

    trajectory: TrajectoryErrors
    """Errors of every frame."""
    keyframes: TrajectoryErrors | None
    """Errors of the keyframes alone, with an alignment of their own."""
    reconstruction: SurfaceScores | None
    settings: dict[str, Any]
    """Settings of the comparison."""
    photo: PhotoScores | None = None
    """Photo-consistency of the images on the surface."""
    reliability: Reliability | None = None
    """Errors of all frames with the run's standard deviations; none where it gave none."""
    doubts: tuple[str, ...] = ()
    """Warnings on the comparison, in sentences."""

    def as_dict(self) -> dict[str, Any]:
        """Values for JSON."""
        return {
            "doubts": self.doubts,
            "trajectory": self.trajectory.as_dict(),
            "keyframes": self.keyframes and self.keyframes.as_dict(),
            "reliability": self.reliability and self.reliability.as_dict(),
            "reconstruction": self.reconstruction and asdict(self.reconstruction),
            "photoconsistency": self.photo and asdict(self.photo),
            "settings": self.settings,
        }


def groups(evaluation: Evaluation) -> list[tuple[str, list[tuple[str, str]]]]:
    """All shown values: headings with names (and units) and values."""
    result = []
    if evaluation.reconstruction is not None:
        scores = evaluation.reconstruction
        result.append((f"Surface, {scores.protocol}", scores.rows()))
    if evaluation.photo is not None:
        result.append(("Photoconsistency", evaluation.photo.rows()))
    trajectory = []
    named = {"all frames": evaluation.trajectory, "keyframes": evaluation.keyframes}
    for name, errors in named.items():
        if errors is not None:
            trajectory += _trajectory_rows(name, errors)
    result.append(("Trajectory", trajectory))
    reliability = evaluation.reliability
    if reliability is not None:
        rows = [
            ("frames within 2 sigma (%)", f"{100 * reliability.within_two_sigma:.1f}"),
            ("  error / sigma, RMS", f"{reliability.error_per_sigma:.2f}"),
            ("  frames compared", f"{len(reliability.error)}"),
        ]
        result.append(("What the run said of its positions", rows))
    return result


def table(evaluation: Evaluation) -> "Table":
    """Table for a terminal."""
    from rich.table import Table

    result = Table("measure", "value", title="errors")
    result.columns[1].justify = "right"
    for heading, rows in groups(evaluation):
        result.add_section()
        result.add_row(heading, "", style="bold")
        for name, value in rows:
            result.add_row(name, value)
    return result


def write_report(
    evaluation: Evaluation,
    json_file: Path,
    page: Path,
    pictures: list[tuple[str, Path]],
    run: Sequence[Section] = (),
    title: str = "report",
    judged: FiguresSection | None = None,
    model: ShownModel | None = None,
) -> None:
    """Write ``eval.json`` and a page with the errors, the pictures and the run's own tables.

    The page needs no other files.

    Args:
        evaluation: the errors.
        json_file: file for programs.
        page: HTML file.
        pictures: titles and files; missing ones are left out.
        run: sections of the run.
        title: title of the page.
        judged: the verdict of the run; the errors follow it.
        model: interactive model at the top.
    """
    write_text(json_file, json.dumps(evaluation.as_dict(), indent=2, default=str) + "\n")
    judged = judged or FiguresSection("", None, ())
    numbers = [*error_figures(evaluation), *judged.figures]
    sections: list[Section] = [FiguresSection(said, False, ()) for said in evaluation.doubts]
    sections += [FiguresSection(judged.sentence, judged.is_good, numbers)]
    sections += [HtmlSection(*model_section(model))] if model is not None else []
    sections += [TableSection(heading, (), rows) for heading, rows in groups(evaluation)]
    sections += [PictureSection(title, file) for title, file in pictures]
    sections += run
    settings = json.dumps(evaluation.settings, indent=2, default=str)
    sections.append(TextSection("Settings of the comparison", settings))
    write_page(page, title, sections, "geogs, compared with the truth", is_whole=True)


def error_figures(evaluation: Evaluation) -> list[tuple[str, str]]:
    """The main errors."""
    result = []
    path = evaluation.trajectory
    if path.ate_max_cm > SAME_POSES_CM:
        result.append(("ATE RMSE", f"{path.ate_rmse_cm:.2f} cm"))
    if evaluation.reliability is not None:
        result.append(("within 2 sigma", f"{evaluation.reliability.within_two_sigma:.1%}"))
    if evaluation.reconstruction is not None:
        rows = [row for row in evaluation.reconstruction.rows() if not row[0].startswith(" ")]
        result += [_with_unit(*row) for row in rows[:3]]
    return result


def _with_unit(name: str, value: str) -> tuple[str, str]:
    """Name and rounded value with unit, from a row named "name (unit, of what)"."""
    name, _, rest = name.partition(" (")
    unit, _, of_what = rest.removesuffix(")").partition(" ")
    try:
        number = f"{float(f'{float(value):.3g}'):g}"
    except ValueError:
        return name, value
    return f"{name} {of_what}".strip(), f"{number} {unit}".strip()


def _trajectory_rows(name: str, errors: TrajectoryErrors) -> list[tuple[str, str]]:
    if errors.alignment == "none" and errors.ate_max_cm < SAME_POSES_CM:
        return [(f"{name}: the true ones", f"{errors.pairs} poses")]
    how = {"sim3": "Sim(3)", "se3": "SE(3)", "none": "not"}[errors.alignment]
    return [
        (f"ATE RMSE, {name}, {how} aligned (cm)", f"{errors.ate_rmse_cm:.3f}"),
        (
            "  mean / median / max (cm)",
            f"{errors.ate_mean_cm:.3f} / {errors.ate_median_cm:.3f} / {errors.ate_max_cm:.3f}",
        ),
        _rotation_row(errors),
        ("  scale (m per map unit)", f"{errors.scale:.5f}"),
        (
            "  poses compared / estimated / true",
            f"{errors.pairs} / {errors.estimated} / {errors.reference}",
        ),
        ("  path length (m)", f"{errors.path_length_m:.2f}"),
    ]


def _rotation_row(errors: TrajectoryErrors) -> tuple[str, str]:
    which, _, rmse = errors.rotations
    over = f", over {errors.stretch_m:.3g} m" if which == "relative" else ""
    return f"  rotation RMSE, {which}{over} (deg)", f"{rmse:.3f}"
