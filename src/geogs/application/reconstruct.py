"""A reconstruction from known poses, from the path of the images to the result."""

import hashlib
import json
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import torch

from geogs.application.calibrate import warn_of_border
from geogs.application.checkpoints.checkpoint import Checkpoint, SavedState
from geogs.application.driver import Driver, Outcome, Work
from geogs.application.interrupt import Stop
from geogs.application.machine.compilation import Compilation, compiling
from geogs.application.machine.device import compile_gpu_kernels, gpu_errors_in_a_sentence
from geogs.application.output_cost import OutputForecast
from geogs.application.plan import POSED_STAGES
from geogs.application.posed_views import PosedViews
from geogs.application.progress.run_progress import RunProgress
from geogs.application.results.output_folder import chosen_folder, claimed
from geogs.application.results.result import Result
from geogs.application.results.surfaces import Snapshots
from geogs.application.run_settings import ReconstructSettings
from geogs.application.structure_from_motion.photos import open_photographs
from geogs.config import ReconstructConfig
from geogs.config.arguments import checks_arguments
from geogs.config.idle import idle_settings
from geogs.errors import InputError
from geogs.gpu.installation import require_device
from geogs.guard.documents import expanded
from geogs.io.sources.posed.pose_check import PoseCheck, check_poses, with_focal_length
from geogs.io.sources.posed.posed_source import PosedSource
from geogs.io.sources.reader import without_ending
from geogs.io.sources.sniff import open_posed_source
from geogs.reconstruction import Reconstruction, ReconstructionTable
from geogs.stopwatch import StageProgress
from geogs.threads import on_one_torch_thread


def left_of(budget: float | None, begin: float) -> float | None:
    """Seconds left of a budget that counts from ``begin``, by the performance counter; none where
    there is no limit."""
    if budget is None:
        return None
    # Least seconds left of a budget, even if reading and checking have used it up.
    return max(budget - (time.perf_counter() - begin), 1.0)


def _compiled(
    device: torch.device, kernels: Compilation, budget: float | None, progress: RunProgress
) -> float:
    """Wait until all is compiled, once per machine. Returns the seconds, which no budget counts."""
    if budget is not None and kernels.is_working:
        progress.write(
            "note: Kernels are compiled first, once on this machine; the --budget begins after it."
        )
    return compile_gpu_kernels(device) + kernels.wait(progress.stage)


@checks_arguments
@on_one_torch_thread
def reconstruct(
    source: str | Path | PosedSource,
    config: ReconstructConfig | None = None,
    device: str | torch.device = "auto",
    budget: float | None = None,
    *,
    poses: Literal["given", "auto"] = "given",
    check: bool = True,
    progress: RunProgress | None = None,
) -> Result:
    """Reconstruct map and mesh from images with known poses, or from photographs; writes no files.

    Args:
        source: a folder or file for ``open_posed_source``, or its result.
        config: all settings; the defaults if none.
        device: auto (a GPU where there is one), cpu, cuda or cuda:1.
        budget: approximate total time in seconds; none trains to convergence.
        poses: given with the images, or auto: found from the photographs in a folder.
        check: whether to check first, by matching images, that given poses fit them.
        progress: follows the work.

    Raises:
        InputError: the images or their poses cannot be used.
        DeviceError: the device cannot be used, or its memory is full.
    """
    begin = time.perf_counter()
    config = config or ReconstructConfig()
    progress = progress or RunProgress()
    used = require_device(device)
    with compiling(used, knows_poses=True) as kernels:
        if not isinstance(source, PosedSource):
            if poses == "auto":
                with tempfile.TemporaryDirectory(prefix="geogs-photos-") as kept:
                    source = open_photographs(
                        Path(source), config, Path(kept), progress=progress, seconds=budget
                    )
            else:
                source = open_posed_source(source, config.input)
        source = with_focal_length(source)
        begin += _compiled(used, kernels, budget, progress)
    checks = progress if check and poses == "given" else None
    with gpu_errors_in_a_sentence():
        scene = Reconstruction(source.camera, config, str(used), left_of(budget, begin))
        _complete(scene, source, None, progress.stage, budget is not None, checks)
    return Result(scene, source, progress=progress)


