"""What mesh and files are going to take, from a rehearsal with a clock that only it moves on."""

import pytest

from geogs.application import output_forecast
from geogs.application.output_forecast import CAUTION, OutputForecast, StageTimes
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
    times = StageTimes(clock)
    reports = [
        (2.0, "fuse", 1), (0.5, "fuse", 2), (0.5, "fuse", 3), (3.0, "colour", 1),
        (0.25, "colour", 2), (0.25, "colour", 3), (1.0, "merge", 0), (4.0, "merge", 1),
    ]  # fmt: skip
    for seconds, stage, done in reports:
        clock.now += seconds
        times(stage, done, 3)
    assert times.seconds == {"surface": 10.0, "views": 1.5}


@pytest.fixture
def scene() -> Reconstruction:
    """Five views with their depths."""
    scene = ball_and_wall()

    def interrupt(stage: str, fraction: float) -> None:
        if stage == "depth":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        scene.finish(progress=interrupt)
    return scene


def test_the_second_rehearsal_counts_by_views_and_by_surface(monkeypatch, scene):
    clock, drawn, rehearsed = FakeClock(), [], []

    def draw(folder: object, *of: object) -> None:
        drawn.append(folder)
        clock.now += 9.0 if len(drawn) == 1 else 0.5

    def write(folder: object, scene: object, camera: object, renders: list, images: bool) -> None:
        clock.now += 0.2 * len(renders)

    def extract(views: list, config: object, progress: StageTimes) -> None:
        rehearsed.append(len(views))
        for number in range(len(views)):
            clock.now += 1.0 if number == 0 else 0.3
            progress("fuse", number + 1, len(views))
        clock.now += 2.0
        progress("merge", 1, 1)

    monkeypatch.setattr(output_forecast, "write_report", draw)
    monkeypatch.setattr(output_forecast, "write_keyframes", write)
    monkeypatch.setattr(output_forecast, "extract_mesh", extract)
    cost = OutputForecast(scene, clock).first(lambda places: 3.0)
    assert rehearsed == [1, 3]
    # Three views: 0.2 s of files and 0.3 of fusion for each; 3 s for a third of the surface.
    assert cost.a_view == pytest.approx(CAUTION * 0.5)
    assert cost.once == pytest.approx(CAUTION * (0.5 + 3.0 * 3.0))
    assert cost.of(10) == pytest.approx(cost.once + 10 * cost.a_view)


def test_a_rehearsal_takes_time_and_leaves_nothing(scene):
    before = scene.mapper.state()
    forecast = OutputForecast(scene)
    cost, settled = forecast.first(lambda places: 1.5), forecast.settled(1e9)
    print(cost, settled)
    for found in (cost, settled):
        assert 0 < found.a_view < found.once < 120
    assert scene.mapper.state().mapped == before.mapped
    assert len(scene.snapshot()) > 0
