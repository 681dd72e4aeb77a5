"""A run, from the paths of its videos or from a checkpoint to the files of its result."""

import math
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path

from geogs.application.calibrate import self_calibrated, without_overlay
from geogs.application.checkpoints.run_state import RunMetadata, SavedRun
from geogs.application.driver import Driver, Work
from geogs.application.interrupt import Stop
from geogs.application.machine.compilation import Compilation, compiling
from geogs.application.machine.device import compile_gpu_kernels, gpu_errors_in_a_sentence
from geogs.application.named_files import options_missing, with_files_of
from geogs.application.plan import run_stages
from geogs.application.prior_choice import open_prior
from geogs.application.progress.run_progress import RunProgress
from geogs.application.remedy import remedy
from geogs.application.results.output_folder import chosen_folder, claimed
from geogs.application.results.result import Result
from geogs.application.results.saved_result import SavedResult, load_result
from geogs.application.run_settings import RunSettings
from geogs.application.scale.known_length import SensorScale, scale_source
from geogs.application.slam_in_python import go_on_in, new_slam
from geogs.application.structure_from_motion.fallback import TrackedOrPlaced
from geogs.application.tracked_video import TrackedVideo
from geogs.application.viewer.observer import RunObserver
from geogs.config import Config, InputConfig
from geogs.config.idle import idle_settings
from geogs.errors import InputError, TrackingLost
from geogs.gpu.installation import require_device
from geogs.io.sources.address import live_address
from geogs.io.sources.frame_source import Source
from geogs.io.sources.sniff import open_source
from geogs.threads import on_one_torch_thread
from geogs.tracking.flow.operator_choice import operator_found


@on_one_torch_thread
@gpu_errors_in_a_sentence()
def run(
    settings: RunSettings,
    progress: RunProgress | None = None,
    stop: Stop | None = None,
    observer: RunObserver | None = None,
    kernels: Compilation | None = None,
) -> Result:
    """Open the sources, calibrate, track and map every frame, write the results.

    With ``settings.sfm``, frames are located by structure from motion instead. ``kernels`` is a
    compilation that is running already; the caller stops it.

    Raises:
        InputError: a source, a setting or a prior cannot be used.
        TrackingLost: no frame could be tracked.
        OutputError: a file cannot be written.
        DeviceError: the device cannot be used, or its memory was full; results so far are written.
        KeyboardInterrupt: it was stopped before there was anything to keep, or twice.
    """
    progress = progress or RunProgress()
    stop = stop or Stop()
    device = require_device(settings.device)
    defers_map = maps_at_the_end(settings, observer)
    _report_settings(settings, defers_map, progress)
    base = None if settings.map is None else load_result(settings.map, device)
    opened = opened_for(settings, base)
    _check_input(settings, opened, progress)
    progress.stages(run_stages(settings, opened, defers_map))
    wanted = settings.output or Path("out") / opened.stem
    if base is not None and wanted.resolve() == base.folder.resolve():
        raise InputError(f"{wanted} holds the map to go on with; give another folder by -o.")
    wanted = chosen_folder(
        settings.output, opened.stem, settings.overwrite, progress, opened.fingerprint
    )
    compiled = compiling(device) if kernels is None else nullcontext(kernels)
    with claimed(wanted) as output, compiled as kernels:
        compile_gpu_kernels(device)
        driver = Driver(settings, output, device, progress, stop, observer, kernels)
        opened = without_overlay(opened, progress)
        if settings.sfm:
            return driver.complete(_offline(settings.config, driver, opened))
        source = self_calibrated(opened, settings.config, device, progress, stop)
        prior = open_prior(settings.config.prior, source.camera, device)
        slam = new_slam(source, settings.config, device, prior, defers_map)
        if base is not None:
            go_on_in(slam, base)
        metadata = _metadata(settings, driver, opened, source)
        tracked = TrackedVideo(slam, source, iter(source), metadata, output)
        return _completed(driver, settings, TrackedOrPlaced(tracked, opened))


def _report_settings(settings: RunSettings, defers_map: bool, progress: RunProgress) -> None:
    """Name settings that do nothing. Raises InputError for those that exclude each other."""
    config = settings.config
    knows_metres = scale_source(settings.scale_from) is not None or config.input.depth != "none"
    if settings.sfm and knows_metres:
        raise InputError("--sfm gives no metric scale; leave out --scale-from and --depth.")
    if not settings.sfm:
        for sentence in idle_settings(config, defers_map, _is_live(settings)):
            progress.write(f"note: {sentence}")
    if (operator := operator_found(config.tracking)) is not None:
        progress.write(f"note: {operator}")


def _check_input(settings: RunSettings, opened: Source, progress: RunProgress) -> None:
    """Report the account of the input. Raises InputError if needed depths are missing."""
    for line in opened.account.lines(opened.found):
        progress.write(line)
    if isinstance(scale_source(settings.scale_from), SensorScale) and not opened.uses_depth:
        raise InputError("--scale-from sensor needs measured depth: give --depth sensor, too.")


def _offline(config: Config, driver: Driver, opened: Source) -> Work:
    """The work of structure from motion, from a calibrated start."""
    from geogs.application.structure_from_motion.offline import (
        MIN_READOUT_FPS,
        PlacedOffline,
        beginning_with,
    )

    finds_readout = opened.recorded_fps >= MIN_READOUT_FPS
    found = self_calibrated(
        opened, config, driver.device, driver.progress, driver.stop, finds_readout
    )
    return PlacedOffline(config, beginning_with(opened, found))


