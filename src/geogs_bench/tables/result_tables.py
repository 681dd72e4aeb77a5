"""Tables of results: a row for each scene, their mean, and the published figures beside ours."""

from collections.abc import Sequence
from dataclasses import dataclass

from geogs_bench.benchmark import Benchmark, Column, Layout
from geogs_bench.published import PublishedTable
from geogs_bench.results.record import Record

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
        (row.method, row.metric, *(f"{v:.2f}" for v in row.values),
         *((f"{row.mean:.2f}",) if has_mean and row.mean is not None else ()))
        for row in table.rows
    ]  # fmt: skip
    note = f"{table.caption}. Figures of {table.source}, not measured here ({table.label})."
    return Table(f"Published: {table.label}", header, tuple(rows), note)


def _layout_tables(
    benchmark: Benchmark, layout: Layout, columns: Sequence[Column], records: Sequence[Record]
) -> list[Table]:
    title, header = layout.title, _header(columns, records)
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
            table, metric = column.published.table, column.published.metric
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
        cells.append(f"{mean} ({len(values)} of {len(records)})" if 0 < len(values) < len(records)
                     else mean)  # fmt: skip
        if column.published is not None:
            table, metric = column.published.table, column.published.metric
            cells.append(_cell(_published_mean(benchmark, table, metric, records), 2))
    return tuple(cells)


def _published_mean(
    benchmark: Benchmark, table: PublishedTable, metric: str, records: Sequence[Record]
) -> float | None:
    """Value of the records' variant if the table has such columns (over all the paper's scenes),
    else of their scenes; a mean alone only if all the paper's scenes are there."""
    variant, scenes = records[0].variant, [r.scene for r in records]
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
