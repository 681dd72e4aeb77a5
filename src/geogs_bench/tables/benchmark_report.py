"""Files of a benchmark's folder: results.json, results.md and report/index.html."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from geogs.evaluation.pages.page import (
    PictureSection,
    Section,
    TableSection,
    TextSection,
    write_page,
)
from geogs.evaluation.pages.plots import new_figure, save_figure
from geogs.io.writers.atomic import write_text
from geogs_bench.benchmark import Benchmark
from geogs_bench.published import PAPER
from geogs_bench.results.record import Record, write_json
from geogs_bench.scoring.score_pictures import PICTURES
from geogs_bench.tables.result_tables import Table, published_tables, result_tables


@dataclass(frozen=True)
class Chapter:
    """A benchmark and its records, alone or as a part of a suite."""

    benchmark: Benchmark
    records: Sequence[Record]
    """Records, with folders relative to that of the whole report."""
    prefix: str = ""
    """Prefix of the titles of its tables, if a report has several benchmarks."""


def write_report(output: Path, title: str, chapters: Sequence[Chapter]) -> None:
    """Write all three files from the records.

    Raises:
        OutputError: they cannot be written.
    """
    records = [record for chapter in chapters for record in chapter.records]
    write_json(output / "results.json", records)
    texts = [markdown(chapter.benchmark, chapter.records) for chapter in chapters]
    write_text(output / "results.md", "\n".join(texts))
    sections = [part for chapter in chapters for part in _sections(output, chapter)]
    write_page(output / "report" / "index.html", title, sections, " ".join(_provenance(records)))


def chapter_tables(chapter: Chapter) -> list[Table]:
    """All tables of a chapter that have a number."""
    tables = result_tables(chapter.benchmark, chapter.records)
    return [replace(table, title=chapter.prefix + table.title) for table in tables]


def markdown(benchmark: Benchmark, records: Sequence[Record]) -> str:
    """The provenance and all tables, ours first, the paper's figures last."""
    parts = [f"# {benchmark.title}", *_provenance(records)]
    if benchmark.published:
        parts.append(f"Columns marked (paper) hold the published figures of {PAPER}.")
    parts += [table.markdown() for table in result_tables(benchmark, records)]
    parts += [f"- {note}" for note in benchmark.notes]
    parts += [table.markdown() for table in published_tables(benchmark)]
    return "\n\n".join(parts) + "\n"


def _provenance(records: Sequence[Record]) -> list[str]:
    """One line for each combination of machine, device, commit and seed."""
    made = dict.fromkeys(
        f"Measured on {p.machine}; device {p.device or 'unknown'}; geogs {p.commit}; seed {p.seed}."
        for r in records
        if (p := r.provenance) and r.cost is not None
    )
    mixed = len({r.provenance.commit for r in records if r.cost is not None}) > 1
    warning = ["The rows were made by different commits of the program."] if mixed else []
    return [*made, *warning]


def _sections(output: Path, chapter: Chapter) -> list[Section]:
    """Tables, curves, notes, published figures, pictures; among several benchmarks the notes come
    first, under the benchmark's title."""
    benchmark, prefix = chapter.benchmark, chapter.prefix
    sections: list[Section] = [_section(table) for table in chapter_tables(chapter)]
    curves = output / "report" / f"{benchmark.name}-convergence.png"
    if plot_curves(curves, chapter.records):
        sections.append(PictureSection(f"{prefix}Error over time", curves))
    if benchmark.notes:
        notes = TextSection(benchmark.title if prefix else "Notes", "\n".join(benchmark.notes))
        sections.insert(0 if prefix else len(sections), notes)
    sections += [_section(table) for table in published_tables(benchmark)]
    for record in chapter.records:
        name = f"{prefix}{record.scene} {record.variant}".strip()
        report = output / record.folder / "report"
        sections += [
            PictureSection(f"{name}: {title}", report / file) for file, title in PICTURES.items()
        ]
    return sections


def _section(table: Table) -> TableSection:
    return TableSection(table.title, table.header, table.rows, table.note)


def plot_curves(path: Path, records: Sequence[Record]) -> bool:
    """Plot Chamfer distance over seconds, a panel a scene; return whether a record has a curve."""
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
