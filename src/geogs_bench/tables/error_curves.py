"""Error over time, as curves."""

from collections.abc import Sequence
from pathlib import Path

from geogs.evaluation.pages.plots import new_figure, save_figure
from geogs_bench.results.record import Record


def plot_curves(path: Path, records: Sequence[Record]) -> bool:
    """Chamfer distance over seconds, a panel for each scene; false if no record has a curve."""
    scenes = list(dict.fromkeys(record.scene for record in records if record.curve))
    if not scenes:
        return False
    figure = new_figure(5.5 * len(scenes), 4.2)
    for column, scene in enumerate(scenes):
        plot = figure.add_subplot(1, len(scenes), column + 1)
        for record in (r for r in records if r.scene == scene and r.curve):
            seconds = [point.seconds for point in record.curve]
            errors = [point.surface.chamfer for point in record.curve]
            plot.plot(seconds, errors, "o-", ms=4, label=_label(record))
        unit = next(r.curve[0].surface.unit for r in records if r.scene == scene and r.curve)
        plot.set(title=scene, xlabel="seconds", ylabel=f"chamfer distance ({unit})")
        plot.set_yscale("log")
        plot.grid(alpha=0.3, which="both")
        plot.legend()
    save_figure(figure, path)
    return True


def _label(record: Record) -> str:
    return " ".join(part for part in (record.provenance.command, record.variant) if part)
