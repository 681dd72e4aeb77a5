"""Endurance: random synthetic videos with random settings, killed and gone on with, for hours.

    python benchmarks/soak.py [--minutes 180] [--seed 0] [--size 160 120] [--frames 30 90]
        [--repeats 8] [--folder FOLDER]

Every round renders a video, runs it in a process of its own, which is killed now and then (SIGKILL,
SIGTERM, Ctrl-C, in the middle of whatever it does) and gone on with by ``--resume``, and checks
what it leaves: every exit code, no traceback, no NaN in any file, a summary as
docs/summary.schema.json says, nothing unfinished in the folder. Then one process runs the last
video ``--repeats`` times: how much its memory grows a frame, and whether files stay open. Ends with
1 if anything is wrong.
"""

import argparse
import gc
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from geogs.application.run import run
from geogs.application.saved_result import load_result
from geogs.application.settings import RunSettings
from geogs.config import preset
from geogs.errors import GeogsError
from json_schema import faults

GEOGS = [sys.executable, "-m", "geogs.cli.main"]
SCHEMA = Path(__file__).parents[1] / "docs" / "summary.schema.json"
HANGS = 1800.0
"""Seconds after which a process counts as one that hangs."""
MOST_LEAKED = 1024.0
"""Bytes a frame."""
WARM_UP = 2
"""Repetitions before memory counts: kernels are compiled, pools are filled."""
CHOICES: dict[str, tuple[str, ...]] = {
    "--stride": ("1", "2"),
    "--seed": ("0", "7"),
    "--preset": ("fast", "default"),
    "--mapping.window": ("3", "8"),
    "--mapping.iterations": ("2", "10"),
    "--mapping.render-long-edge": ("64", "128"),
    "--input.readout": ("0", "0.02", "auto"),
    "--mesh.detail": ("0.2", "1"),
    "--checkpoint-every": ("1", "5"),
    "--intrinsics": ("auto", "150,150,79.5,59.5"),
}
SWITCHES = ("--online-results", "--depth-mesh", "--no-keyframe-images")


