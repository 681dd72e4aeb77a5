"""``geogs reconstruct SOURCE``: images with known poses in; mesh and disk map out."""

import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from geogs.cli.interrupt import Interruption
from geogs.cli.options import SHORT, parse_options
from geogs.cli.progress import RunProgress
from geogs.config import ReconstructConfig
from geogs.errors import InputError

if TYPE_CHECKING:
    from geogs.cli.snapshots import Snapshots
    from geogs.io.sources.posed.base import PosedSource
    from geogs.reconstruct import Reconstruction

_SECONDS = {"": 1.0, "s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0}


@dataclass(frozen=True)
class ReconstructOptions(ReconstructConfig):
    """Reconstruct images whose poses are known: a COLMAP model, nerfstudio, DTU, Replica, TUM...

    Lengths of the result are in the unit of the poses. Every default works.
    """

    source: Annotated[Path, tyro.conf.Positional] = Path()
    """Folder of images with poses, or the file with the poses."""
    output: Path | None = None
    """Folder for the results (also -o); out/NAME if none is given."""
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
    device: str = "auto"
    """Where to compute: auto (a GPU where there is one), cpu, cuda or cuda:1; see geogs doctor."""


def main(argv: Sequence[str]) -> int:
    """Run the command; returns the exit code."""
    reconstruct(parse(argv))
    return 0


def reconstruct(options: ReconstructOptions) -> Path:
    """Reconstruct, write the results, say where they are; returns their folder."""
    budget = None if options.budget is None else seconds(options.budget)
    due = [seconds(text, "time") for text in options.snapshots.split(",") if text.strip()]

    import torch

    import geogs
    from geogs.cli.results import SourceFacts, write_results
    from geogs.cli.snapshots import Snapshots
    from geogs.cli.surfaces import write_depth_mesh
    from geogs.gpu.installation import require_device
    from geogs.gpu.kernels import prepare_kernels
    from geogs.io.sources.posed.check import check_poses
    from geogs.io.sources.posed.sniff import open_posed_source
    from geogs.io.writers.atomic import prepare_output_folder
    from geogs.reconstruct import Reconstruction

    torch.set_num_threads(1)  # the kernels have threads of their own; see geogs.threads
    device = require_device(options.device)
    source = open_posed_source(options.source, options.input, options.hold_out)
    output = prepare_output_folder(options.output or Path("out") / source.name)
    if device.type == "cuda":
        prepare_kernels(Path(geogs.__file__).parent, device)
    warning = check_poses(source).warning if options.check_poses else None
    scene = Reconstruction(source.camera, options, str(device), budget)
    snapshots = Snapshots(due)
    with Interruption() as stop, RunProgress(source.length, tracks=False) as progress:
        progress.write(f"warning: {warning}" if warning else "")
        finished = _reconstruct(scene, source, snapshots, progress, stop)
        facts = SourceFacts(
            source.name, source.kind, source.camera, source.intrinsics_origin,
            scale=f"of the poses ({source.scene_scale})", held_out=tuple(source.held_out),
        )  # fmt: skip
        more = [lambda: snapshots.write(output, scene, options, progress)]
        if options.depth_mesh:
            more.append(lambda: write_depth_mesh(output, scene, options.mesh, progress))
        write_results(output, scene, facts, options, not finished, progress, more)
    print(f"Results are in {output}/")
    return output


def _reconstruct(
    scene: "Reconstruction",
    source: "PosedSource",
    snapshots: "Snapshots",
    progress: RunProgress,
    stop: Interruption,
) -> bool:
    """Everything up to the trained map; false if a request to stop cut it short."""
    import torch

    from geogs.errors import DeviceError

    def report(stage: str, fraction: float) -> None:
        progress.stage(stage, fraction)
        snapshots.take(scene)
        stop.check()

    try:
        for image in source:
            scene.add(image.image, image.T_cw, image.mask, image.timestamp)
            report("reading", scene.frames / source.length)
        scene.finish(None if source.points is None else source.points.positions, report)
    except KeyboardInterrupt:
        if not len(scene.snapshot()):
            raise
        progress.write("Stopping early; keeping what there is. Press Ctrl-C again to quit.")
        return False
    except torch.cuda.OutOfMemoryError as error:
        raise DeviceError(
            "The memory of the GPU is full; use fewer images (--stride), a smaller --long-edge, a "
            "GPU with more memory, or --device cpu."
        ) from error
    return True


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
    """Options, some of which have short names."""
    return parse_options(
        ReconstructOptions,
        argv,
        "reconstruct",
        default=ReconstructOptions(source=tyro.MISSING),
        short=SHORT,
    )


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
