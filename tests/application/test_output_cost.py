"""What mesh and files are going to take, from a rehearsal with a clock that only it moves on."""

from dataclasses import replace

import pytest

from geogs.application import output_cost
from geogs.application.output_cost import (
    CAUTION,
    COARSER,
    MAX_MESH_TIME,
    ONE_VIEW,
    MeshTimes,
    OutputForecast,
)
from geogs.errors import InputError
from geogs.mapping.time_budget import TimeBudget
from geogs.reconstruction import Reconstruction
from posed_scene import ball_and_wall


class FakeClock:
    """Seconds that pass when they are told to."""

    def __init__(self) -> None:
        self.now = 50.0

    def __call__(self) -> float:
        return self.now


def test_what_comes_before_the_first_view_of_a_stage_is_of_the_surface():
    clock = FakeClock()
    times = MeshTimes(clock)
    reports = [
        (2.0, "fuse", 1), (0.5, "fuse", 2), (0.5, "fuse", 3), (3.0, "colour", 1),
        (0.25, "colour", 2), (0.25, "colour", 3), (1.0, "merge", 0), (4.0, "merge", 1),
    ]  # fmt: skip
    for seconds, stage, done in reports:
        clock.now += seconds
        times(stage, done, 3)
    assert times.seconds == {"surface": 10.0, "views": 1.5}


@pytest.fixture(scope="module")
def searched() -> Reconstruction:
    """Five views with their depths."""
    scene = ball_and_wall()

    def interrupt(stage: str, fraction: float) -> None:
        if stage == "depth":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        scene.finish(progress=interrupt)
    return scene


@pytest.fixture
def scene(searched, monkeypatch) -> Reconstruction:
    """The same for each test, with settings that a forecast may change."""
    monkeypatch.setattr(searched, "config", searched.config)
    return searched


@pytest.fixture
def rehearsed() -> list[int]:
    """How many views each rehearsal had."""
    return []


@pytest.fixture
def rehearsal(monkeypatch, rehearsed) -> FakeClock:
    """A clock that only what is rehearsed moves on."""
    clock = FakeClock()

    def draw(folder: object, *of: object) -> None:
        clock.now += 0.5

    def write(folder: object, scene: object, camera: object, renders: list, images: bool) -> None:
        clock.now += 0.2 * len(renders)

    def extract(views: list, config: object, progress: MeshTimes | None = None) -> None:
        assert config.min_weight == ONE_VIEW
        rehearsed.append(len(views))
        for number in range(len(views)):
            clock.now += 1.0 if number == 0 else 0.3
            if progress is not None:
                progress("fuse", number + 1, len(views))
        clock.now += 2.0
        if progress is not None:
            progress("merge", 1, 1)

    monkeypatch.setattr(output_cost, "write_pictures", lambda *of: None)
    monkeypatch.setattr(output_cost, "write_page", draw)
    monkeypatch.setattr(output_cost, "write_keyframes", write)
    monkeypatch.setattr(output_cost, "extract_mesh", extract)
    return clock


def test_the_second_rehearsal_counts_by_views_and_by_surface(rehearsal, rehearsed, scene):
    clock, usual = rehearsal, scene.config.mesh
    cost = OutputForecast(scene, clock).first(lambda places: 3.0)
    assert rehearsed == [1, 3]
    # Three views: 0.2 s of files and 0.3 of fusion for each; 3 s for a third of the surface, in
    # larger voxels.
    assert cost.a_view == pytest.approx(CAUTION * 0.5)
    assert cost.once == pytest.approx(CAUTION * (0.5 + COARSER**2 * 3.0 * 3.0))
    assert cost.of(10) == pytest.approx(cost.once + 10 * cost.a_view)
    assert scene.config.mesh == usual


def test_a_mesh_gets_what_triangles_there_is_time_for(rehearsal, monkeypatch, scene):
    clock, usual = rehearsal, scene.config.mesh
    whole = CAUTION * (0.5 + COARSER**2 * 3.0 * 3.0)
    monkeypatch.setattr(TimeBudget, "left", 0.5 * whole / MAX_MESH_TIME)
    cost = OutputForecast(scene, clock).first(lambda places: 3.0)
    assert cost.once == pytest.approx(0.5 * whole)
    triangles = scene.config.mesh.triangle_budget
    assert 1000 < triangles < usual.triangle_budget
    assert scene.config.mesh == replace(usual, triangle_budget=triangles)


def test_a_rehearsal_without_a_surface_says_nothing_of_how_much_there_is(
    rehearsal, monkeypatch, scene
):
    def unsure(*of: object) -> None:
        raise InputError("no depth")

    monkeypatch.setattr(output_cost, "extract_mesh", unsure)
    plan = output_cost.plan_volume
    monkeypatch.setattr(output_cost, "plan_volume", unsure)
    forecast = OutputForecast(scene, rehearsal)
    forecast.first(lambda places: 3.0)
    monkeypatch.setattr(output_cost, "plan_volume", plan)
    assert forecast.settled().once == pytest.approx(CAUTION * 0.5)


def test_a_rehearsal_takes_time_and_leaves_nothing(scene):
    before = [*scene.mapper.table.mapped]
    forecast = OutputForecast(scene)
    cost, settled = forecast.first(lambda places: 1.5), forecast.settled()
    print(cost, settled)
    for found in (cost, settled):
        assert 0 < found.a_view < found.once < 120
    assert scene.mapper.table.mapped == before
    assert len(scene.snapshot()) > 0
