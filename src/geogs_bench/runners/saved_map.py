"""One map, saved at the end of the stream and corrected by each rule of the map's update.

The paper saves the map before its final bundle adjustment and corrects that one map by every rule.
"""

from dataclasses import replace
from pathlib import Path

from geogs.application.calibrate import self_calibrated
from geogs.application.checkpoints.checkpoint import checkpoint_folder, write_checkpoint
from geogs.application.checkpoints.run_state import RunMetadata, SavedRun, run_state
from geogs.application.prior_choice import open_prior
from geogs.application.progress.run_progress import RunProgress
from geogs.application.results.result import Result
from geogs.application.results.write import write_results
from geogs.application.run_settings import RunSettings
from geogs.errors import InputError
from geogs.gpu.installation import require_device
from geogs.io.sources.sniff import open_source
from geogs.io.writers.atomic import prepare_output_folder
from geogs.slam import Slam
from geogs.threads import on_one_torch_thread

FOLDER = "before"
"""Folder, next to those of the variants, of the map before its correction."""


@on_one_torch_thread
def correct_saved_map(settings: RunSettings, output: Path, progress: RunProgress) -> None:
    """Correct the map at the end of the stream by the settings' rule; write the result.

    The first call in a folder runs the stream and keeps a checkpoint of its end; later calls whose
    settings differ only in the rule start from there.

    Raises:
        InputError: the source or a setting cannot be used, or no map was started.
        OutputError, DeviceError, TrackingLost: as of a run.
    """
    settings = settings.absolute()
    place = output.parent / FOLDER
    saved = _saved(place, settings) or _run_stream(place, settings, progress)
    source = saved.calibrated(open_source(settings.source, settings.config.input))
    device = require_device(settings.device)
    with saved.world(device) as world:
        slam = Slam(source.camera, settings.config, str(device), world=world)
    slam.adjust(progress.stage)
    write_results(output, Result(slam, source, False, progress), keyframe_images=False)


def _saved(place: Path, settings: RunSettings) -> SavedRun | None:
    """The checkpoint of the same stream, if there is one."""
    try:
        saved = SavedRun(place)
    except InputError:
        return None
    same = _without_rule(saved.metadata.settings) == _without_rule(settings)
    return saved if same else None


def _run_stream(place: Path, settings: RunSettings, progress: RunProgress) -> SavedRun:
    """Track and map up to the end of the stream, and save a checkpoint."""
    config, device = settings.config, require_device(settings.device)
    source = self_calibrated(open_source(settings.source, config.input), config, device)
    slam = Slam(source.camera, config, str(device), open_prior(config.prior, source.camera, device))
    metadata = RunMetadata(
        settings, device.type, source.fingerprint(), source.calibration, shutter=source.shutter
    )
    progress.expect(source.length)
    for frame in source:
        progress.frame(slam.process(frame))
    slam.end_stream()
    state = run_state(metadata, slam, source)
    if state is None:
        raise InputError("no map was started; there is nothing to correct.")
    write_checkpoint(checkpoint_folder(prepare_output_folder(place)), state)
    return SavedRun(place)


def _without_rule(settings: RunSettings) -> RunSettings:
    """The settings that determine the map before its correction."""
    config = settings.deciding().config
    ablation = replace(config.mapping.ablation, map_update="coherent")
    mapping = replace(config.mapping, ablation=ablation)
    return replace(settings.deciding(), config=replace(config, mapping=mapping))
