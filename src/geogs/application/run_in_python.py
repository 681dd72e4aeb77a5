"""A whole run as one function call."""

from collections.abc import Sequence
from pathlib import Path

from geogs.application.progress.run_progress import RunProgress
from geogs.application.results.result import Result
from geogs.application.run import run as run_to_folder
from geogs.application.run_settings import RunSettings
from geogs.config import Config, preset
from geogs.gpu.early_start import is_gpu


def run(
    source: str | Path | Sequence[str | Path],
    config: Config | None = None,
    output: str | Path | None = None,
    device: str = "auto",
    *,
    progress: RunProgress | None = None,
) -> Result:
    """Do all of ``geogs run``, with its files, silently. Returns the result.

    Args:
        source: a video, a folder, a data set, a bag, or several of one scene.
        config: all settings; the preset ``default`` for the device if none.
        output: folder of the result; out/NAME if none is given, see ``Result.folder``.
        device: auto (a GPU where there is one), cpu, cuda or cuda:1.
        progress: follows the work.

    Raises:
        InputError: the source or a setting cannot be used.
        TrackingLost: no frame could be tracked.
        OutputError: a file cannot be written.
        DeviceError: the device cannot be used, or its memory was full.
    """
    several = (source,) if isinstance(source, str | Path) else source
    folder = None if output is None else Path(output)
    config = config or preset("default", is_gpu(device))
    settings = RunSettings(tuple(map(Path, several)), config, folder, device)
    return run_to_folder(settings, progress)
