"""Endurance test: random synthetic videos with random settings, killed and resumed, for hours.

    python benchmarks/soak.py [--minutes 180] [--workers 1] [--seed 0] [--size 160 120]
        [--frames 30 90] [--repeats 8] [--folder FOLDER] [--report FILE.json]

Every round renders a video and runs it twice, in separate processes: once undisturbed, and once
killed now and then (SIGKILL, SIGTERM, Ctrl-C, at any moment), on another number of threads each
time, and resumed by ``--resume``. Both must write the same poses, map and mesh to the last bit.
Checked are exit codes, tracebacks, NaN in any file, summaries by docs/summary.schema.json,
incomplete files. Each worker runs one round at a time; no GPU is used. Meanwhile ``leaks.py`` runs
one video repeatedly in one process. The report has the numbers of all events and all faults; the
command ends with 1 if there is a fault. Folders of rounds without faults are deleted.
"""

import argparse
import json
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from soak_checks import differences, wrong_in
from soak_process import GEOGS, Ending, TimeIsUp, ended

CHOICES: dict[str, tuple[str, ...]] = {
    "--stride": ("1", "2"),
    "--seed": ("0", "7"),
    "--preset": ("fast", "default"),
    "--mapping.window": ("3", "8"),
    "--mapping.iterations": ("2", "10"),
    "--mapping.render-long-edge": ("64", "128"),
    "--resident-keyframes": ("3", "100"),
    "--input.readout": ("0", "0.02", "auto"),
    "--mesh.detail": ("0.2", "1"),
    "--checkpoint-every": ("1", "5"),
    "--intrinsics": ("auto", "150,150,79.5,59.5"),
}
SWITCHES = ("--online-results", "--depth-mesh", "--no-keyframe-images")
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
MOST_KILLS = 4
"""Most kills of a run."""
STARTED = 2.0
"""Seconds after which Python has started the program, which then handles signals."""


@dataclass
class Report:
    """Events of all rounds."""

    seed: int
    workers: int
    rounds: int = 0
    cut_off: int = 0
    """Number of unfinished rounds when the time was over."""
    runs: int = 0
    """Number of processes."""
    kills: Counter[str] = field(default_factory=Counter)
    """Number by signal."""
    resumes: int = 0
    compared: int = 0
    """Number of disturbed runs that were compared with their undisturbed twin."""
    refusals: Counter[str] = field(default_factory=Counter)
    """Messages of undisturbed runs that ended with 2, such as for a camera that does not move."""
    faults: list[dict[str, str]] = field(default_factory=list)
    leaks: dict[str, object] = field(default_factory=dict)
    """Results of leaks.py."""
    seconds: float = 0.0


class Soak:
    """Rounds of several workers until the time is over."""

    def __init__(self, options: argparse.Namespace, folder: Path) -> None:
        self._options, self._folder = options, folder
        self._end = time.monotonic() + 60 * options.minutes
        self._lock = threading.Lock()
        self._begun = 0
        self.report = Report(options.seed, options.workers)

    def work(self) -> None:
        """Run round after round."""
        while time.monotonic() < self._end:
            with self._lock:
                number, self._begun = self._begun, self._begun + 1
            folder = self._folder / f"round-{number}"
            try:
                found = self._round(folder, random.Random(f"{self._options.seed}-{number}"))
            except TimeIsUp:
                with self._lock:
                    self.report.cut_off += 1
                shutil.rmtree(folder, ignore_errors=True)
                return
            except Exception as error:  # a fault of the soak must not look like success
                found = [f"the soak broke off: {error!r}"]
            with self._lock:
                self.report.rounds += 1
                self.report.faults += [{"round": folder.name, "what": what} for what in found]
            print(f"{folder.name}: {'; '.join(found) or 'well'}", flush=True)
            if not found:
                shutil.rmtree(folder, ignore_errors=True)

    def _round(self, folder: Path, dice: random.Random) -> list[str]:
        """Render, run undisturbed and disturbed, check; return the faults."""
        video, twin, out = (folder / name for name in ("video", "twin", "out"))
        folder.mkdir(parents=True)
        synth = self._ended([*GEOGS, *synth_words(video, self._options, dice)])
        if synth.code:
            return [f"geogs synth ends with {synth.code}: {synth.last}"]
        words = settings(dice)
        (folder / "settings.txt").write_text(" ".join(words) + "\n")
        usual = ("--device", "cpu", "--overwrite", "--no-strict")
        command = [*GEOGS, "run", str(video), *usual, *words]
        whole = self._ended([*command, "-o", str(twin)])
        wrong = [f"undisturbed: {what}" for what in whole.wrong((0, 2))]
        last, more = self._disturbed([*command, "-o", str(out)], out, whole.seconds, dice)
        wrong += more
        if whole.code == 2:
            with self._lock:
                self.report.refusals[whole.last] += 1
            return wrong + ([] if last.code == 2 else ["only the undisturbed run was refused"])
        if wrong:
            return wrong
        with self._lock:
            self.report.compared += 1
        return [*wrong_in(twin), *wrong_in(out), *differences(twin, out)]

    def _disturbed(
        self, first: list[str], out: Path, seconds: float, dice: random.Random
    ) -> tuple[Ending, list[str]]:
        """Run with interruptions until the end; return the last ending and the faults."""
        kills, wrong, command = dice.randint(1, MOST_KILLS), list[str](), first
        while True:
            number = dice.choice(SIGNALS) if kills else None
            kills -= number is not None
            after = max(dice.uniform(0.0, 1.0) * seconds, STARTED)
            ending = self._ended(command, number, after, dice.choice(("1", "2", "3")))
            # A signal during Python's shutdown, or during an exec, ends Python itself.
            wrong += ending.wrong((0, 2, 128 + number, -number) if number else (0, 2))
            is_open = (out / "checkpoint" / "manifest.json").is_file()
            if wrong or ((number is None or not ending.was_hit) and not is_open):
                return ending, wrong
            command = first
            if is_open:
                command = [*GEOGS, "run", "--resume", str(out), "--device", "cpu"]
                command.append("--no-strict")
                with self._lock:
                    self.report.resumes += 1

    def _ended(
        self,
        command: list[str],
        number: signal.Signals | None = None,
        after: float = 0.0,
        threads: str = "1",
    ) -> Ending:
        ending = ended(command, self._end, number, after, threads)
        with self._lock:
            self.report.runs += 1
            if number is not None and ending.was_hit:
                self.report.kills[number.name] += 1
        return ending


