"""``geogs run SOURCE``: a video in; trajectory, mesh and disk map out."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, get_args

import tyro

from geogs.application.calibrate import self_calibrated
from geogs.application.interrupt import Interruption
from geogs.application.priors import open_prior
from geogs.application.progress import RunProgress
from geogs.application.settings import RunSettings
from geogs.cli.options import SHORT, given, parse_options
from geogs.config import Config, Preset, preset

if TYPE_CHECKING:
    from geogs.application.run_checkpoint import RunCheckpoint, RunFacts
    from geogs.io.sources.base import ReadingPlace
    from geogs.io.sources.several import JointPlace
    from geogs.io.sources.sniff import Stream
    from geogs.slam import Slam


@dataclass(frozen=True)
class RunOptions(RunSettings):
    """Reconstruct a video, a folder of images, or a Replica, TUM RGB-D or 7-Scenes sequence.

    Every default works: ``geogs run video.mp4``. Intrinsics: ``--intrinsics fx,fy,cx,cy``.
    Several videos of one place: ``geogs run a.mp4 b.mp4``.
    """

    source: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    config: Annotated[Config, tyro.conf.arg(name="")] = field(default_factory=Config)
    preset: Preset = "default"
    """Group of settings; single ones given beside it win."""
    resume: Path | None = None
    """Go on with the run that was interrupted or killed in this folder, with its source and its
    settings; only --device and --checkpoint-every may be given beside it."""

    def settings(self) -> RunSettings:
        """The record of the run."""
        return RunSettings(**{f.name: getattr(self, f.name) for f in fields(RunSettings)})


def main(argv: Sequence[str]) -> int:
    """Run the command; returns the exit code."""
    options = parse(argv)
    run(options)
    return 0


def run(options: RunOptions) -> Path:
    """Reconstruct, write the results, say where they are; returns their folder."""
    import torch

    import geogs
    from geogs.application.checkpoint import has_checkpoint
    from geogs.application.gpu_memory import REMEDY, full_memory_in_a_sentence
    from geogs.application.results import SourceFacts, write_results
    from geogs.application.run_checkpoint import RunCheckpoint, RunFacts, SavedRun
    from geogs.application.surfaces import write_depth_mesh, write_online_results
    from geogs.errors import DeviceError
    from geogs.gpu.installation import require_device
    from geogs.gpu.kernels import prepare_kernels
    from geogs.io.sources.sniff import open_sources
    from geogs.io.writers.atomic import prepare_output_folder
    from geogs.slam import Slam

    torch.set_num_threads(1)  # the kernels have threads of their own; see geogs.threads
    saved = None if options.resume is None else SavedRun(options.resume)
    if saved is not None:
        options = _resumed(options, saved.facts)
    device = require_device(options.device)
    config = options.config
    opened = open_sources(options.source, config.input)
    output = prepare_output_folder(options.output or Path("out") / opened.name)
    if device.type == "cuda":
        prepare_kernels(Path(geogs.__file__).parent, device)
    calibrate = partial(self_calibrated, options=config, device=device)
    source = (calibrate if saved is None else saved.calibrated)(opened)
    found = None if source is opened else source.calibration
    prior = open_prior(config.prior, source.camera, device)
    slam = Slam(source.camera, config, str(device), prior)
    if saved is not None:
        saved.restore(slam)
    progress = RunProgress(source.length, begun=slam.frames)
    facts = RunFacts(options.settings().absolute(), device.type, source.fingerprint(), found)
    checkpoint = RunCheckpoint(output, facts, options.checkpoint_every, progress)
    with full_memory_in_a_sentence(), Interruption() as stop, progress:
        if saved is not None:
            progress.write(f"Going on after {slam.frames} frames.")
        elif has_checkpoint(output):
            progress.write(
                f"Starting anew; geogs run --resume {output} would go on with the unfinished run "
                "there, until the first checkpoint of this one."
            )
        place = None if saved is None else saved.facts.place
        full = not _feed(slam, source, place, checkpoint, progress, stop)
        interrupted = full or stop.requested
        if interrupted:
            why = "The GPU has no memory left" if full else "Stopping early"
            progress.write(f"{why}; keeping what there is. Press Ctrl-C again to quit.")
            kept = not full and checkpoint.write(slam, source)
        slam.end_stream()
        if not interrupted:
            kept = checkpoint.write(slam, source)
        if options.online_results:
            write_online_results(output, slam, config.mesh, progress)
        interrupted |= not _finish(slam, progress, stop, correct=not interrupted)
        more = [lambda: write_depth_mesh(output, slam, config.mesh, progress)]
        write_results(
            output, slam, SourceFacts.of(source), config, interrupted, progress,
            more if options.depth_mesh else (),
        )  # fmt: skip
    if full:
        raise DeviceError(
            f"The memory of the GPU was full after {slam.frames} frames, whose results are in "
            f"{output}/; {REMEDY}."
        )
    if not interrupted:
        checkpoint.remove()
    elif kept:
        print(f"geogs run --resume {output} goes on from here.")
    print(f"Results are in {output}/")
    return output


def _resumed(options: RunOptions, facts: "RunFacts") -> RunOptions:
    """The options that the run began with. Raises InputError if others are asked for."""
    from geogs.errors import InputError

    given = replace(options, resume=None, device="auto", checkpoint_every=60.0)
    if given != replace(_defaults("default"), source=()):
        raise InputError(
            "--resume goes on with the source and the settings of the run; leave out everything "
            "else but --device and --checkpoint-every."
        )
    began = facts.settings
    device = began.device
    if options.device != "auto":
        device = options.device
    elif not device.startswith(facts.device):  # what auto was found to be
        device = facts.device
    if not device.startswith(facts.device):
        raise InputError(f"The run was on {facts.device}, and can only go on there.")
    return replace(
        options, source=began.source, config=began.config, output=options.resume, device=device,
        online_results=began.online_results, depth_mesh=began.depth_mesh,
    )  # fmt: skip


def _feed(
    slam: "Slam",
    source: "Stream",
    place: "ReadingPlace | JointPlace | None",
    checkpoint: "RunCheckpoint",
    progress: RunProgress,
    stop: Interruption,
) -> bool:
    """All frames after a place through the system, until a request to stop; false if the GPU's
    memory is full."""
    import torch

    from geogs.application.run_checkpoint import frames_after

    frames = iter(source) if place is None else frames_after(source, place)
    if slam.is_ended:
        next(frames, None)  # only what the source says of itself at its end
        return True
    try:
        for frame in frames:
            status = slam.process(frame)
            progress.frame(status)
            if stop.requested:
                break
            checkpoint.after_frame(slam, source)
    except torch.cuda.OutOfMemoryError:
        torch.cuda.empty_cache()
        return False
    return True


def _finish(slam: "Slam", progress: RunProgress, stop: Interruption, correct: bool) -> bool:
    """The final stages; false if a request to stop or a full GPU cut them short."""
    import torch

    def report(stage: str, fraction: float) -> None:
        progress.stage(stage, fraction)
        stop.check()

    try:
        slam.finish(report, correct)
    except KeyboardInterrupt:
        return False
    except torch.cuda.OutOfMemoryError:
        torch.cuda.empty_cache()
        progress.write("The GPU has no memory left for the final stages; keeping what there is.")
        return False
    return True


def parse(argv: Sequence[str]) -> RunOptions:
    """Options with the preset as defaults, over which single settings win."""
    default = _defaults(_preset_name(argv))
    if given(argv, "resume") is not None:
        default = replace(default, source=())
    short = {
        **SHORT,
        "--intrinsics": "--input.intrinsics",
        "--global-ba-every": "--loop.global-ba-every",
    }
    return parse_options(RunOptions, argv, "run", default=default, short=short)


def _defaults(name: Preset) -> RunOptions:
    return RunOptions(source=tyro.MISSING, config=preset(name), preset=name)


def _preset_name(arguments: Sequence[str]) -> Preset:
    """The preset asked for; a wrong one is left for the option parser to complain about."""
    asked = given(arguments, "preset")
    return next((name for name in get_args(Preset) if name == asked), "default")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
