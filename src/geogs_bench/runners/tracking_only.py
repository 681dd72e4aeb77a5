"""The tracker and the loop closures on a source, without a map: all that estimates the poses."""

import json
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

from geogs.application.calibrate import self_calibrated
from geogs.application.results.summary import state_spans
from geogs.application.results.verdict import verdict
from geogs.application.run_settings import RunSettings
from geogs.errors import TrackingLost
from geogs.gpu.installation import require_device
from geogs.io.sources.sniff import open_source
from geogs.io.writers.atomic import prepare_output_folder, write_text
from geogs.io.writers.trajectories import write_trajectories
from geogs.io.writers.uncertainty import write_uncertainty
from geogs.loop.global_bundle import global_bundle
from geogs.slam import Slam
from geogs.threads import on_one_torch_thread
from geogs.tracking.frame_uncertainty import frame_uncertainty


@on_one_torch_thread
def track_to_folder(
    settings: RunSettings, output: Path, on_frame: Callable[[int], None] = lambda index: None
) -> None:
    """Track every frame, close loops, adjust all keyframes; write trajectory and summary.

    A video in which no frame can be tracked leaves a summary with that failure, and no trajectory.

    Raises:
        InputError: the source or a setting cannot be used.
        DeviceError, OutputError: the device, or the folder.
    """
    device = require_device(settings.device)
    source = self_calibrated(
        open_source(settings.source, settings.config.input), settings.config, device
    )
    folder = prepare_output_folder(output)
    slam = Slam(source.camera, settings.config, str(device))
    start = time.perf_counter()
    frames = 0
    for frame in source:
        slam.loops.update(slam.segments.track(frame, slam.loops.recognise), False)
        slam.segments.main.keyframes.take_corrections()
        frames += 1
        on_frame(frames)
    seconds = time.perf_counter() - start
    summary = {
        "device": device.type,
        "frames": frames,
        "shutter": asdict(source.shutter),
        "frames_per_second": {"until_stream_end": round(frames / max(seconds, 1e-9), 3)},
    }
    try:
        slam.loops.update(slam.segments.finish(), True)
        global_bundle(slam.segments.main, ends=True)
        trajectory = slam.trajectory()
        known = frame_uncertainty(slam.segments.main)
        write_trajectories(folder, trajectory, slam.keyframe_trajectory())
        write_uncertainty(folder / "trajectory_uncertainty.csv", trajectory, known)
        summary["lost_spans"] = state_spans(trajectory, "lost")
        said = verdict(trajectory, slam.keyframe_trajectory(), known, slam.segments.table.why_not)
        summary["verdict"] = {"is_reliable": said.is_reliable, "sentence": said.sentence}
    except TrackingLost as error:
        summary["not_tracked"] = str(error)
    write_text(folder / "summary.json", json.dumps(summary, indent=2) + "\n")
