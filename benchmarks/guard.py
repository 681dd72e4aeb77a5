"""Fails where a stage of a run costs more than it did, relative to a fixed computation.

    python benchmarks/guard.py [--rounds 2]     compare with guard.json (`make bench-guard`)
    python benchmarks/guard.py --record         write guard.json anew, after a change that is meant

A small video of ``geogs synth`` is run on the CPU again and again, in turns with the reference, a
mix of sorting, products of matrices, functions of arrays and filters of images that is none of ours
and stays as it is. What counts are seconds of the CPU, of all threads, the least of the rounds: of
each stage divided by those of the reference. So neither the speed of a machine nor what else it
does matters much; another kind of processor may, and is said. A first run, which compiles what is
not, is not counted.
"""

import argparse
import json
import platform
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from geogs.config import Config
from geogs_bench.machine import first_processor
from geogs_synth.sequence.replica_files import write_sequence
from run_profile import measured_run

RECORD = Path(__file__).with_name("guard.json")
LIMIT = 1.3
"""Times what a stage cost from which on it fails."""
LEAST = 0.03
"""Part of the cost of all stages below which one is not judged: the clock says little of it."""
FRAMES, WIDTH, HEIGHT = 40, 256, 192
STEPS = 150
"""Steps of the map's training."""


@dataclass(frozen=True)
class Costs:
    """What stages cost, in units of the reference."""

    processor: str
    reference_seconds: float
    stages: dict[str, float]

    @property
    def total(self) -> float:
        """Cost of all stages."""
        return sum(self.stages.values())


@dataclass(frozen=True)
class Finding:
    """A stage beside what it cost."""

    stage: str
    before: float | None
    """None if it was not there."""
    now: float | None
    """None if it is gone."""
    is_judged: bool
    """Whether it is long enough."""

    @property
    def is_slower(self) -> bool:
        """Whether the guard fails by it; a stage that was recorded and is gone counts, too, since
        what it did is done elsewhere."""
        if not self.is_judged or self.before is None:
            return False
        return self.now is None or self.now > LIMIT * self.before

    def __str__(self) -> str:
        cells = ["-" if x is None else f"{x:.3f}" for x in (self.before, self.now)]
        known = self.before is not None and self.now is not None and self.before > 0
        ratio = f"{self.now / self.before:.2f}" if known else "-"  # type: ignore[operator]
        verdict = "SLOWER" if self.is_slower else "" if self.is_judged else "short, not judged"
        return f"{self.stage:<26} {cells[0]:>8} {cells[1]:>8} {ratio:>6}  {verdict}".rstrip()


def compare(before: Costs, now: Costs) -> list[Finding]:
    """All stages, the costliest first; at the end all of them together, which is judged, too."""
    names = sorted({*before.stages, *now.stages}, key=lambda n: -_larger(n, before, now))
    found = [
        Finding(
            name, before.stages.get(name), now.stages.get(name),
            _larger(name, before, now) >= LEAST * before.total,
        )
        for name in names
    ]  # fmt: skip
    return [*found, Finding("all", before.total, now.total, True)]


def _larger(name: str, *costs: Costs) -> float:
    return max(c.stages.get(name, 0.0) for c in costs)


def reference() -> float:
    """Seconds of the CPU of the fixed computation."""
    random = np.random.default_rng(0)
    numbers = random.random(2_000_000, np.float32)
    matrices = random.random((64, 160, 160), np.float32)
    picture = random.integers(0, 256, (960, 1280, 3), np.uint8)
    start = time.process_time()
    for _ in range(2):
        order = np.argsort(numbers, kind="stable")
        np.exp(-numbers[order]).cumsum()
        (matrices @ matrices.transpose(0, 2, 1)).sum()
        for _ in range(4):
            cv2.GaussianBlur(picture, (9, 9), 2.0)
            cv2.remap(picture, numbers[: 640 * 480].reshape(480, 640) * 900,
                      numbers[-640 * 480 :].reshape(480, 640) * 900, cv2.INTER_LINEAR)  # fmt: skip
    return time.process_time() - start


def config() -> Config:
    """Defaults, but for little training."""
    default = Config()
    return replace(default, mapping=replace(default.mapping, final_iterations=STEPS))


def measure(rounds: int) -> Costs:
    """Run and reference in turns; the least of each."""
    cv2.setNumThreads(1)
    stages: dict[str, list[float]] = {}
    references = []
    with tempfile.TemporaryDirectory() as folder:
        video = Path(folder) / "room"
        write_sequence(video, FRAMES, WIDTH, HEIGHT, seed=3)
        for number in range(rounds + 1):
            references += [reference() for _ in range(3)]
            meter, _, frames = measured_run(video, config(), "cpu", profiles=False)
            assert frames == FRAMES
            for stage, seconds in meter.processor.items() if number else ():
                stages.setdefault(stage, []).append(seconds)
    unit = min(references)
    least = {stage: round(min(seconds) / unit, 4) for stage, seconds in stages.items()}
    return Costs(processor(), round(unit, 4), least)


def processor() -> str:
    """What the costs were measured on; names alone, as "AMD EPYC", stand for many generations."""
    said = first_processor()
    if "model name" not in said:
        return platform.processor() or platform.machine()
    number = (f"{key.split()[-1]} {said[key]}" for key in ("cpu family", "model") if key in said)
    return ", ".join([said["model name"], *number])


def read(path: Path) -> Costs:
    """Costs that were recorded."""
    known = json.loads(path.read_text())
    return Costs(known["processor"], known["reference_seconds"], known["stages"])


def write(path: Path, costs: Costs, commit: str) -> None:
    """Record costs, and of which commit they are."""
    path.write_text(json.dumps({"commit": commit, **asdict(costs)}, indent=2) + "\n")


def verdict(before: Costs, now: Costs) -> tuple[list[str], bool]:
    """What to print, and whether nothing has become slower."""
    found = compare(before, now)
    lines = [f"{'stage':<26} {'recorded':>8} {'now':>8} {'ratio':>6}", *map(str, found)]
    if before.processor != now.processor:
        lines.append(
            f"note: recorded on {before.processor}, this is {now.processor}; where all stages "
            "have changed alike, record anew."
        )
    slower = [finding.stage for finding in found if finding.is_slower]
    if slower:
        lines.append(f"More than {LIMIT} times what was recorded: {', '.join(slower)}.")
    return lines, not slower


def _commit() -> str:
    call = ["git", "-C", str(RECORD.parent), "rev-parse", "--short", "HEAD"]
    done = subprocess.run(call, capture_output=True, text=True, check=False)
    return done.stdout.strip()


def main() -> int:
    """Measure, and record or compare; 1 where a stage has become slower."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--record", action="store_true")
    given = parser.parse_args()
    now = measure(given.rounds)
    if given.record:
        write(RECORD, now, _commit())
        print(RECORD.read_text(), end="")
        return 0
    lines, is_good = verdict(read(RECORD), now)
    print("\n".join(lines))
    return 0 if is_good else 1


if __name__ == "__main__":
    sys.exit(main())
