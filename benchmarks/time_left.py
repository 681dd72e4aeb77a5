"""How far the time that a command shows as left is from what it then took.

    python benchmarks/time_left.py [--keep RUN.json] run SOURCE [OPTIONS]
    python benchmarks/time_left.py [--keep RUN.json] reconstruct SOURCE [OPTIONS]
    python benchmarks/time_left.py RUN.json ...

The first two run the command as ``geogs`` does, without its line, and keep what it reported and
when. What would have been shown is then worked out every half second, from a tenth of the command
on up to its last second: the share of that time within 50 % and within 25 % of the truth. Of runs
that were kept it is worked out anew, which is how the constants of the forecast were chosen; so do
the tests, on ``tests/fixtures/time_left``.
"""

import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast, get_args

BEGUN = time.perf_counter()
if __name__ == "__main__":
    from geogs.cli.terminal.process import take_over

    take_over()  # as the command does, before NumPy is imported

import numpy as np  # noqa: E402  # the command's time counts all

from geogs.application.interrupt import Interruption  # noqa: E402
from geogs.application.progress.forecast import Forecast  # noqa: E402
from geogs.application.progress.plan import Plan, PosedPlan, RunPlan  # noqa: E402
from geogs.application.progress.run_progress import RunProgress  # noqa: E402
from geogs.application.run_settings import ReconstructSettings, RunSettings  # noqa: E402
from geogs.cli.options import record  # noqa: E402
from geogs.config import Preset, preset, preset_of, reconstruct_preset  # noqa: E402
from geogs.pose_estimate import PoseEstimate  # noqa: E402

EVERY, LAST = 0.5, 1.0
"""Seconds between two looks, and those at the end that are not judged."""
EARLY = 0.1
"""Part of the command before which nothing is judged."""
APART = 0.25
"""Seconds that reports of one stage are apart, of those that are kept."""

Event = list[Any]
"""Seconds since the command began, what was reported, and its two values."""


def plain(plan: Plan) -> dict[str, Any]:
    """A plan as JSON; its settings are those of a preset."""
    if isinstance(plan, RunPlan):
        own = {"preset": preset_of(plan.config), "frames": plan.frames}
        return own | {
            "size": plan.size, "calibrates": plan.calibrates, "maps_at_end": plan.maps_at_end
        }  # fmt: skip
    assert isinstance(plan, PosedPlan)
    names = (n for n in get_args(Preset) if reconstruct_preset(n).mapping == plan.config.mapping)
    end = None if plan.end is None else plan.end - BEGUN
    return {
        "preset": next(names, "default"), "views": plan.views, "size": plan.size,
        "before": dict(plan.before), "end": end,
    }  # fmt: skip


def planned(said: dict[str, Any], pace: float = 1.0) -> Plan:
    """The plan that :func:`plain` wrote, of a machine that takes so many times as long."""
    name, size = cast(Preset, said["preset"]), (said["size"][0], said["size"][1])
    if "frames" in said:
        calibrates, at_end = said["calibrates"], said["maps_at_end"]
        return RunPlan(preset(name), said["frames"], size, False, calibrates, at_end)
    end = None if said["end"] is None else pace * said["end"]
    return PosedPlan(reconstruct_preset(name), said["views"], size, False, said["before"], end)


class Recording(RunProgress):
    """Keeps what a command reports, and when."""

    def __init__(self) -> None:
        self.events: list[Event] = []

    def keep(self, kind: str, what: object, value: float = 0) -> None:
        """A report, unless one of the same stage was kept just before and it is not its end."""
        now, last = time.perf_counter() - BEGUN, self.events[-1] if self.events else None
        is_same = last is not None and last[1:3] == [kind, what] and kind == "stage"
        if is_same and value < 1 and now - last[0] < APART:
            return
        self.events.append([round(now, 2), kind, what, round(value, 4)])

    def write(self, text: str) -> None:
        """Shown, as always."""
        if text:
            print(f"{time.perf_counter() - BEGUN:6.1f} s  {text}")

    def plan(self, plan: Plan) -> None:
        """A plan of the command."""
        self.keep("plan", plain(plan))

    def expect(self, frames: int | None, begun: int = 0) -> None:
        """How many frames are expected."""
        self.keep("expect", frames, begun)

    def frame(self, status: PoseEstimate) -> None:
        """A frame was tracked."""
        self.keep("frame", status.frames, status.keyframes)

    def stage(self, name: str, fraction: float) -> None:
        """How far a stage is."""
        self.keep("stage", name, fraction)


