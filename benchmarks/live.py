"""Latency of ``Slam.process`` during concurrent training of the map, at a camera's frame rate.

    python benchmarks/live.py SEQUENCE --device cuda [--fps 30] [--stop 900] [--seconds 60]

A frame is due every 1/fps seconds; one that comes while the frame before it is still tracked is
dropped, as by a live source. Frames up to the first pose, and for ``--warm`` seconds after it, are
left out: kernels are loaded and compiled then. The stages of the slowest frames show where their
time went.
"""

import argparse
import cProfile
import json
import pstats
import time
from dataclasses import replace

import numpy as np

import geogs
from geogs.config import InputConfig

LIMITS = 0.033, 0.050
"""Limits in seconds for 99 of 100 frames: the aim, and the least requirement."""


def main() -> None:
    """Play the sequence, print the percentiles."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sequence")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--fps", type=float, default=30.0)
    parser.add_argument("--stop", type=int)
    parser.add_argument("--long-edge", type=int, default=640)
    parser.add_argument("--warm", type=float, default=3.0, help="seconds after the first pose")
    parser.add_argument("--operator", default="classical", help="of the flow")
    parser.add_argument("--in-line", action="store_true", help="map between frames, as files do")
    parser.add_argument("--json", help="file for the figures")
    parser.add_argument("--profile", type=int, default=0, metavar="N",
                        help="say the N functions in which process itself spends most time; that "
                        "costs time, too")  # fmt: skip
    given = parser.parse_args()
    source = geogs.open_source(
        given.sequence, InputConfig(stop=given.stop, long_edge=given.long_edge)
    )
    frames = list(source)
    config = geogs.Config()
    config = replace(
        config,
        input=InputConfig(long_edge=given.long_edge),
        tracking=replace(config.tracking, operator=given.operator),
    )
    slam = geogs.Slam(source.camera, config, given.device, live=not given.in_line)
    profile = cProfile.Profile() if given.profile else None
    figures = play(slam, frames, given.fps, given.warm, profile)
    for name, value in figures.items():
        print(f"{name}: {value}")
    if given.json:
        with open(given.json, "w") as file:
            json.dump(figures, file, indent=2)
    if profile is not None:
        pstats.Stats(profile).sort_stats("tottime").print_stats(given.profile)
        pstats.Stats(profile).sort_stats("cumulative").print_stats(given.profile)


def play(
    slam: geogs.Slam,
    frames: list[geogs.Frame],
    fps: float,
    warm: float,
    profile: cProfile.Profile | None = None,
) -> dict[str, object]:
    """Feed frames when they are due, drop those that come too soon; return the results.

    The profile covers the counted calls, in this thread alone.
    """
    took: list[float] = []
    stages: list[dict[str, float]] = []
    kinds: list[str] = []
    tracked, behind, dropped, counted_from = 0, 0, 0, None
    began = time.perf_counter()
    index = 0
    while index < len(frames):
        due = began + index / fps
        now = time.perf_counter()
        if now < due:
            time.sleep(due - now)
        before, made = dict(slam.stopwatch.seconds), slam.world.keyframes.next_id
        start = time.perf_counter()
        is_counted = counted_from is not None and start >= counted_from
        if profile is not None and is_counted:
            pose = profile.runcall(slam.process, frames[index])
        else:
            pose = slam.process(frames[index])
        end = time.perf_counter()
        if pose.is_tracked and counted_from is None:
            counted_from = end + warm
        if is_counted:
            took.append(end - start)
            after = slam.stopwatch.seconds
            stages.append({k: s - before.get(k, 0.0) for k, s in after.items()})
            kinds.append(kind(stages[-1], slam.world.keyframes.next_id > made))
            tracked += pose.is_tracked
            behind = max(behind, getattr(slam.executor.mapping, "waiting", 0))
        newest = max(index + 1, int((end - began) * fps))
        dropped += min(newest, len(frames)) - index - 1
        index = newest
    waited = time.perf_counter()
    slam.end_stream()
    waited = time.perf_counter() - waited
    if not took:
        return {"frames": 0, "dropped": dropped, "why": "there was no pose, or no time after it"}
    ms = 1000 * np.array(took)
    slowest = np.argsort(ms)[-max(len(ms) // 100, 1) :]
    worst = {k: round(1000 * float(np.mean([stages[n].get(k, 0.0) for n in slowest])), 1)
             for k in stages[-1]}  # fmt: skip
    p99 = float(np.percentile(ms, 99))
    return {
        "frames counted": len(took),
        "frames dropped": dropped,
        "share tracked": round(tracked / len(took), 4),
        "ms in 50, 90, 99, 100 of 100": [round(float(np.percentile(ms, q)), 1)
                                         for q in (50, 90, 99, 100)],
        "ms in 50, 90, 100 of 100, and how many there are, by kind": by_kind(ms, kinds),
        "99th percentile": "aim" if p99 <= 1000 * LIMITS[0] else
                           "at least" if p99 <= 1000 * LIMITS[1] else "missed",
        "ms of the stages in the slowest hundredth": worst,
        "keyframes": len(slam.segments.keyframe_ids),
        "loop closures": slam.loops.table.closures,
        "disks": len(slam.snapshot()),
        "most tasks that mapping was behind": behind,
        "seconds of mapping after the last frame": round(waited, 2),
    }  # fmt: skip


def kind(stages: dict[str, float], has_keyframe: bool) -> str:
    """Kind of a frame: it waited for a keyframe to be completed, became one, or neither."""
    if stages.get("waiting", 0.0) > 0.001:
        return "waited"
    return "keyframe" if has_keyframe else "neither"


def by_kind(ms: np.ndarray, kinds: list[str]) -> dict[str, list[float]]:
    """Percentiles and number of frames of each kind."""
    found = {}
    for name in sorted(set(kinds)):
        of = ms[np.array(kinds) == name]
        found[name] = [*(round(float(np.percentile(of, q)), 1) for q in (50, 90, 100)), len(of)]
    return found


if __name__ == "__main__":
    main()
