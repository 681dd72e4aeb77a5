"""Suggested command where a run lost tracking, or is not reliable."""

import shlex

from geogs.application.results.verdict import Verdict
from geogs.application.run_settings import RunSettings
from geogs.application.structure_from_motion.fallback import impossible, is_wanted, saw_lens_vary
from geogs.application.structure_from_motion.photos import has_pycolmap
from geogs.config import InputConfig, preset_of
from geogs.evaluation.duration import duration
from geogs.extras import install_command
from geogs.io.sources.frame_source import Source
from geogs.io.sources.posed.posed_source import PosedSource

RECORD_AGAIN = (
    "Record the scene again: move slowly and sideways instead of turning on the spot, in good "
    "light."
)

WITHOUT_STABILISATION = (
    "Record the scene again with stabilisation and autofocus off, and without zooming."
)


def remedy(
    settings: RunSettings, source: Source | PosedSource, judged: Verdict | None, took: float = 0.0
) -> str:
    """A sentence with the command that most likely helps, and the time it takes.

    Empty where the result needs none. ``judged`` is none where no frame was tracked; ``took`` is
    the time of this run in seconds, if it finished.
    """
    is_placed_enough = not is_wanted(judged)
    if isinstance(source, PosedSource) or (judged and judged.is_reliable and is_placed_enough):
        return ""
    if source.is_live:
        return "Record it: geogs run RECORDING waits for no camera, and tries more."
    if judged and saw_lens_vary(judged):
        return WITHOUT_STABILISATION
    command = f"geogs run {arguments(settings)}"
    again = f", in about {duration(took)}" if took else ""
    if not (is_placed_enough or _was_placed(settings, source)):
        install = "" if has_pycolmap() else f"{install_command('photos')} && "
        return f"{install}{command} --sfm locates the frames by structure from motion."
    if settings.map is not None:
        return f"{command} makes a map of its own{again}."
    if source.calibration.focal_deviation:
        return f"If you know the focal length: {command} --intrinsics fx,fy,cx,cy{again}."
    if settings.config.input.stride > 1:
        every = duration(settings.config.input.stride * took)
        return f"{command} --stride 1 takes every frame, in about {every}."
    return RECORD_AGAIN


def arguments(settings: RunSettings) -> str:
    """Sources and main options, as arguments of ``geogs run``."""
    words = [str(path) for path in settings.source]
    name = preset_of(settings.config)
    given = settings.config.input
    usual = InputConfig()
    words += [] if name == "default" else ["--preset", name]
    for option in ("intrinsics", "take", "start", "stop", "stride"):
        if (value := getattr(given, option)) != getattr(usual, option):
            words += [f"--{option}", str(value)]
    return shlex.join(words)


def _was_placed(settings: RunSettings, source: Source) -> bool:
    """Whether structure from motion has been tried, or cannot be."""
    tried = settings.fallback and not impossible(settings, source) and has_pycolmap()
    return settings.sfm or settings.map is not None or tried
