"""Joins parts to one result, from their description to the files."""

import json
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from geogs.application.machine.device import device_summary, peak_memory
from geogs.application.results.result_page import write_page, write_pictures
from geogs.application.results.saved_result import SavedResult, load_result
from geogs.application.results.summary import state_spans
from geogs.config import Config
from geogs.errors import InputError
from geogs.guard.atomic import prepare_output_folder, write_text
from geogs.guard.replacement import replaced
from geogs.io.writers.map_file import load_map_file
from geogs.io.writers.ply_writer import write_splats
from geogs.mesh.triangle_mesh import Mesh
from geogs.stopwatch import Stopwatch
from geogs.types import MapSnapshot
from geogs.version import __version__
from geogs_fleet.join.adjust import adjusted
from geogs_fleet.join.gauge import Gauge, common_gauge
from geogs_fleet.join.joined_disks import joined_disks, kept, merge_disks, move_disks
from geogs_fleet.join.joined_files import JoinedPart, fingerprint, spans_of, write_map, write_poses
from geogs_fleet.join.joined_surface import (
    SpacePlan,
    coloured,
    equal_runs,
    joint_mesh,
    plan_space,
    render_views,
)
from geogs_fleet.join.links import Link, candidates, links_of
from geogs_fleet.join.part import Part, PartViews, describe, opened
from geogs_fleet.join.part_graph import Placement, placed
from geogs_fleet.join.records import read_record
from geogs_fleet.workers import Workers

_PAIRS = 24
"""Pairs of keyframes verified in one job."""
_RUNS_PER_WORKER = 4
"""Jobs for each worker to render runs of keyframes."""


@dataclass(frozen=True)
class Joint:
    """Outcome of a join."""

    output: Path
    unjoined: tuple[str, ...]
    """Parts that could not be joined with the others: they only have their own results."""
    sentence: str
    """Sentence for the terminal."""


class _Join:
    def __init__(
        self, parts: Sequence[Part], output: Path, config: Config, workers: Workers, device: str
    ) -> None:
        self.parts = list(parts)
        self.config = config
        self.workers = workers
        self.device = device
        self.output = output
        self.work = output / "join"
        self.work.mkdir()
        self.files = [self.work / f"views-{n:04d}.safetensors" for n in range(len(parts))]
        self.camera = opened(parts[0]).camera
        self.stopwatch = Stopwatch()

    def links(self) -> list[Link]:
        jobs = []  # one at a time
        views = (read_record(PartViews, file) for file in self.files)
        for (a, b), pairs in candidates(views, self.config.loop).items():
            for start in range(0, len(pairs), _PAIRS):
                jobs.append(
                    (
                        (a, b),
                        (self.parts[a], self.parts[b]),
                        (self.files[a], self.files[b]),
                        pairs[start : start + _PAIRS],
                        self.camera,
                        self.config,
                    )
                )
        return [link for some in self.workers.map("verifying", links_of, jobs) for link in some]

    def disks(self, gauge: Gauge, placements: dict[int, Placement]) -> MapSnapshot:
        """Move and merge the maps of all parts; the earlier part's disks stay."""
        numbers = gauge.parts
        files = {n: self.work / f"disks-{n:04d}.safetensors" for n in numbers}
        moves = [
            (self.parts[n], self.files[n], placements[n], files[n], self.device) for n in numbers
        ]
        self.workers.map("moving maps", move_disks, moves)
        merges = [(files[n], [files[m] for m in gauge.linked[n] if m < n]) for n in numbers]
        keep = self.workers.map("merging maps", merge_disks, merges)
        pairs = zip(numbers, keep, strict=True)
        return joined_disks([kept(load_map_file(files[n], "cpu").disks, k) for n, k in pairs])

    def surface(self, count: int, disks: MapSnapshot) -> Mesh | None:
        """Write the mesh of the result, and the coloured splats of its disks."""
        folder = self.work / "renders"
        folder.mkdir(parents=True, exist_ok=True)
        runs = equal_runs(count, _RUNS_PER_WORKER * self.workers.at_once)
        renders = [(self.output, run, folder, self.device) for run in runs]
        views = [v for some in self.workers.map("rendering", render_views, renders) for v in some]
        try:
            space = plan_space(views, self.config.mesh, self.workers)
            mesh = joint_mesh(space, self.config.mesh, self.workers, self.device)
        except InputError:
            return None
        mesh.save(self.output / "mesh.ply")
        self._write_splats(disks, space)
        return mesh

    def _write_splats(self, disks: MapSnapshot, space: SpacePlan) -> None:
        none = np.zeros((0, 3), np.int32)
        points = Mesh(disks.position.numpy(), none, disks.normal.numpy())
        tolerance = 4 * float(disks.scale.median())
        colours = coloured(points, tolerance, space, self.workers) / 255.0
        write_splats(self.output / "splats.ply", disks, colours)


