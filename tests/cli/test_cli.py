"""The command line: help at once, errors in a line, exit codes."""

import os
import subprocess
import sys
import types
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import pytest

from geogs import __version__
from geogs.cli import main as cli
from geogs.cli import reconstruct, run
from geogs.cli.command import COMMANDS, Command, all_commands
from geogs.cli.options import parse_options
from geogs.config import Config, InputConfig, preset_of, reconstruct_preset
from geogs.config.setting import Positional
from geogs.errors import InputError, OutputError, TrackingLost


@dataclass(frozen=True)
class Options:
    """Options of a made-up command."""

    source: Annotated[Path, Positional()]
    """What to read."""
    input: InputConfig = field(default_factory=InputConfig)
    fast: bool = False
    """Hurry."""


def geogs(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run the command in a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", "geogs.cli.main", *arguments],
        capture_output=True, text=True, check=False,
    )  # fmt: skip


@pytest.fixture
def command(monkeypatch):
    """Replace the body of ``geogs run``."""

    def install(body) -> None:
        module = types.ModuleType("geogs_test_command")
        module.main = body
        monkeypatch.setitem(sys.modules, module.__name__, module)
        monkeypatch.setitem(COMMANDS, "run", Command(module.__name__, "test"))

    return install


def test_help_lists_every_command():
    result = geogs("--help")
    assert result.returncode == 0
    assert result.stderr == ""
    for name, entry in all_commands().items():
        assert f"  {name} " in result.stdout
        assert entry.help in result.stdout


def test_packages_beside_register_their_commands():
    assert {"bench", "fleet", "synth", "train"} == {*all_commands()} - {*COMMANDS}