def main() -> None:
    """Run workers and leaks concurrently, then write the report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=180.0)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--size", type=int, nargs=2, default=(160, 120))
    parser.add_argument("--frames", type=int, nargs=2, default=(30, 90))
    parser.add_argument("--repeats", type=int, default=8)
    parser.add_argument("--folder", type=Path, default=None)
    parser.add_argument("--report", type=Path, default=None)
    options = parser.parse_args()
    folder = options.folder or Path(tempfile.mkdtemp(prefix="geogs-soak-"))
    folder.mkdir(parents=True, exist_ok=True)
    begin = time.monotonic()
    soak = Soak(options, folder)
    threads = [threading.Thread(target=soak.work) for _ in range(options.workers)]
    for thread in threads:
        thread.start()
    report = soak.report
    if options.repeats:
        report.leaks, said = leaks(folder / "leaks", options, begin + 60 * options.minutes)
        report.faults += [{"round": "leaks", "what": what} for what in said]
    for thread in threads:
        thread.join()
    report.seconds = round(time.monotonic() - begin, 1)
    text = json.dumps(vars(report), indent=2)
    if options.report is not None:
        options.report.write_text(text + "\n")
    print(text)
    sys.exit(1 if report.faults else 0)


def synth_words(video: Path, options: argparse.Namespace, dice: random.Random) -> list[str]:
    """Arguments of ``geogs synth`` for a random video."""
    width, height = options.size
    return [
        "synth", str(video), "--frames", str(dice.randint(*options.frames)), "--width", str(width),
        "--height", str(height), "--seed", str(dice.randint(0, 999)), "--no-depth", "--camera",
        dice.choice(("clean", "phone")),
    ]  # fmt: skip


def settings(dice: random.Random) -> list[str]:
    """Random options with random values."""
    names = dice.sample(sorted(CHOICES), dice.randint(0, len(CHOICES)))
    words = [word for name in names for word in (name, dice.choice(CHOICES[name]))]
    return words + dice.sample(SWITCHES, dice.randint(0, len(SWITCHES)))


def leaks(
    folder: Path, options: argparse.Namespace, end: float
) -> tuple[dict[str, object], list[str]]:
    """Run leaks.py for the available time; return its results and the faults."""
    folder.mkdir(parents=True, exist_ok=True)
    video = folder / "video"
    dice = random.Random(f"{options.seed}-leaks")
    try:
        if ended([*GEOGS, *synth_words(video, options, dice)], end).code:
            return {}, ["geogs synth fails"]
    except TimeIsUp:
        return {}, []
    script = Path(__file__).with_name("leaks.py")
    minutes = max(end - time.monotonic(), 1.0) / 60
    command = [
        sys.executable, str(script), str(video), "--repeats", str(options.repeats), "--minutes",
        f"{minutes:.2f}", "--folder", str(folder),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    try:
        found = json.loads(done.stdout.splitlines()[-1])
    except (ValueError, IndexError):
        return {}, [f"leaks.py ends with {done.returncode}: {done.stderr[-300:]}"]
    return found, ["memory or files are lost"] if done.returncode else []


if __name__ == "__main__":
    main()
