"""``geogs reconstruct SOURCE``: images with known poses in; mesh and disk map out."""

import re
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, get_args

import tyro

from geogs.application.interrupt import Interruption
from geogs.application.progress import RunProgress
from geogs.cli.options import SHORT, given, parse_options
from geogs.config import Preset, ReconstructConfig, reconstruct_preset
from geogs.errors import InputError

if TYPE_CHECKING:
    from geogs.application.reconstruct_checkpoint import ReconstructCheckpoint
    from geogs.application.snapshots import Snapshots
    from geogs.io.sources.posed.base import PosedSource
    from geogs.reconstruction import Reconstruction, ReconstructionState

_SECONDS = {"": 1.0, "s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0}
# What is left of a budget at least, when reading and checking have used it up.
_LEAST_SECONDS = 1.0


@dataclass(frozen=True)
class ReconstructOptions(ReconstructConfig):
    """Reconstruct images whose poses are known: a COLMAP model, nerfstudio, DTU, Replica, TUM...

    Lengths of the result are in the unit of the poses. Every default works.
    """

    source: Annotated[Path, tyro.conf.Positional] = Path()
    """Folder of images with poses, or the file with the poses."""
    output: Path | None = None
    """Folder for the results (also -o); out/NAME if none is given."""
    preset: Preset = "default"
    """Group of settings; single ones given beside it win. Without it, accurate on a GPU and default
    on a CPU."""
    budget: str | None = None
    """About how long it may take in all, such as 90s, 10m or 1h; none trains until it is good."""
    check_poses: bool = True
    """Whether to see by matching images that the poses follow the expected convention."""
    hold_out: int | None = None
    """Leave out every so many-th image, to judge the result by; at least 2, none uses all."""
    snapshots: str = ""
    """Also keep the map as it stands after some seconds, such as 5,10,20, in snapshots/; they count
    from when the images have been read."""
    depth_mesh: bool = False
    """Also fuse the searched depths without the disks, to depth_fusion/mesh.ply."""
    resume: bool = False
    """Go on from the checkpoint that an earlier call left in the output folder."""
    checkpoint_every: float = 30.0
    """Seconds of training between two checkpoints (there is one after the depths, too); 0 makes
    none."""
    device: str = "auto"
    """Where to compute: auto (a GPU where there is one), cpu, cuda or cuda:1; see geogs doctor."""


def main(argv: Sequence[str]) -> int:
    """Run the command; returns the exit code."""
    reconstruct(parse(argv))
    return 0


def reconstruct(options: ReconstructOptions) -> Path:
    """Reconstruct, write the results, say where they are; returns their folder."""
    begin = time.perf_counter()
    budget = None if options.budget is None else seconds(options.budget)
    due = [seconds(text, "time") for text in options.snapshots.split(",") if text.strip()]

    import torch

    import geogs
    from geogs.application.gpu_memory import full_memory_in_a_sentence
    from geogs.application.reconstruct_checkpoint import ReconstructCheckpoint, fingerprint
    from geogs.application.snapshots import Snapshots
    from geogs.gpu.installation import require_device
    from geogs.gpu.kernels import prepare_kernels
    from geogs.io.sources.posed.check import check_poses
    from geogs.io.sources.posed.sniff import open_posed_source
    from geogs.io.writers.atomic import prepare_output_folder
    from geogs.reconstruction import Reconstruction

    torch.set_num_threads(1)  # the kernels have threads of their own; see geogs.threads
    device = require_device(options.device)
    source = open_posed_source(options.source, options.input, options.hold_out)
    output = prepare_output_folder(options.output or Path("out") / source.name)
    if device.type == "cuda":
        before = time.perf_counter()
        prepare_kernels(Path(geogs.__file__).parent, device)
        begin += time.perf_counter() - before  # compiling, once per machine, is in no budget
    progress = RunProgress(source.length, tracks=False)
    names = [Path(source.label(i)).name for i in range(len(source))]
    made_from = fingerprint(options, options.hold_out, names)
    checkpoint = ReconstructCheckpoint(output, made_from, options.checkpoint_every, progress)
    with full_memory_in_a_sentence(), Interruption() as stop, progress:
        resumed = checkpoint.read() if options.resume else None
        if options.check_poses and resumed is None:
            warning = check_poses(source).warning
            progress.write(f"warning: {warning}" if warning else "")
        if budget is not None:
            budget = max(budget - (time.perf_counter() - begin), _LEAST_SECONDS)
        scene = Reconstruction(source.camera, options, str(device), budget)
        attendance = _Attendance(scene, progress, Snapshots(due), checkpoint, stop)
        finished = _reconstruct(scene, source, resumed, attendance)
        _write(output, scene, source, options, attendance, not finished)
    if finished:
        checkpoint.remove()
    print(f"Results are in {output}/")
    return output


@dataclass(frozen=True)
class _Attendance:
    """Everything that happens at a report of progress."""

    scene: "Reconstruction"
    progress: RunProgress
    snapshots: "Snapshots"
    checkpoint: "ReconstructCheckpoint"
    stop: Interruption

    def report(self, stage: str, fraction: float) -> None:
        """Show it, keep what is due, and stop if that was asked for."""
        self.progress.stage(stage, fraction)
        scene = self.scene
        if stage == "growing" and scene.with_depth < scene.frames:
            self.progress.write(
                f"There is time for the depths of {scene.with_depth} of {scene.frames} images; the "
                "others only help to find them. A longer --budget or a smaller "
                "--mapping.render-long-edge takes them all."
            )
        self.snapshots.take(scene)
        self.checkpoint.report(stage, scene)
        self.stop.check()


def _reconstruct(
    scene: "Reconstruction",
    source: "PosedSource",
    resumed: "ReconstructionState | None",
    attendance: _Attendance,
) -> bool:
    """Everything up to the trained map; false if a request to stop cut it short."""
    try:
        for image in source:
            scene.add(image.image, image.T_cw, image.mask, image.timestamp)
            attendance.report("reading", scene.frames / source.length)
        if resumed is not None:
            scene.resume(resumed, attendance.report)
        else:
            points = None if source.points is None else source.points.positions
            scene.finish(points, attendance.report)
    except KeyboardInterrupt:
        if not len(scene.snapshot()):
            raise
        keeping = "Stopping early; keeping what there is. Press Ctrl-C again to quit."
        attendance.progress.write(keeping)
        if attendance.checkpoint.write(scene):
            attendance.progress.write("The same command with --resume goes on from here.")
        return False
    return True


def _write(
    output: Path,
    scene: "Reconstruction",
    source: "PosedSource",
    options: ReconstructOptions,
    attendance: _Attendance,
    interrupted: bool,
) -> None:
    """All files of the result."""
    from geogs.application.results import SourceFacts, write_results
    from geogs.application.surfaces import write_depth_mesh

    progress = attendance.progress
    facts = SourceFacts(
        source.name, source.kind, source.camera, source.intrinsics_origin,
        scale=f"of the poses ({source.scene_scale})", held_out=tuple(source.held_out),
    )  # fmt: skip
    more = [lambda: attendance.snapshots.write(output, scene, options, progress)]
    if options.depth_mesh:
        more.append(lambda: write_depth_mesh(output, scene, options.mesh, progress))
    write_results(output, scene, facts, options, interrupted, progress, more)


def seconds(text: str, what: str = "budget") -> float:
    """Seconds of a duration such as ``90``, ``90s``, ``10m`` or ``1.5h``.

    Raises:
        InputError: it is none, or not above zero.
    """
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*(s|m|min|h)?\s*", text)
    value = float(match[1]) * _SECONDS[match[2] or ""] if match else 0.0
    if value <= 0:
        raise InputError(f"the {what} {text!r} is no duration; give one such as 90s, 10m or 1h.")
    return value


def parse(argv: Sequence[str]) -> ReconstructOptions:
    """Options with the preset as defaults, over which single settings win."""
    name = _preset_name(argv)
    base = reconstruct_preset(name)
    default = ReconstructOptions(
        seed=base.seed, input=base.input, search=base.search, mapping=base.mapping, mesh=base.mesh,
        source=tyro.MISSING, preset=name,
    )  # fmt: skip
    return parse_options(ReconstructOptions, argv, "reconstruct", default=default, short=SHORT)


def _preset_name(argv: Sequence[str]) -> Preset:
    """The preset asked for, else the one that suits the device.

    A wrong one is left for the option parser to complain about.
    """
    asked = given(argv, "preset")
    if asked is not None or "--help" in argv or "-h" in argv:
        return next((name for name in get_args(Preset) if name == asked), "default")
    device = given(argv, "device") or "auto"
    if device == "auto":
        from geogs.gpu.installation import gpu_problem

        device = "cpu" if gpu_problem() else "cuda"
    return "accurate" if device.startswith("cuda") else "default"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