@on_one_torch_thread
@gpu_errors_in_a_sentence()
def reconstruct_to_folder(
    settings: ReconstructSettings, progress: RunProgress | None = None, stop: Stop | None = None
) -> Result:
    """Reconstruct, and write the results, with checkpoints and snapshots on the way.

    Raises:
        InputError: the images, their poses or a setting cannot be used, or there is nothing to
            resume.
        OutputError: a file cannot be written.
        DeviceError: the device cannot be used, or its memory is full.
    """
    begin = time.perf_counter()
    progress = progress or RunProgress()
    stop = stop or Stop()
    config = settings.config
    device = require_device(settings.device)
    for sentence in idle_settings(config):
        progress.write(f"note: {sentence}")
    finds_poses = settings.sfm
    if finds_poses:
        name = expanded(settings.source).resolve().name
        made_from = None
    else:
        source = open_posed_source(settings.source, config.input, settings.hold_out)
        name = without_ending(source.name, [settings.source])
        made_from = source.fingerprint
    may_replace = settings.overwrite or settings.resume is not None
    wanted = settings.resume or settings.output
    with (
        claimed(chosen_folder(wanted, name, may_replace, progress, made_from)) as output,
        compiling(device, knows_poses=True) as kernels,
    ):
        if finds_poses:
            with stop:
                source = open_photographs(
                    settings.source,
                    config,
                    output,
                    settings.hold_out,
                    settings.resume is not None,
                    progress,
                    stop,
                    settings.budget,
                )
        source = with_focal_length(source)
        for line in source.account.lines(source.found):
            progress.write(line)
        warn_of_border(source, progress)
        progress.stages(POSED_STAGES)
        begin += _compiled(device, kernels, settings.budget, progress)
        left = left_of(settings.budget, begin)
        scene = Reconstruction(source.camera, config, str(device), left)
        driver = Driver(settings, output, device, progress, stop)
        return driver.complete(MappedImages(scene, source, settings))


@dataclass(frozen=True)
class ReconstructState:
    """Checkpoint record of ``geogs reconstruct``."""

    made_from: str
    """Fingerprint of settings and images."""
    work: ReconstructionTable


