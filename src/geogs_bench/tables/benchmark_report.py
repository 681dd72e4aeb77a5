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
from geogs.guard.atomic import write_text
from geogs_bench.benchmark import Benchmark, Column, Layout
from geogs_bench.published import PAPER, PublishedTable
from geogs_bench.results.record import Record, write_json
from geogs_bench.scoring.score_pictures import PICTURES

MISSING = "–"
"""Cell of a missing number."""
_BESIDE = " (paper)"
"""Ending of the title of a column of published figures."""
_OF_PAPER = "paper"
"""Name of the variant with the paper's settings, or the beginning of its name."""
_SECONDS = "120s"
"""The paper's time for a reconstruction from known poses."""


@dataclass(frozen=True)
class Table:
    """Cells of text; the first column names the row."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""

    def markdown(self) -> str:
        """The table in GitHub's Markdown, under its title."""
        lines = [self.header, ("---", *["---:"] * (len(self.header) - 1)), *self.rows]
        text = "\n".join(f"| {' | '.join(map(_escape, cells))} |" for cells in lines)
        return "\n\n".join(part for part in (f"## {self.title}", text, self.note) if part)


def result_tables(benchmark: Benchmark, records: Sequence[Record]) -> list[Table]:
    """All tables of a benchmark that have a number, after one of the failures, if there are any."""
    made = []
    scored = [record for record in records if record.cost is not None]
    for layout in benchmark.layouts:
        columns = [c for c in layout.columns if any(c.value(r) is not None for r in scored)]
        if columns:
            made += _layout_tables(benchmark, layout, columns, scored)
    failed = [r for r in records if r.error is not None]
    if failed:
        rows = tuple((_name(r), r.error or "") for r in failed)
        made.insert(0, Table("Not finished", ("scene", "why"), rows))
    return made


def published_tables(benchmark: Benchmark) -> list[Table]:
    """Tables as printed in papers; nothing in them was measured here."""
    return [_published_table(table) for table in benchmark.published]


def _published_table(table: PublishedTable) -> Table:
    has_mean = any(row.mean is not None for row in table.rows) and table.columns != ("mean",)
    header = ("method", "metric", *table.columns, *(("mean",) if has_mean else ()))
    rows = [
        (
            row.method,
            row.metric,
            *(f"{v:.2f}" for v in row.values),
            *((f"{row.mean:.2f}",) if has_mean and row.mean is not None else ()),
        )
        for row in table.rows
    ]
    note = f"{table.caption}. Figures of {table.source}, not measured here ({table.label})."
    return Table(f"Published: {table.label}", header, tuple(rows), note)


def _layout_tables(
    benchmark: Benchmark, layout: Layout, columns: Sequence[Column], records: Sequence[Record]
) -> list[Table]:
    title = layout.title
    header = _header(columns, records)
    body = tuple(_row(benchmark, record, columns) for record in records)
    variants = list(dict.fromkeys(record.variant for record in records))
    if len(variants) == 1:
        mean = (_mean_row(benchmark, "mean", records, columns),) if len(records) > 1 else ()
        return [_table(title, ("scene", *header), (*body, *mean), layout.note)]
    detail = _table(f"{title}: every scene", ("scene, variant", *header), body)
    common = _common_scenes(records, variants)
    if not common:
        return [detail]
    means = tuple(
        _mean_row(benchmark, variant or "default", rows, columns)
        for variant in variants
        if (rows := [r for r in records if r.variant == variant and r.scene in common])
    )
    if len(common) == 1 and len(body) == len(variants):
        return [_table(title, ("variant", *header), means, f"{common[0]}. {layout.note}".strip())]
    note = f"Means over the scenes that every variant finished: {', '.join(common)}."
    return [_table(title, ("variant", *header), means, f"{note} {layout.note}".strip()), detail]


def _table(
    title: str, header: Sequence[str], rows: Sequence[Sequence[str]], note: str = ""
) -> Table:
    """Make a table without columns of published figures that are empty."""
    kept = [
        n
        for n, name in enumerate(header)
        if not name.endswith(_BESIDE) or any(row[n] != MISSING for row in rows)
    ]
    cells = (tuple(row[n] for n in kept) for row in (header, *rows))
    return Table(title, next(cells), tuple(cells), note)


