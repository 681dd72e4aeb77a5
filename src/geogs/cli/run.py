"""``geogs run SOURCE``: a video in; trajectory, mesh and disk map out."""

import os
import select
import sys
import termios
import threading
import tty
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, cast

from geogs.application.result_settings import HERE
from geogs.application.run_settings import LiveSettings, RunSettings, Verbosity
from geogs.cli.answer import Answer
from geogs.cli.config_options import ConfigOptions, printed, with_settings_file
from geogs.cli.options import Given, parse_options, record
from geogs.cli.terminal.speech import dry_answer, followed, say_loading
from geogs.config import Preset, preset
from geogs.errors import InputError
from geogs.gpu.early_start import is_gpu, start_gpu
from geogs.guard.terminal_text import say
from geogs.io.sources.address import live_address

if TYPE_CHECKING:
    from geogs.application.machine.compilation import Compilation
    from geogs.application.viewer.observer import RunObserver


@dataclass(frozen=True)
class RunOptions(LiveSettings, Verbosity, ConfigOptions, RunSettings):
    """Reconstruct a video, images, a bag of ROS, or a sequence of a data set as it lies on disk.

    Every default works: ``geogs run video.mp4``. Intrinsics: ``--intrinsics fx,fy,cx,cy``.
    Several videos of one place: ``geogs run a.mp4 b.mp4``. A camera: ``geogs run camera:0``, until
    q or Ctrl-C is pressed.
    """

    preset: Preset = "default"
    """Group of settings: those of --config and single ones win."""
    resume: Path | None = None
    """Go on with the run that stopped in this folder: with its source and its settings; beside it
    may be given what decides nothing about poses and map: --device, --mesh, --checkpoint-every,
    --fallback, --online-results, --depth-mesh, --keyframe-images and --scale-from."""
    strict: bool = True
    """End with exit code 3 if the result is not reliable."""
    dry_run: bool = False
    """Only say what the input holds and would be done."""


def main(argv: Sequence[str], kernels: "Compilation | None" = None) -> Answer | int:
    """Run the command; ``kernels`` is a running compilation. Returns its answer."""
    options = parse(argv)
    if options.print_config:
        return printed(options.config)
    is_live = any(live_address(source) is not None for source in options.source)
    if options.sfm and is_live:
        raise InputError("--sfm reads a video several times; a live source cannot be.")
    if options.sfm and options.map is not None:
        raise InputError("--map needs tracking; leave out --sfm.")

    if options.dry_run:
        return _dry_run(options)
    say_loading(options)
    start_gpu(options.device)
    from geogs.application.interrupt import Interruption
    from geogs.application.run import resume, run

    settings, stop = record(RunSettings, options), Interruption()
    if options.sfm and options.resume is None and (options.viewer or options.record):
        raise InputError("--viewer and --record show tracking; leave them out with --sfm.")
    go = partial(run, kernels=kernels)
    if options.resume is not None:
        go = partial(resume, options.resume)
    observer = _observer(options)
    has_keys = is_live and not any(str(source) == "-" for source in options.source)
    with quit_key(stop.request) if has_keys else nullcontext():
        return followed(
            options,
            lambda progress: go(settings, progress, stop, observer),
            stop,
            "geogs run --resume {folder} continues from here.",
            options.strict,
        )


def _dry_run(options: RunOptions) -> Answer:
    """Open the input; return its account and the plan."""
    from geogs.application.calibrate import without_overlay
    from geogs.application.plan import plan_for, run_stages
    from geogs.application.progress.terminal_progress import TerminalProgress
    from geogs.application.results.output_folder import chosen_folder
    from geogs.application.run import maps_at_the_end
    from geogs.io.sources.sniff import open_source

    opened = open_source(options.source, options.config.input)
    opened = without_overlay(opened, TerminalProgress(options))
    settings = record(RunSettings, options)
    stages = run_stages(settings, opened, maps_at_the_end(settings, None))
    frames = None if opened.is_live else opened.length
    output = chosen_folder(
        options.output, opened.stem, options.overwrite, fingerprint=opened.fingerprint
    )
    device = "cuda" if is_gpu(options.device) else "cpu"
    return dry_answer(opened, plan_for(stages, output, frames, opened.camera, device))


def _observer(options: LiveSettings) -> "RunObserver | None":
    """Viewer and recorder, if requested."""
    from geogs.application.viewer.observer import Observers

    several: list[RunObserver] = []
    if options.record is not None:
        from geogs.application.viewer.recording import Recorder

        several.append(Recorder(options.record))
    if options.viewer:
        from geogs.application.viewer.browser_window import Window
        from geogs.application.viewer.live_viewer import LiveViewer

        window = Window("geogs", HERE, options.viewer_port, with_disks=True)
        say(f"Open {window.address} in a browser to look on.", is_error=True)
        several.append(LiveViewer(window))
    return Observers(several) if several else None


def parse(argv: Sequence[str]) -> RunOptions:
    """Parse options; defaults are those of a preset, or of the run to resume.

    Raises:
        SystemExit: after ``--help``.
        InputError: an option is wrong or missing; there is nothing to resume, or a preset is given
            with ``--resume``.
    """
    return parse_options(RunOptions, argv, "run", _defaults)


def _defaults(given: Given) -> RunOptions:
    """Options of the given preset, or of the run to resume."""
    if "resume" not in given:
        name = cast(Preset, given.get("preset", "default"))
        is_live = live_address(Path(given.get("source", ""))) is not None
        on_gpu = name == "default" and not is_live and is_gpu(given.get("device", "auto"))
        return RunOptions(config=with_settings_file(preset(name, on_gpu), given), preset=name)

    from geogs.application.checkpoints.run_state import SavedRun

    folder = Path(given["resume"])
    for option, key in (("--preset", "preset"), ("--config", "config-file")):
        if key in given:
            raise InputError(f"--resume goes on with the run's settings; leave out {option}.")
    return RunOptions(**vars(SavedRun(folder).settings), resume=folder)


@contextmanager
def quit_key(stop: Callable[[], None]) -> Iterator[bool]:
    """Call ``stop`` when q is pressed in the block; yields whether keys can be read.

    They cannot if standard input is no terminal. Its mode is restored afterwards.
    """
    try:
        keys = sys.stdin.fileno()
        before = termios.tcgetattr(keys)
    except (AttributeError, OSError, ValueError, termios.error):
        yield False
        return
    ended = threading.Event()

    def listen() -> None:
        while not ended.is_set():
            if select.select([keys], [], [], 0.2)[0] and os.read(keys, 1) in (b"q", b"Q"):
                stop()
                return

    thread = threading.Thread(target=listen, name="keys", daemon=True)
    tty.setcbreak(keys)
    thread.start()
    try:
        yield True
    finally:
        ended.set()
        thread.join()
        termios.tcsetattr(keys, termios.TCSADRAIN, before)
