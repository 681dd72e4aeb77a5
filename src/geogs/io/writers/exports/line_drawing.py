"""Line drawings, such as floor plans: SVG and PDF on paper, DXF in true size.

DXF is that of R12, which every CAD program reads; it needs no tables, and no library.
"""

from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
from jaxtyping import Float

from geogs.guard.atomic import atomic_file, write_text

_SCALES = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10000)
"""Scales of a drawing on paper, as 1 to so many."""
_PAPER, _MARGIN = (0.277, 0.19), 0.02
"""Largest size of what is drawn, metres on paper (A4 without its margins), and its margin."""


@dataclass(frozen=True)
class LineDrawing:
    """Straight walls with their lengths, and other lines, in one plane."""

    title: str
    walls: Float[np.ndarray, "w 2 2"]
    """Both ends of each wall."""
    inward: Float[np.ndarray, "w 2"]
    """Unit normals of the walls, away from where their lengths are written."""
    others: Float[np.ndarray, "k 2 2"]
    """Both ends of each other line."""
    unit: str
    """Name of the unit of length."""

    def labels(self) -> list[tuple[Float[np.ndarray, "2"], float, str]]:
        """Centre, angle in degrees and text of each wall's length; texts can be read from below or
        from the right."""
        height = 0.012 * self.extent
        along = self.walls[:, 1] - self.walls[:, 0]
        lengths = np.linalg.norm(along, axis=1)
        angles = (np.degrees(np.arctan2(along[:, 1], along[:, 0])) + 80) % 180 - 80
        centres = self.walls.mean(1) - 1.2 * height * self.inward
        texts = [f"{x:.2f} m" if self.unit == "m" else f"{x:.3g}" for x in lengths.tolist()]
        return list(zip(centres, angles.tolist(), texts, strict=True))

    @property
    def extent(self) -> float:
        """Largest extent of all lines."""
        low, high = self.bounds
        return max(float((high - low).max()), 1e-9)

    @property
    def bounds(self) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
        """Least and largest coordinates of all lines."""
        points = np.concatenate([self.walls, self.others]).reshape(-1, 2)
        return points.min(0), points.max(0)


def write_drawing(path: Path, drawing: LineDrawing) -> None:
    """Write a drawing as SVG, PDF or DXF, by the ending of the path.

    Raises:
        OutputError: the file cannot be written.
    """
    if path.suffix.lower() == ".dxf":
        write_text(path, _dxf(drawing))
        return
    with atomic_file(path) as stream:
        stream.write(_on_paper(drawing, path.suffix.lower()[1:]))


def _on_paper(drawing: LineDrawing, kind: str) -> bytes:
    """The drawing on a page of its size, to a round scale where lengths are metres."""
    from matplotlib import rc_context
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

    low, high = drawing.bounds
    size = np.maximum(high - low, 0.02 * drawing.extent)
    is_wide = size[0] > size[1]
    least = float((size / (_PAPER if is_wide else _PAPER[::-1])).max())
    is_metric = drawing.unit == "m"
    scale = float(next((s for s in _SCALES if s >= least), least)) if is_metric else least
    paper = size / scale + 2 * _MARGIN
    with rc_context({"svg.hashsalt": "geogs", "svg.fonttype": "none", "pdf.fonttype": 42}):
        figure = Figure(figsize=tuple(paper / 0.0254))
        plot = figure.add_axes((0, 0, 1, 1))
        middle = (low + high) / 2
        plot.set(xlim=middle[0] + np.array([-0.5, 0.5]) * paper[0] * scale)
        plot.set(ylim=middle[1] + np.array([-0.5, 0.5]) * paper[1] * scale)
        plot.set_axis_off()
        plot.add_collection(LineCollection(list(drawing.others), colors="0.55", linewidths=0.4))
        plot.add_collection(
            LineCollection(list(drawing.walls), colors="black", linewidths=1.4, capstyle="round")
        )
        for (x, y), angle, text in drawing.labels():
            plot.text(x, y, text, rotation=angle, size=6, ha="center", va="center")
        ratio = f", 1:{scale:g}" if is_metric else f", lengths in {drawing.unit}"
        figure.text(0.5, _MARGIN / 3 / paper[1], drawing.title + ratio, size=7, ha="center")
        buffer = BytesIO()
        figure.savefig(buffer, format=kind, dpi=160, metadata={_DATES[kind]: None})
    return buffer.getvalue()


_DATES = {"svg": "Date", "pdf": "CreationDate"}
"""Names of the time in the files' metadata, which is left out: equal drawings are equal files."""


def _dxf(drawing: LineDrawing) -> str:
    """The drawing in its own unit: layers WALLS, LENGTHS and OTHER."""
    entities = [_line("WALLS", *line) for line in drawing.walls.tolist()]
    entities += [_line("OTHER", *line) for line in drawing.others.tolist()]
    height = 0.012 * drawing.extent
    for (x, y), angle, text in drawing.labels():
        # 72 = 1 and 73 = 2: centred on the point of the groups 11 and 21.
        entities.append(
            [(0, "TEXT"), (8, "LENGTHS"), (10, x), (20, y), (30, 0.0), (40, height), (1, text),
             (50, angle), (72, 1), (11, x), (21, y), (31, 0.0), (73, 2)]
        )  # fmt: skip
    groups: list[tuple[int, str | float]] = [(0, "SECTION"), (2, "HEADER"), (9, "$ACADVER")]
    groups += [(1, "AC1009"), (0, "ENDSEC")]
    groups += [(0, "SECTION"), (2, "ENTITIES")]
    groups += [group for entity in entities for group in entity]
    groups += [(0, "ENDSEC"), (0, "EOF")]
    return "".join(f"{code}\n{value}\n" for code, value in groups)


def _line(layer: str, start: list[float], end: list[float]) -> list[tuple[int, str | float]]:
    (x, y), (u, v) = start, end
    places = [(10, x), (20, y), (30, 0.0), (11, u), (21, v), (31, 0.0)]
    rounded: list[tuple[int, str | float]] = [(code, round(value, 6)) for code, value in places]
    return [(0, "LINE"), (8, layer), *rounded]
