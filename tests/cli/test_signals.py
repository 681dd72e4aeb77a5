"""Ctrl-C and SIGTERM while a command starts: one sentence and the signal's exit code, always."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from io_samples import write_images

AT_IMPORT = """
import os, sys
from geogs.cli.main import main

number, count = int(sys.argv[1]), int(sys.argv[2])
left = [count]

def watch(event, arguments):
    left[0] -= event == "import"
    if event == "import" and not left[0]:
        os.kill(os.getpid(), number)

sys.argv[1:] = sys.argv[3:]
sys.addaudithook(watch)
sys.exit(main())
"""
"""The command, which signals itself at an import: no clock decides where."""
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}


def command(folder: Path) -> list[str]:
    """A run of a few images, which are read by several threads at once.

    Without pycolmap, which takes SIGTERM for itself for a few hundredths of a second of its import.
    """
    write_images(folder / "images", [f"{i}.png" for i in range(12)], 320, 240)
    options = ["-o", str(folder / "out"), "--intrinsics", "300,300,160,120", "--no-fallback"]
    return ["run", str(folder / "images"), *options]


def end_at_import(count: int, number: int, arguments: list[str]) -> tuple[int, str]:
    """The exit code, and the last line on the standard error; there is no traceback above it."""
    done = subprocess.run(
        [sys.executable, "-c", AT_IMPORT, str(int(number)), str(count), *arguments],
        env=ENVIRONMENT, timeout=1800, capture_output=True, text=True,
    )  # fmt: skip
    assert "Traceback" not in done.stderr, done.stderr
    return done.returncode, done.stderr.splitlines()[-1]


@pytest.mark.parametrize(
    ("count", "number"), [(1, signal.SIGTERM), (150, signal.SIGINT), (900, signal.SIGINT)]
)
def test_a_signal_in_an_import_waits_for_its_end(tmp_path, count, number):
    code = 128 + number
    assert end_at_import(count, number, command(tmp_path)) == (code, "error: interrupted.")


def test_two_signals_in_an_import_leave_no_empty_folder(tmp_path):
    """The second one ended the process at once, before the folder was taken away again."""
    presses = (
        "import os, time\nfor _ in range(3):\n    os.kill(os.getpid(), 2)\n    time.sleep(0.01)\n"
    )
    (tmp_path / "pressed.py").write_text(presses)
    code = (
        "import signal; from geogs.application.interrupt import interrupt; "
        "from geogs.application.results.output_folder import claimed; from pathlib import Path\n"
        "signal.signal(signal.SIGINT, interrupt)\n"
        "with claimed(Path('out')):\n    import pressed\n    signal.pause()\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], env=ENVIRONMENT, cwd=tmp_path, timeout=60,
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.stderr.splitlines()[-1] == "geogs.application.interrupt.Interrupted"
    assert not (tmp_path / "out").exists()


def test_a_signal_before_geogs_is_imported_ends_it_without_a_word():
    at_first = "event == 'import' and arguments[0] == 'geogs' and os.kill(os.getpid(), 2)"
    hook = f"sys.addaudithook(lambda event, arguments: {at_first} and None)"
    code = f"import os, sys; {hook}; import geogs_start; geogs_start.main()"
    done = subprocess.run([sys.executable, "-c", code], env=ENVIRONMENT, capture_output=True)
    assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGINT, b"", b"")


@pytest.mark.long
@pytest.mark.parametrize("seed", range(25))
def test_a_signal_at_any_import(tmp_path, seed):
    count = random.Random(seed).randrange(1, 1400)
    assert end_at_import(count, signal.SIGINT, command(tmp_path)) == (130, "error: interrupted.")


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_at_many_times_in_the_first_seconds(tmp_path, number):
    arguments = command(tmp_path)
    for k in range(40):
        code = "print(flush=True); import sys; from geogs.cli import main; sys.exit(main.main())"
        begun = subprocess.Popen(
            [sys.executable, "-c", f"import geogs.cli.main; {code}", *arguments],
            env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert begun.stdout is not None
        begun.stdout.readline()  # Python itself has started
        time.sleep(0.01 + 0.05 * k)
        begun.send_signal(number)
        said = begun.communicate(timeout=1800)[1]
        assert "Traceback" not in said, said
        assert "error: " in said
        # 2: images without texture, which were all read
        assert begun.returncode in (128 + number, 2)