def test_help_imports_nothing_heavy():
    """Which is why it is there at once."""
    heavy = ("torch", "numpy", "cv2", "numba", "rich", "av", "matplotlib", "scipy", "yaml")
    code = (
        "import sys; from geogs.cli.main import main\n"
        f"for command in {[[], *([name] for name in all_commands())]}:\n"
        "    main([*command, '--help'])\n"
        f"    print('loaded', command, [m for m in {heavy} if m in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    loaded = [line for line in result.stdout.splitlines() if line.startswith("loaded")]
    assert len(loaded) == len(all_commands()) + 1
    assert [line for line in loaded if not line.endswith(" []")] == []


def test_a_run_imports_before_its_first_frame_only_what_that_needs():
    """What keyframes, maps, meshes and reports need comes with the first of them."""
    later = ("numba", "scipy", "skimage", "matplotlib", "PIL", "av", "onnxruntime", "yaml")
    code = (
        "import sys, geogs.slam, geogs.application.run; "
        "import geogs.application.progress.terminal_progress; "
        "from geogs.geometry.camera import Camera; "
        "geogs.slam.Slam(Camera(300.0, 300.0, 160.0, 120.0, 320, 240), device='cpu'); "
        f"print([m for m in {later} if m in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.stdout.splitlines()[-1] == "[]"


def test_version_and_no_arguments(capsys):
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"geogs {__version__}\n"
    assert cli.main([]) == 0
    assert "usage: geogs COMMAND" in capsys.readouterr().out


def test_unknown_command_suggests_a_near_one(capsys):
    assert cli.main(["sinth"]) == 2
    assert capsys.readouterr().err == "error: there is no command sinth; did you mean synth?\n"
    assert cli.main(["xyz"]) == 2
    assert "choose one of" in capsys.readouterr().err


@pytest.mark.parametrize("kind", [InputError, OutputError, TrackingLost])
def test_our_errors_are_one_sentence_and_exit_code_2(command, capsys, monkeypatch, kind):
    monkeypatch.delenv("GEOGS_DEBUG", raising=False)

    def fail(argv) -> int:
        raise kind("The video is broken; give another.")

    command(fail)
    assert cli.main(["run"]) == 2
    output = capsys.readouterr()
    assert output.out == ""
    assert output.err == "error: The video is broken; give another.\n"
    monkeypatch.setenv("GEOGS_DEBUG", "1")
    with pytest.raises(kind):
        cli.main(["run"])


def test_error_is_red_on_a_terminal_only(monkeypatch, capsys):
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    cli.print_error("x")
    assert capsys.readouterr().err == "\033[31merror: x\033[0m\n"


def test_interrupt_is_130_and_other_errors_keep_their_traceback(command):
    def interrupt(argv) -> int:
        raise KeyboardInterrupt

    def crash(argv) -> int:
        raise ZeroDivisionError

    command(interrupt)
    assert cli.main(["run"]) == 130
    command(crash)
    with pytest.raises(ZeroDivisionError):
        cli.main(["run"])


def test_arguments_and_exit_code_pass_through(command):
    seen = []

    def body(argv) -> int:
        seen.append(argv)
        return 3

    command(body)
    assert cli.main(["run", "video.mp4", "--fast"]) == 3
    assert seen == [["video.mp4", "--fast"]]


def test_options_are_parsed_into_the_dataclass():
    options = parse_options(Options, ["v.mp4", "--input.stride", "2", "--fast"], "run")
    assert options == Options(Path("v.mp4"), InputConfig(stride=2), fast=True)
    default = Options(Path("v.mp4"), InputConfig(long_edge=99))
    options = parse_options(Options, ["--input.start=3", "w.mp4"], "run", lambda given: default)
    assert options == Options(Path("w.mp4"), InputConfig(long_edge=99, start=3))


@pytest.mark.parametrize(
    ("argv", "code", "stream", "text"),
    [
        (["--help"], 0, "out", "Use every stride-th frame"),
        ([], 2, "err", "geogs run"),
        (["v.mp4", "--quick"], 2, "err", "--quick"),
        (["v.mp4", "--input.stride", "two"], 2, "err", "input.stride is 'two'"),
    ],
)
def test_help_and_wrong_options(command, capsys, argv, code, stream, text):
    def body(argv) -> int:
        parse_options(Options, argv, "run")
        return 1

    command(body)
    assert cli.main(["run", *argv]) == code
    output = capsys.readouterr()
    assert text in getattr(output, stream)
    assert "Traceback" not in output.err


def test_library_warnings_reach_the_user_in_a_line(command, capsys):
    import logging

    def body(argv) -> int:
        logging.getLogger("geogs.io.anything").warning("skipped %d frames.", 3)
        logging.getLogger("geogs.io.anything").info("not shown")
        return 0

    command(body)
    assert cli.main(["run"]) == 0
    assert capsys.readouterr().err == "warning: skipped 3 frames.\n"
    logging.getLogger("geogs").handlers.clear()
    logging.getLogger("geogs").propagate = True


def test_output_cut_off_by_its_reader_is_no_traceback():
    shell = f"{sys.executable} -m geogs.cli.main --help | head -n 1"
    result = subprocess.run(["sh", "-c", shell], capture_output=True, text=True, env=os.environ)
    assert "Traceback" not in result.stderr


def test_known_poses_take_the_preset_of_the_device_unless_one_is_given() -> None:
    def preset_of_command(*words: str) -> str:
        return reconstruct.parse(["scene", *words]).preset

    assert preset_of_command("--device", "cpu") == "default"
    assert preset_of_command("--device", "cuda:0") == "accurate"
    assert preset_of_command("--device", "cuda", "--preset", "fast") == "fast"
    small, large = (reconstruct_preset(name) for name in ("default", "accurate"))
    assert small.mapping.render_long_edge < large.mapping.render_long_edge == 800
    assert small.mapping.loss == large.mapping.loss != Config().mapping.loss


def test_a_run_takes_larger_images_on_a_gpu_unless_they_are_live_or_a_preset_is_given() -> None:
    def edges(*words: str) -> tuple[int, int, int]:
        config = run.parse(words).config
        return config.input.long_edge, config.mapping.render_long_edge, config.mapping.disk.stride

    assert edges("a.mp4", "--device", "cpu") == (512, 320, 3)
    assert edges("a.mp4", "--device", "cuda:0") == (640, 640, 6)
    assert edges("a.mp4", "--device", "cuda", "--long-edge", "400") == (400, 640, 6)
    assert edges("a.mp4", "--device", "cuda", "--preset", "fast") == (512, 192, 3)
    assert edges("camera:0", "--device", "cuda") == (512, 320, 3)
    assert preset_of(run.parse(["a.mp4", "--device", "cuda"]).config) == "default"


@pytest.mark.parametrize(("given", "expected"), [(None, "1"), ("3", "3")])
def test_the_blas_of_numpy_is_told_its_threads_before_numpy_is_imported(given, expected):
    code = (
        "import os, sys; sys.argv = ['geogs', '--version']\n"
        "from geogs.cli.main import main\n"
        "main(); print('numpy' in sys.modules, os.environ['OPENBLAS_NUM_THREADS'])"
    )
    environment = {k: v for k, v in os.environ.items() if k != "OPENBLAS_NUM_THREADS"}
    environment |= {} if given is None else {"OPENBLAS_NUM_THREADS": given}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines()[-1] == f"False {expected}"


def test_a_process_ends_at_once_where_pytorch_was_loaded():
    """What was registered for the end is done, what was printed arrives; nothing comes after."""
    script = (
        "import atexit, sys, torch; sys.argv = ['geogs', 'nothing-of-ours']\n"
        "atexit.register(print, 'registered')\n"
        "from geogs.cli.main import main\n"
        "main(); print('not reached')"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stdout.splitlines()[-1] == "registered"


def test_garbage_is_looked_for_again_after_the_imports():
    code = (
        "import gc; from geogs.cli.terminal import process; usual = gc.get_threshold()\n"
        "process.take_over(); kept = [[] for _ in range(480_000)]\n"
        "print(gc.get_threshold() == usual, gc.get_freeze_count())\n"
        "more = [[] for _ in range(40_000)]\n"
        "print(gc.get_threshold() == usual, gc.get_freeze_count() > 400_000, gc.isenabled())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["False 0", "True True True"]


def test_the_package_is_a_command():
    for arguments in (["--version"], ["weights", "nothing"]):
        shown = [
            subprocess.run([sys.executable, "-m", name, *arguments], capture_output=True, text=True)
            for name in ("geogs", "geogs.cli.main")
        ]
        first, second = ((done.returncode, done.stdout, done.stderr) for done in shown)
        assert first == second
