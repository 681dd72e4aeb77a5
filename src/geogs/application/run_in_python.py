"""A whole run as one function call."""

from collections.abc import Sequence
from pathlib import Path

import torch

from geogs.application.progress.run_progress import RunProgress
from geogs.application.results.result import Result
from geogs.application.run import run as run_to_folder
from geogs.application.run_settings import RunSettings
from geogs.config import Config, Preset
from geogs.config import preset as preset_config
from geogs.config.arguments import checks_arguments
from geogs.errors import InputError
from geogs.gpu.early_start import is_gpu


@checks_arguments
def run(
    source: str | Path | Sequence[str | Path],
    config: Config | None = None,
    output: str | Path | None = None,
    device: str | torch.device = "auto",
    *,
    preset: Preset = "default",
    overwrite: bool = False,
    progress: RunProgress | None = None,
) -> Result:
    """Do all of ``geogs run``, with its files, silently. Returns the result.

    Args:
        source: a video, a folder, a data set, a bag, or several of one scene.
        config: all settings; without them those of the ``preset``, for the device.
        output: folder of the result; out/NAME if none is given, or out/NAME-2 where that is taken,
            see ``Result.folder``.
        device: auto (a GPU where there is one), cpu, cuda or cuda:1.
        preset: fast, default, accurate or paper; for settings beside it give a ``config``.
        overwrite: replace an earlier result in the folder, once the new one is complete.
        progress: follows the work.

    Raises:
        InputError: the source or a setting cannot be used.
        TrackingLost: no frame could be tracked.
        OutputError: a file cannot be written, or the folder holds a result already.
        DeviceError: the device cannot be used, or its memory was full.
    """
    several = (source,) if isinstance(source, str | Path) else source
    folder = None if output is None else Path(output)
    if config is not None and preset != "default":
        raise InputError("A config has all settings; leave out either config or preset.")
    on_gpu = preset == "default" and is_gpu(str(device))
    config = config or preset_config(preset, on_gpu)
    paths = tuple(map(Path, several))
    settings = RunSettings(paths, config, folder, str(device), overwrite=overwrite)
    return run_to_folder(settings, progress)