def _metadata(settings: RunSettings, driver: Driver, opened: Source, source: Source) -> RunMetadata:
    """Metadata of a run for its checkpoints."""
    found = None if source.calibration is opened.calibration else source.calibration
    return RunMetadata(
        settings.absolute(), driver.device.type, source.fingerprint(), found, shutter=source.shutter
    )


def opened_for(settings: RunSettings, base: SavedResult | None) -> Source:
    """Open the sources; to continue a map, straight and in its keyframes' pinhole."""
    given = settings.config.input
    if base is None:
        return open_source(settings.source, given)
    return opened_in(base, given, partial(open_source, settings.source))


def opened_in(
    base: SavedResult, given: InputConfig, opener: Callable[[InputConfig], Source]
) -> Source:
    """Open a source, straight, and in the pinhole of a map's keyframes if its lens is not given."""
    known = base.folder / "intrinsics.json"
    if given.intrinsics.strip().lower() != "auto" or not known.is_file():
        return opener(given).straight()
    opened = opener(replace(given, intrinsics=str(known))).straight()
    focal = base.camera.fx
    is_same = math.isclose(opened.camera.fx, focal, rel_tol=1e-6)
    return opened if is_same or given.working_field_of_view != "auto" else opened.with_focal(focal)


def _completed(driver: Driver, settings: RunSettings, work: TrackedOrPlaced) -> Result:
    """Track, map, write. Raises TrackingLost, with a remedy, if no frame could be located."""
    try:
        return driver.complete(work)
    except TrackingLost as lost:
        help = remedy(settings, work.source, None)
        raise TrackingLost(f"{lost} {help}") from lost


def _is_live(settings: RunSettings) -> bool:
    """Whether a source is live."""
    return any(map(live_address, settings.source))


def maps_at_the_end(settings: RunSettings, observer: RunObserver | None) -> bool:
    """Whether the map is made once, after the video; by default if there is no viewer."""
    mapping = settings.config.mapping
    if not mapping.may_follow or _is_live(settings):
        return False
    is_shown = observer is not None or settings.online_results or settings.map is not None
    return mapping.when == "after" or not is_shown


@on_one_torch_thread
@gpu_errors_in_a_sentence()
def resume(
    output: Path,
    settings: RunSettings | None = None,
    progress: RunProgress | None = None,
    stop: Stop | None = None,
    observer: RunObserver | None = None,
) -> Result:
    """Resume the run whose checkpoint lies in a folder, with the same result.

    ``settings`` default to those of the run. They may differ in settings that do not affect poses
    and map: the mesh, the number of the device, checkpoints, additional files, and paths. Files
    named by a checkpoint are opened only if they are in the folder, or the user made the
    checkpoint; else they must be given.

    Raises:
        InputError: there is nothing to resume, or it cannot be used, or with other settings.
        TrackingLost, OutputError, DeviceError: as for ``run``.
    """
    progress = progress or RunProgress()
    stop = stop or Stop()
    saved = SavedRun(output)
    settings = continued(saved.metadata, settings or saved.settings, output)
    device = require_device(settings.device)
    opened = without_overlay(open_source(settings.source, settings.config.input))
    source = saved.calibrated(opened if settings.map is None else opened.straight())
    with claimed(output) as folder, compiling(device) as kernels:
        compile_gpu_kernels(device)
        prior = open_prior(settings.config.prior, source.camera, device)
        with saved.world(device) as world:
            slam = new_slam(source, settings.config, device, prior, world=world)
        progress.write(f"Continuing after {slam.frames} frames.")
        metadata = replace(saved.metadata, settings=settings.absolute(), device=device.type)
        frames = source.frames_after(saved.metadata.place)
        work = TrackedVideo(slam, source, frames, metadata, folder)
        driver = Driver(settings, folder, device, progress, stop, observer, kernels)
        return _completed(driver, settings, TrackedOrPlaced(work, opened))


def continued(begun: RunMetadata, settings: RunSettings, output: Path) -> RunSettings:
    """Settings to resume with in a folder, on the run's kind of device or the CPU.

    Raises:
        InputError: they change the result or the folder, or do not name the run's files.
    """
    missing = options_missing(settings, begun.settings)
    if missing:
        raise InputError(
            f"The checkpoint in {output} was not made by you on this machine, and what it names "
            f"outside of that folder is opened only where you name it: give {', '.join(missing)} "
            f"beside --resume {output}."
        )
    if _is_live(settings):
        raise InputError(
            "A live source cannot be read again; give the video that the run was begun with."
        )
    same_place = with_files_of(begun.settings, settings).deciding()
    elsewhere = settings.output is not None and settings.output.resolve() != output.resolve()
    if elsewhere or settings.deciding() != same_place:
        raise InputError(
            "--resume goes on with the source and the settings of the run; leave out everything "
            "else but --device, --mesh, --checkpoint-every, --fallback, --online-results, "
            "--depth-mesh, --keyframe-images and --scale-from."
        )
    device = begun.device if settings.device == "auto" else settings.device
    if not device.startswith(begun.device) and device != "cpu":
        raise InputError(f"The run was on {begun.device}, and can only go on there.")
    return replace(settings, device=device)