def _common_scenes(records: Sequence[Record], variants: Sequence[str]) -> list[str]:
    finished = {(r.scene, r.variant) for r in records if r.error is None}
    scenes = dict.fromkeys(record.scene for record in records)
    return [s for s in scenes if all((s, variant) in finished for variant in variants)]


def _header(columns: Sequence[Column], records: Sequence[Record]) -> list[str]:
    units = dict.fromkeys(s.unit for r in records for stage in r.stages for s in stage.surfaces)
    unit = " or ".join(units) or "cm"
    titles = []
    for column in columns:
        titles.append(column.title.replace("{unit}", unit))
        if column.published is not None:
            titles.append(f"{column.published.metric}{_BESIDE}")
    return titles


def _row(benchmark: Benchmark, record: Record, columns: Sequence[Column]) -> tuple[str, ...]:
    cells = [_name(record)]
    for column in columns:
        cells.append(_cell(column.value(record), column.digits))
        if column.published is not None:
            table = column.published.table
            metric = column.published.metric
            is_papers = _is_papers(benchmark, record.variant)
            cells.append(_cell(table.value(record.scene, metric) if is_papers else None, 2))
    return tuple(cells)


def _mean_row(
    benchmark: Benchmark, name: str, records: Sequence[Record], columns: Sequence[Column]
) -> tuple[str, ...]:
    """Means over the records of a variant that have a number; their count, if some have none."""
    cells = [name]
    for column in columns:
        values = [v for r in records if (v := column.value(r)) is not None]
        mean = _cell(sum(values) / len(values), column.digits) if values else MISSING
        cells.append(
            f"{mean} ({len(values)} of {len(records)})" if 0 < len(values) < len(records) else mean
        )
        if column.published is not None:
            table = column.published.table
            metric = column.published.metric
            cells.append(_cell(_published_mean(benchmark, table, metric, records), 2))
    return tuple(cells)


def _published_mean(
    benchmark: Benchmark, table: PublishedTable, metric: str, records: Sequence[Record]
) -> float | None:
    """Value of the records' variant if the table has such columns (over all the paper's scenes),
    else of their scenes; a mean alone only if all the paper's scenes are there."""
    variant = records[0].variant
    scenes = [r.scene for r in records]
    complete = set(benchmark.scenes) <= set(scenes) and bool(benchmark.scenes)
    of_variants = _columns_of_variants(benchmark, table)
    if of_variants:
        column = of_variants.get(variant)
        return None if column is None else table.value(column, metric)
    if not _is_papers(benchmark, variant):
        return None
    if table.columns == ("mean",):
        return table.value("mean", metric) if complete else None
    return table.mean(scenes, metric)


def _columns_of_variants(benchmark: Benchmark, table: PublishedTable) -> dict[str, str]:
    """The column of an ablation's table for each variant: for the variant with the paper's other
    settings, too, if the benchmark has both."""
    names = {variant.name for variant in benchmark.variants}
    found = dict[str, str]()
    for column in table.columns:
        with_all = f"{_OF_PAPER}-{column}"
        if {with_all, column} & names:
            found[with_all if with_all in names else column] = column
    return found


def _is_papers(benchmark: Benchmark, variant: str) -> bool:
    """Whether published figures of scenes belong to the rows of a variant: that of the paper's
    settings, if the benchmark has it, else its first variant; in the paper's time."""
    names = [v.name for v in benchmark.variants]
    own = _OF_PAPER if _OF_PAPER in names else names[0]
    return variant in (own, f"{own}-{_SECONDS}".removeprefix("-"))


def _name(record: Record) -> str:
    return f"{record.scene}, {record.variant}" if record.variant else record.scene


def _cell(value: float | int | None, digits: int) -> str:
    return MISSING if value is None else f"{value:.{digits}f}"


def _escape(cell: str) -> str:
    return cell.replace("|", "\\|").replace("\n", " ")


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
    benchmark = chapter.benchmark
    prefix = chapter.prefix
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