def join_parts(
    parts: Sequence[Part],
    output: Path,
    config: Config,
    workers: Workers,
    device: str = "cpu",
    adjust: bool = True,
    say: Callable[[str], None] = lambda sentence: None,
) -> Joint:
    """Write one result of the connected parts into a folder, as a run would write it.

    The first of these parts keeps its frame and unit. Parts that share nothing with the others stay
    unchanged.

    Args:
        parts: at least two.
        output: the folder; all workers have to see it.
        config: settings of place recognition, adjustment and surface.
        workers: they do the jobs.
        device: for rendering and fusion.
        adjust: whether keyframes are adjusted with the matches of overlapping parts; else links
            and parts alone determine their poses.
        say: receives a line on the progress of the work.

    Raises:
        InputError: a part cannot be used, or no two of them overlap.
        OutputError: a file cannot be written.
    """
    begin = time.perf_counter()
    output = prepare_output_folder(output)
    with replaced(output, "result") as new:
        join = _Join(parts, new, config, workers, device)
        joint = _joined(join, adjust, say, begin)
        shutil.rmtree(join.work)
    return replace(joint, output=output)


def _placed_parts(
    join: _Join, adjust: bool, say: Callable[[str], None]
) -> tuple[Gauge, dict[int, JoinedPart]]:
    """The connected parts with their poses in the joint world, by their numbers."""
    parts = join.parts
    config = join.config
    with join.stopwatch("describing"):
        files = zip(parts, join.files, strict=True)
        described = [(part, join.camera, file, join.device) for part, file in files]
        keyframes = sum(join.workers.map("describing", describe, described))
    say(f"{len(parts)} parts, {keyframes} keyframes.")
    views = [read_record(PartViews, file).outline() for file in join.files]
    with join.stopwatch("linking"):
        links = join.links()
        gauge = common_gauge(views, links)
    if len(gauge.world) < 2:
        raise InputError(
            f"No place of one part was recognised in another ({len(links)} single views alike); "
            "parts have to overlap, seen from similar sides."
        )
    say(f"{len(gauge.links)} links join {len(gauge.world)} of {len(parts)} parts.")
    with join.stopwatch("pose graph"):
        placements = placed(views, gauge)
    if adjust:
        with join.stopwatch("bundle adjustment"):
            placements = adjusted(
                parts,
                join.files,
                placements,
                gauge,
                join.camera,
                config,
                join.workers,
                join.work / "adjust",
            )
    results = {n: opened(parts[n]) for n in gauge.parts}
    spans = spans_of(
        [parts[n].name for n in gauge.parts],
        [results[n].trajectory.timestamps for n in gauge.parts],
    )
    return gauge, {
        n: JoinedPart(results[n], views[n], placements[n], span)
        for n, span in zip(gauge.parts, spans, strict=True)
    }


def _joined(join: _Join, adjust: bool, say: Callable[[str], None], begin: float) -> Joint:
    gauge, placed_parts = _placed_parts(join, adjust, say)
    unjoined = [part.name for n, part in enumerate(join.parts) if n not in gauge.world]
    parts = list(placed_parts.values())
    with join.stopwatch("moving and merging maps"):
        disks = join.disks(gauge, {n: part.placement for n, part in placed_parts.items()})
    say(f"{len(disks)} disks.")
    trajectory = write_poses(join.output, parts)
    write_map(join.output, parts, disks, join.camera, join.config)
    with join.stopwatch("mesh"):
        mesh = join.surface(sum(len(part.views.T_cw) for part in parts), disks)
    seconds = join.stopwatch.seconds
    summary: dict[str, Any] = {
        **_statistics([part.result for part in parts], gauge, unjoined, adjust),
        "videos": [asdict(part.span) for part in parts],
        "frames": len(trajectory.timestamps),
        "lost_spans": state_spans(trajectory, "lost"),
        "disks": len(disks),
        "mesh_faces": 0 if mesh is None else len(mesh.faces),
        "seconds": {
            name: round(spent, 3)
            for name, spent in {**seconds, "total": time.perf_counter() - begin}.items()
        },
        "peak_memory_bytes": peak_memory(),
        **device_summary(torch.device(join.device)),
    }
    write_text(join.output / "summary.json", json.dumps(summary, indent=2))
    written = load_result(join.output, join.device)
    report = join.output / "report"
    renders = written.renders
    write_pictures(report, renders)
    write_page(report, trajectory, renders, mesh, summary, written.disks)
    return Joint(join.output, tuple(unjoined), summary["verdict"]["sentence"])


def _statistics(
    results: Sequence[SavedResult], gauge: Gauge, unjoined: Sequence[str], adjusted: bool
) -> dict[str, Any]:
    """Part of the summary about the parts."""
    verdicts = [result.summary.get("verdict") for result in results]
    unreliable = [
        result.name
        for result, verdict in zip(results, verdicts, strict=True)
        if isinstance(verdict, dict) and verdict.get("is_reliable") is False
    ]
    whole = len(results) + len(unjoined)
    sentence = f"{len(results)} of {whole} parts are one place, by {len(gauge.links)} links."
    if unjoined:
        sentence += f" Nothing of the others was recognised in {', '.join(unjoined)}."
    if unreliable:
        sentence += f" Not reliable by themselves: {', '.join(unreliable)}."
    return {
        "source": " + ".join(str(result.summary.get("source", result.name)) for result in results),
        "kind": "joined parts",
        "fingerprint": fingerprint(results),
        "scale": "arbitrary (monocular)",
        "verdict": {"is_reliable": not unreliable and not unjoined, "sentence": sentence},
        "keyframes": sum(len(result.views.keyframe_id) for result in results),
        "parts": [str(result.folder) for result in results],
        "apart": list(unjoined),
        "links": len(gauge.links),
        "bundle_adjusted": adjusted,
        "versions": {"geogs": __version__, "torch": torch.__version__},
    }
