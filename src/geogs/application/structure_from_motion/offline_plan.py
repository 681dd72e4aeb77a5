"""How long a run takes that places frames by structure from motion, without tracking."""

import math
from dataclasses import replace

from geogs.application.progress.plan import PosedPlan, RunPlan
from geogs.application.structure_from_motion.chosen_frames import stretch_length
from geogs.application.structure_from_motion.photos import seconds_to_place
from geogs.config import Config, ReconstructConfig, preset_of, reconstruct_preset
from geogs.io.sources.frame_source import Source

_SECONDS_TO_CHOOSE = 0.02
"""Seconds for each frame."""


def offline_config(config: Config) -> ReconstructConfig:
    """How the map is made of frames that were placed so, with the settings of a run."""
    made = reconstruct_preset(preset_of(config))
    return replace(made, seed=config.seed, input=config.input, mesh=config.mesh)


def offline_plan(
    config: Config, source: Source, on_gpu: bool, calibrates: bool, is_begun: bool = False
) -> PosedPlan:
    """What is going to be done with a video whose length is known.

    ``is_begun`` says that focal length and shutter are known.
    """
    length, size = source.length or 0, (source.camera.width, source.camera.height)
    chosen = math.ceil(length / stretch_length(source.fps, length))
    before = {"choosing frames": _SECONDS_TO_CHOOSE * length, **seconds_to_place(chosen, length)}
    if not is_begun:
        begun = RunPlan(config, length, size, on_gpu, calibrates, True).seconds(0)
        before = {"calibration": begun["calibration"]} | before
    return PosedPlan(offline_config(config), chosen, size, on_gpu, before)