def main() -> None:
    """Rounds until the time is over, then the repetitions."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=180.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--size", type=int, nargs=2, default=(160, 120))
    parser.add_argument("--frames", type=int, nargs=2, default=(30, 90))
    parser.add_argument("--repeats", type=int, default=8)
    parser.add_argument("--folder", type=Path, default=None)
    options = parser.parse_args()
    folder = options.folder or Path(tempfile.mkdtemp(prefix="geogs-soak-"))
    folder.mkdir(parents=True, exist_ok=True)
    dice, wrong, rounds = random.Random(options.seed), [], 0
    end = time.monotonic() + 60 * options.minutes
    while time.monotonic() < end or not rounds:
        found = list(one_round(folder / f"round-{rounds}", options, dice))
        wrong += found
        rounds += 1
        print(f"round {rounds}: {'; '.join(found) or 'well'}", flush=True)
    if options.repeats > WARM_UP + 1:
        wrong += repetitions(folder / f"round-{rounds - 1}" / "video", folder, options.repeats)
    print(f"{rounds} rounds, {len(wrong)} faults; everything is in {folder}")
    sys.exit(1 if wrong else 0)


def one_round(folder: Path, options: argparse.Namespace, dice: random.Random) -> Iterator[str]:
    """Render, run with interruptions, check; yields what is wrong."""
    video, out = folder / "video", folder / "out"
    width, height = options.size
    synth = [
        *GEOGS, "synth", str(video), "--frames", str(dice.randint(*options.frames)), "--width",
        str(width), "--height", str(height), "--seed", str(dice.randint(0, 999)), "--no-depth",
        "--camera", dice.choice(("clean", "phone")),
    ]  # fmt: skip
    if subprocess.run(synth, capture_output=True).returncode:
        yield "geogs synth fails"
        return
    command = [*GEOGS, "run", str(video), "-o", str(out), "--device", "cpu", *settings(dice)]
    print("  " + " ".join(command[3:]), flush=True)
    for kills in range(4):
        number = dice.choice((signal.SIGKILL, signal.SIGTERM, signal.SIGINT, None))
        number = None if kills == 3 else number
        code, said = ended(command, number, dice.uniform(3, 60))
        if "Traceback" in said or code not in (0, 2, 130, -signal.SIGKILL):
            yield f"ended with {code}: {said.strip().splitlines()[-1:]}"
        is_open = (out / "checkpoint" / "manifest.json").is_file()
        if code == 0 and not is_open:
            break
        if is_open:
            command = [*GEOGS, "run", "--resume", str(out), "--device", "cpu"]
    yield from wrong_in(out)


def settings(dice: random.Random) -> list[str]:
    """Some options with some of their values."""
    names = dice.sample(sorted(CHOICES), dice.randint(0, len(CHOICES)))
    words = [word for name in names for word in (name, dice.choice(CHOICES[name]))]
    return words + dice.sample(SWITCHES, dice.randint(0, len(SWITCHES)))


def ended(command: list[str], number: signal.Signals | None, seconds: float) -> tuple[int, str]:
    """The exit code of a process that gets a signal after a while, and what it said."""
    with tempfile.TemporaryFile("w+") as said:
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=said)
        try:
            process.wait(seconds if number else HANGS)
        except subprocess.TimeoutExpired:
            process.send_signal(number or signal.SIGKILL)
            try:
                process.wait(HANGS)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
                return 1, "it hangs"
        said.seek(0)
        return process.returncode, said.read()


def wrong_in(out: Path) -> Iterator[str]:
    """What is wrong with the files of a result."""
    for path in out.rglob("*"):
        if path.name.endswith((".part", ".lock")):
            yield f"{path.name} was left behind"
    try:
        summary = json.loads((out / "summary.json").read_text())
    except (OSError, ValueError) as error:
        yield f"no summary ({type(error).__name__})"
        return
    yield from faults(summary, json.loads(SCHEMA.read_text()))
    for name in ("trajectory.tum", "keyframes.tum"):
        rows = np.loadtxt(out / name, ndmin=2)
        if not np.isfinite(rows).all():
            yield f"NaN in {name}"
    if summary["not_started"] is not None or not summary["disks"]:
        return
    try:
        result = load_result(out)  # refuses a map that is not finite
    except GeogsError as error:
        yield str(error)
        return
    if not np.isfinite(result.views.T_cw).all():
        yield "NaN in the poses of map.safetensors"
    mesh = result.mesh
    if mesh is not None and not (
        np.isfinite(mesh.vertices).all() and np.isfinite(mesh.normals).all()
    ):
        yield "NaN in mesh.ply"


def repetitions(video: Path, folder: Path, repeats: int) -> list[str]:
    """The same run again and again in this process: growth of memory and of open files."""
    memory, files, frames = [], [], 0
    for _ in range(repeats):
        out = folder / "again"
        settings = RunSettings((video,), preset("fast"), output=out, device="cpu")
        frames = run(settings).result.scene.frames
        gc.collect()
        memory.append(resident())
        files.append(len(os.listdir("/proc/self/fd")))
    runs = np.arange(WARM_UP, repeats)
    leak = float(np.polyfit(runs, memory[WARM_UP:], 1)[0]) / frames
    grown = files[-1] - files[WARM_UP]
    print(f"{repeats} x {frames} frames: {leak:.0f} bytes a frame, {grown:+d} open files")
    print("  resident MiB: " + " ".join(f"{m / 2**20:.1f}" for m in memory))
    wrong = [f"{leak:.0f} bytes a frame are lost"] if leak > MOST_LEAKED else []
    return wrong + ([f"{grown} files stay open"] if grown > 0 else [])


def resident() -> int:
    """Bytes of this process in memory."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


if __name__ == "__main__":
    main()
