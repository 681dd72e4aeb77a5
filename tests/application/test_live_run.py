"""A run of a source that does not wait, until it is asked to stop."""

import json
import threading
from dataclasses import replace
from pathlib import Path

import pytest

from geogs.application.interrupt import Stop
from geogs.application.run import run
from geogs.application.run_settings import RunSettings
from geogs.application.viewer.observer import RunObserver
from geogs.config import Config
from geogs.errors import InputError
from geogs.executors.live import Live
from geogs.io.sources.live.feeds import Played

LAST = 24
"""Frame at which somebody stops it."""


class InStep(Played):
    """Gives the next frame when the last has been looked at, however slow the machine is."""

    go = threading.Semaphore(1)

    def frames(self):
        for n, raw in enumerate(self._reader.read(0, None, 1)):
            self.go.acquire()
            yield raw
            if n == 3:  # one that is not waited for
                self.go.release()


class Onlooker(RunObserver):
    """Lets the next frame come, and stops the run at the last."""

    def __init__(self, stop: Stop) -> None:
        self.stop, self.states = stop, []

    def frame(self, frame, status, slam) -> None:
        assert isinstance(slam.executor, Live)
        self.states.append(status.state.value)
        if frame.index == LAST:
            self.stop.request()
        InStep.go.release()


def settings(source: str, output: Path) -> RunSettings:
    c = Config()
    depth = replace(c.mapping.depth, planes=48)
    mapping = replace(
        c.mapping, render_long_edge=64, iterations=1, final_iterations=5, depth=depth,
        final_depth=False,
    )  # fmt: skip
    config = replace(c, mapping=mapping, tracking=replace(c.tracking, init_keyframes=6))
    return RunSettings((Path(source),), config, output=output, device="cpu")


@pytest.mark.system
def test_a_live_run_ends_when_asked_and_finishes_its_map(
    small_room, tmp_path, monkeypatch, no_report
):
    monkeypatch.setattr("geogs.io.sources.live.feeds.Played", InStep)
    stop = Stop()
    onlooker = Onlooker(stop)
    result = run(settings(f"play:{small_room}", tmp_path / "out"), None, stop, onlooker)
    assert onlooker.states[-1] == "tracking"
    assert not result.is_interrupted
    assert not result.can_resume
    assert not (tmp_path / "out" / "checkpoint").exists()
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (summary["kind"], summary["frames"], summary["refined"]) == ("play", LAST + 1, True)
    assert summary["dropped_frames"] <= 2
    assert summary["segments"][0]["fate"] == "world"


def test_a_map_is_not_written_over_by_the_run_that_goes_on_in_it(tmp_path, small_room):
    with pytest.raises(InputError, match="holds no result"):
        run(replace(settings(str(small_room), tmp_path / "out"), map=tmp_path))