@dataclass(frozen=True)
class Said:
    """What was said to be left in the course of a command, and what was."""

    times: np.ndarray
    """Seconds since it began."""
    left: np.ndarray
    truth: np.ndarray

    def within(self, part: float) -> float:
        """Share of the time in which what was said was so near to the truth, in parts of it."""
        end = self.times[0] + self.truth[0]
        judged = (self.times > EARLY * end) & (self.truth > LAST)
        errors = np.abs(self.left[judged] / self.truth[judged] - 1)
        return float((errors < part).mean())


def said(events: Sequence[Event], pace: float = 1.0) -> Said:
    """What is shown from the first plan on, by a machine that takes so many times as long."""
    now, forecast = 0.0, cast(Forecast, None)

    def hear(kind: str, what: Any, value: float) -> None:
        nonlocal forecast
        if kind == "plan" and forecast is None:
            forecast = Forecast(planned(what, pace), lambda: now)
        elif kind == "plan":
            forecast.change(planned(what, pace))
        elif forecast is not None and kind == "expect":
            forecast.expect(int(value))
        elif forecast is not None and kind == "frame":
            forecast.frame(what, int(value))
        elif forecast is not None and kind == "stage":
            forecast.stage(what, value)

    end, waiting = pace * events[-1][0], list(events)
    begin = pace * next(time for time, kind, *_ in events if kind == "plan")
    times, left = np.arange(begin, end, EVERY), []
    for look in times:
        while waiting and pace * waiting[0][0] <= look:
            seconds, *report = waiting.pop(0)
            now = pace * seconds
            hear(*report)
            if forecast is not None:
                forecast.left()
        now = float(look)
        left.append(forecast.left())
    return Said(times, np.array(left), end - times)


def followed(command: str, argv: Sequence[str]) -> list[Event]:
    """Run a command to its end: what it reported."""
    progress = Recording()
    work: Callable[[], object]
    if command == "run":
        from geogs.application.run import run
        from geogs.cli.run import parse

        settings = record(RunSettings, parse(argv))
        work = lambda: run(settings, progress, Interruption())  # noqa: E731
    else:
        from geogs.application.reconstruct import reconstruct_to_folder
        from geogs.cli.reconstruct import parse as parse_reconstruct

        posed = record(ReconstructSettings, parse_reconstruct(argv))
        work = lambda: reconstruct_to_folder(posed, progress, Interruption())  # noqa: E731
    work()
    progress.keep("end", "")
    return progress.events


def main(argv: list[str]) -> None:
    """Judge a command, or runs that were kept."""
    kept = None
    if argv[:1] == ["--keep"]:
        kept, argv = Path(argv[1]), argv[2:]
    if argv and argv[0] in ("run", "reconstruct"):
        runs = {" ".join(argv): followed(argv[0], argv[1:])}
        if kept is not None:
            write(kept, next(iter(runs.values())))
    else:
        runs = {name: json.loads(Path(name).read_text()) for name in argv}
    print("| command | seconds | within 50 % | within 25 % |\n|---|---:|---:|---:|")
    for name, events in runs.items():
        shown = said(events)
        near = " | ".join(f"{100 * shown.within(part):.0f} %" for part in (0.5, 0.25))
        print(f"| {name} | {events[-1][0]:.0f} | {near} |")


def write(path: Path, events: Sequence[Event]) -> None:
    """A run, one report a line."""
    path.write_text("[\n" + ",\n".join(map(json.dumps, events)) + "\n]\n")


if __name__ == "__main__":
    main(sys.argv[1:])
