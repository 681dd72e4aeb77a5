"""The adjustment of parts against one of everything."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from geogs.config import Config
from geogs.loop import keyframe_matches
from geogs.loop.keyframe_matches import GLOBAL_OPTIONS
from geogs.tracking.flow.operator_choice import build_operator
from geogs.tracking.graph.frame_graph import FrameGraph
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeTable
from geogs.world.loops import RelativePoses
from geogs_fleet.join import adjust
from geogs_fleet.join.adjust import adjusted
from geogs_fleet.join.gauge import Gauge
from geogs_fleet.join.links import Link, loaded_keyframes
from geogs_fleet.join.matches import Matches
from geogs_fleet.join.part import Part, PartViews, describe, opened
from geogs_fleet.join.part_graph import Placement
from geogs_fleet.join.records import read_record, write_record
from joined_parts import CAMERA, make_part
from one_process import OneProcess

PLACES = [np.linspace(-0.8, -0.1, 4), np.linspace(-0.4, 0.4, 4), np.linspace(0.1, 0.8, 4)]


class Recording(OneProcess):
    """Keeps the matches, which are deleted as soon as there are newer ones."""

    def __init__(self, folder):
        self.folder = folder
        self.files = []

    def map(self, stage, function, jobs):
        done = super().map(stage, function, jobs)
        if stage == "matching":
            for path in (path for job in jobs for path in job[-1]):
                self.files.append(Path(shutil.copy(path, self.folder)))
        return done


def make_parts(folder: Path) -> None:
    for n, places in enumerate(PLACES):
        part = Part(str(n), make_part(folder / str(n), places, 0))
        describe(part, CAMERA, folder / f"{n}.safetensors")


@pytest.fixture
def placed(once, monkeypatch):
    """Three parts that were put together badly; the first and the last share nothing."""
    rng, config = np.random.default_rng(0), Config()
    monkeypatch.setattr(adjust, "ROUNDS", 1)
    folder, parts, files, placements = once("described-parts", make_parts), [], [], {}
    for n in range(len(PLACES)):
        parts.append(Part(str(n), folder / str(n)))
        files.append(folder / f"{n}.safetensors")
        T = torch.from_numpy(read_record(PartViews, files[-1]).T_cw)
        T[:, :3, 3] += torch.from_numpy(rng.normal(0, 0.003, 3)) * (n > 0)
        placements[n] = Placement(T, torch.ones(len(T)))
    none = torch.zeros(0, dtype=torch.long)
    numbers = torch.zeros(0, 7, dtype=torch.float64)
    relative = RelativePoses(none, none, numbers.new_zeros(0, 4, 4), numbers, none.bool())
    links = tuple(Link((n, 3), (n + 1, 0), torch.eye(4), 1.0, relative) for n in range(2))
    gauge = Gauge({n: torch.eye(4) for n in range(3)}, links)
    return parts, files, placements, gauge, config


def test_parts_together_are_adjusted_as_one_problem(placed, tmp_path, monkeypatch):
    parts, files, placements, gauge, config = placed
    # Of all parts together nobody asks what a step is worth. Sums are in another order: with depths
    # damped as little as usual the rounding would show in weak directions.
    options = replace(GLOBAL_OPTIONS, least_damping=None, depth_damping=1e-3)
    monkeypatch.setattr(adjust, "GLOBAL_OPTIONS", options)
    (tmp_path / "kept").mkdir()
    workers = Recording(tmp_path / "kept")
    found = adjusted(
        parts, files, placements, gauge, CAMERA, config, workers, tmp_path / "work"
    )  # fmt: skip

    grid = SampleGrid(CAMERA)
    operator = build_operator(config.tracking, grid)
    segment = KeyframeTable.on(grid, operator.encode).new_set()
    ids = {}
    for n, part in enumerate(parts):
        views, T = read_record(PartViews, files[n]), placements[n].T_cw
        result = opened(part)
        for place, k in loaded_keyframes(segment, operator, result, views, range(4), T).items():
            ids[n, place] = k.id
    graph = FrameGraph(segment, operator)
    for path in workers.files:
        for (a, b), edge in read_record(Matches, path).edges().items():
            graph.edges[ids[a], ids[b]] = edge
    assert {(a // 4, b // 4) for a, b in graph.edges} == {
        (n, m) for n in range(3) for m in range(3) if abs(n - m) < 2
    }
    graph.adjust(list(graph.edges), segment.ids[1:], segment.ids, options)
    for n in range(3):
        wanted = segment.poses([ids[n, place] for place in range(4)])
        moved = float((wanted - placements[n].T_cw).abs().max())
        assert float((found[n].T_cw - wanted).abs().max()) < 1e-3 * moved + 1e-7
    assert torch.allclose(found[0].T_cw[0], placements[0].T_cw[0], rtol=0, atol=1e-12)


def test_what_has_settled_is_not_matched_again(placed, tmp_path, monkeypatch):
    monkeypatch.setattr(adjust, "ROUNDS", keyframe_matches.ROUNDS)
    parts, files, placements, gauge, _ = placed
    matched = []

    class Counting(OneProcess):
        def map(self, stage, function, jobs):
            done = super().map(stage, function, jobs)
            if stage == "matching":
                matched.append((sum(d.fresh for d in done), sum(len(d.ends) for d in done) // 2))
            return done

    adjusted(parts, files, placements, gauge, CAMERA, Config(), Counting(), tmp_path / "work")
    (fresh, pairs), *again = matched
    assert fresh == pairs > 20
    assert [p for _, p in again] == [pairs] * len(again)
    assert again[-1][0] < 0.3 * pairs


def test_a_part_that_matches_nothing_stays(placed, tmp_path):
    """One keyframe alone, too far from all others to see what they do."""
    parts, files, placements, gauge, config = placed
    lone = Part("lone", make_part(tmp_path / "lone", np.array([0.7, 0.8]), 0))
    views = tmp_path / "lone.safetensors"
    describe(lone, CAMERA, views)
    T = torch.from_numpy(read_record(PartViews, views).T_cw)[:1]
    T[:, :3, 3] += 50.0
    parts, files = [*parts[:2], lone], [*files[:2], views]
    one = read_record(PartViews, views)
    fields = (one.T_cw[:1], one.timestamp[:1], one.inverse_depth[:1], one.information[:1])
    write_record(views, PartViews(*fields, one.features[:1]))
    placements = {**placements, 2: Placement(T, torch.ones(1))}
    found = adjusted(
        parts, files, placements, gauge, CAMERA, config, OneProcess(), tmp_path / "work"
    )
    assert torch.allclose(found[2].T_cw, T, rtol=0, atol=1e-9)
    assert float((found[1].T_cw - placements[1].T_cw).abs().max()) > 1e-4