def fingerprint(config: ReconstructConfig, hold_out: int | None, images: Sequence[str]) -> str:
    """Sixteen digits that depend on the settings of the map and the names of its images."""
    parts = (config.seed, asdict(config.input), asdict(config.search), asdict(config.mapping))
    text = json.dumps([*parts, hold_out, list(images)], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def read_work(output: Path, made_from: str) -> ReconstructionTable:
    """Read the work of a checkpoint with the same fingerprint.

    Raises:
        InputError: there is nothing, it is damaged, or made from other settings or images.
    """
    saved = SavedState(output, ReconstructState)
    with saved.in_a_sentence():
        if saved.plain("made_from") != made_from:
            raise InputError("it was made with other settings or images; give the same ones")
    work: ReconstructionTable = saved.work("work")
    return work


class MappedImages(Work):
    """Images whose poses are known, mapped with checkpoints and snapshots on the way."""

    scene: Reconstruction
    source: PosedSource
    way_on = "The same command with --resume OUT continues from the last checkpoint."

    def __init__(
        self, scene: Reconstruction, source: PosedSource, settings: ReconstructSettings
    ) -> None:
        self.scene = scene
        self.source = source
        self._settings = settings
        names = [Path(source.label(i)).name for i in range(len(source))]
        self._made_from = fingerprint(settings.config, settings.hold_out, names)
        self._snapshots = Snapshots(settings.snapshots)
        self._has_depths = False

    def state(self) -> ReconstructState | None:
        """The checkpoint record; none before the depths are done."""
        if not self._has_depths:
            return None
        return ReconstructState(self._made_from, self.scene.settle())

    def write_more(self, driver: Driver, new: Path) -> None:
        """Write the snapshots."""
        self._snapshots.write(new, self.scene, driver.progress)

    def complete(self, driver: Driver, checkpoint: Checkpoint, new: Path) -> Outcome:
        """Search the depths, grow and train the map; or resume from a checkpoint.

        Raises:
            InputError: there is nothing to resume, or the images show no scene.
            KeyboardInterrupt: it was stopped before there was a map.
        """
        settings = self._settings
        scene = self.scene
        progress = driver.progress
        resumed = None
        if settings.resume is not None:
            resumed = read_work(driver.output, self._made_from)
            place = resumed.map.place
            done = f"step {place.steps} of {place.total}" if place.steps else "the depths"
            progress.write(f"Continuing after {done}, {resumed.seconds:.0f} s into the work.")
        checks = progress if settings.check_poses and not settings.sfm else None

        def report(stage: str, fraction: float) -> None:
            progress.stage(stage, fraction)
            if stage == "growing":
                progress.write(_chosen_views(scene, settings.config))
            self._snapshots.take(scene)
            self._has_depths |= stage in ("growing", "training")
            if stage == "growing":
                checkpoint.write()
            elif self._has_depths:
                checkpoint.write_if_due()
            driver.stop.check()

        def work() -> None:
            _complete(scene, self.source, resumed, report, settings.budget is not None, checks)

        return driver.map_known(scene, work, checkpoint)


def _say_whether_poses_fit(
    source: PosedSource, progress: RunProgress | None, checked: Future[PoseCheck] | None
) -> None:
    """Warn if the poses do not fit the images. Raises InputError if they clearly do not."""
    if progress is not None and checked is not None:
        check = checked.result()
        source.pose_error = check.numbers
        warning = check.warning
        progress.write(f"warning: {warning}" if warning else "")


def _complete(
    scene: Reconstruction,
    source: PosedSource,
    resumed: ReconstructionTable | None,
    report: StageProgress,
    budgeted: bool,
    checks: RunProgress | None,
) -> None:
    """Do all work up to the trained map; an exception of ``report`` ends it early.

    ``checks`` is warned if the poses do not fit the images; none where that is not checked.
    """
    views = PosedViews(scene, source, report)
    if resumed is not None:
        views.give_these(resumed.images)
        scene.resume(resumed, report)
        return
    with ThreadPoolExecutor(1, "check") as thread:
        checked = None if checks is None else thread.submit(check_poses, source)
        try:
            points = views.first_look()
        except InputError:
            # An error on the pose convention is more helpful than one on missing matches.
            _say_whether_poses_fit(source, checks, checked)
            raise
        _say_whether_poses_fit(source, checks, checked)
    views.choose(points)
    if not budgeted:
        views.give()
        scene.finish(points, report)
        return

    forecast = OutputForecast(scene)

    def more(count_of: Callable[[], int]) -> None:
        scene.budget.output_cost = forecast.first(views.times_the_surface)
        views.give(count_of())

    def reported(stage: str, fraction: float) -> None:
        report(stage, fraction)
        if stage == "growing":
            scene.budget.output_cost = forecast.settled()

    # Number of images read first; they show the cost per image, and so how many are affordable.
    views.give(24)
    scene.finish(points, reported, more)


def _chosen_views(scene: Reconstruction, asked: ReconstructConfig) -> str:
    """Message if not all images are used, or the mesh is coarse; else empty."""
    said = []
    if scene.with_depth < scene.frames:
        said.append(
            f"The map is made of {scene.with_depth} of {scene.frames} images, which show the scene "
            "best; a longer --budget or a larger --search.most-views takes more."
        )
    if scene.config.mesh != asked.mesh:
        said.append(
            "For a finer mesh the --budget is too short; geogs mesh OUT --mesh.triangle-budget "
            f"{asked.mesh.triangle_budget} makes one afterwards."
        )
    return " ".join(said)
