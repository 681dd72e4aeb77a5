"""What somebody meets in the first ten minutes, measured as they would meet it.

    python benchmarks/first_ten_minutes.py [layouts phone left budgets programs page readme]
        [--work FOLDER] [--photographs FOLDER ...] [--budgets 30 90 300] [--seeds 61]

All of it where nothing is named; ``budgets`` only where there are photographs. Every row is one of
the table: what was measured, what is asked at least, what is aimed at. ``geogs`` is run in
processes of its own, with all cores: nothing else should run meanwhile. Layouts and programs
are what the tests of them say.
"""

import argparse
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
GEOGS = "import sys; sys.argv[0] = 'geogs'; from geogs_start import main; sys.exit(main())"
FRAMES, SIZE = 150, ("--width", "512", "--height", "288")
LAYOUTS = ("tests/io/sources/test_layouts.py", "tests/io/sources/test_pose_priors.py")
PROGRAMS = ("tests/test_api_page.py", "tests/test_examples.py")
PAGE = ("tests/application/results/test_report_page.py", "tests/evaluation/test_page.py")
Row = tuple[str, str, str, str]
"""What was looked at, what came of it, what is asked at least, the aim."""


@dataclass(frozen=True)
class Ran:
    """A command that came to its end."""

    seconds: float
    said: str
    code: int


def geogs(*words: str | Path) -> Ran:
    """Run a command in a process of its own."""
    command = [sys.executable, "-c", GEOGS, *map(str, words)]
    paths = [str(ROOT / "src"), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    begin = time.perf_counter()
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    return Ran(time.perf_counter() - begin, done.stderr + done.stdout, done.returncode)


def tested(what: str, files: Sequence[str]) -> Row:
    """A row for what tests say."""
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *files]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    last = (done.stdout.strip().splitlines() or [done.stderr.strip()])[-1]
    return what, f"{'all' if done.returncode == 0 else 'NOT all'}: {last}", "all", "all"


def phone(work: Path, seeds: Sequence[int]) -> Iterator[Row]:
    """``--preset fast`` on clips of a phone, as a video whose lens nobody gave."""
    for seed in seeds:
        clip = work / f"phone-{seed}"
        if not (clip / "video.mp4").is_file():
            made = ("synth", clip, "--frames", str(FRAMES), *SIZE, "--seed", str(seed))
            geogs(*made, "--camera", "phone", "--video")
        ran = geogs("run", clip / "video.mp4", "--preset", "fast", "-o", work / f"fast-{seed}")
        if ran.code:
            yield f"phone, seed {seed}", f"ended with {ran.code}: {ran.said[-200:]}", "90 s", "45 s"
            continue
        verdict = json.loads((work / f"fast-{seed}" / "summary.json").read_text())["verdict"]
        placed = 100 * (1 - verdict["lost"] - verdict["orientation_only"])
        told = f"{ran.seconds:.0f} s; {placed:.0f} % of the frames"
        yield f"{FRAMES} phone frames, fast, seed {seed}", told, "90 s; 95 %", "45 s; 100 %"


def left(work: Path, seeds: Sequence[int]) -> Iterator[Row]:
    """The time that is shown as left of the same clips."""
    for seed in seeds:
        clip, script = work / f"phone-{seed}" / "video.mp4", ROOT / "benchmarks" / "time_left.py"
        for more in (["--preset", "fast"], []):
            words = ["run", str(clip), *more, "-o", str(work / "left")]
            command = [sys.executable, str(script), *words]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            found = re.search(r"\| (\d+) % \| (\d+) % \|", done.stdout)
            told = f"{found[1]} / {found[2]} %" if found else done.stderr[-200:]
            name = f"time left within 50 / 25 %, {' '.join(more) or 'default'}, seed {seed}"
            yield name, told, "90 / 60 %", "95 / 80 %"


def budgets(work: Path, photographs: Sequence[Path], seconds: Sequence[int]) -> Iterator[Row]:
    """``reconstruct --poses auto --budget``, poses included."""
    for folder in photographs:
        for budget in seconds:
            output = work / f"budget-{folder.name}-{budget}"
            words = ("reconstruct", folder, "--poses", "auto", "--budget", f"{budget}s")
            ran = geogs(*words, "-o", output)
            more = 100 * (ran.seconds / budget - 1)
            told = f"{ran.seconds:.0f} s ({more:+.0f} %)"
            if "The --budget will not do" in ran.said:
                told += ", said at once"
            yield f"{folder}, {budget} s", told, "15 %, or said at once", "5 %"


def page(work: Path) -> Iterator[Row]:
    """Pages of the results that there are, and what the tests see in browsers."""
    for report in sorted(work.glob("*/report/index.html")):
        told = f"{report.stat().st_size / 1e6:.1f} MB{first_picture(report)}"
        yield f"page of {report.parts[-3]}", told, "8 MB; 2 s; 0 errors", "5 MB; 1 s; 0 errors"
    yield tested("page in browsers: picture, errors", PAGE)


def first_picture(report: Path) -> str:
    """When the model is drawn, and how many errors there were, of a browser that is there."""
    program = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
    if program is None or importlib.util.find_spec("playwright") is None:
        return "; no browser to open it"
    from playwright.sync_api import sync_playwright

    errors: list[str] = []
    with sync_playwright() as found:
        browser = found.chromium.launch(executable_path=program, args=["--no-sandbox"])
        tab = browser.new_page()
        tab.on("pageerror", lambda error: errors.append(str(error)))
        begin = time.perf_counter()
        tab.goto(report.resolve().as_uri())
        tab.wait_for_selector("#model[data-state=drawn]", timeout=60_000)
        seconds = time.perf_counter() - begin
        browser.close()
    return f"; {seconds:.1f} s; {len(errors)} errors"


def rows(asked: argparse.Namespace, work: Path) -> Iterator[Row]:
    """The table, row by row."""
    wanted = asked.rows or ["layouts", "phone", "left", "budgets", "programs", "page", "readme"]
    if "layouts" in wanted:
        yield tested("layouts", LAYOUTS)
    if "phone" in wanted:
        yield from phone(work, asked.seeds)
    if "left" in wanted:
        yield from left(work, asked.seeds)
    if "budgets" in wanted:
        yield from budgets(work, asked.photographs, asked.budgets)
    if "programs" in wanted:
        yield tested("programs of docs/api.md and examples", PROGRAMS)
    if "page" in wanted:
        yield from page(work)
    if "readme" in wanted:
        words = len((ROOT / "README.md").read_text().split())
        yield "README", f"{words} words", "1,200", "900"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, add_help=True)
    parser.add_argument("rows", nargs="*")
    parser.add_argument("--work", type=Path)
    parser.add_argument("--photographs", type=Path, nargs="*", default=[])
    parser.add_argument("--budgets", type=int, nargs="*", default=[30, 90, 300])
    parser.add_argument("--seeds", type=int, nargs="*", default=[61])
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as kept:
        print("| what | found | at least | aim |\n|---|---|---|---|", flush=True)
        for row in rows(asked, asked.work or Path(kept)):
            print(f"| {' | '.join(row)} |", flush=True)


if __name__ == "__main__":
    main()
