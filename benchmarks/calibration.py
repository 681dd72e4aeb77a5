"""Self-calibration: error of the focal length, and what it costs the trajectory.

    python benchmarks/calibration.py NAME=FOLDER... [--frames 300] [--field-of-view 60]
        [--starts 0,100,200] [--device cpu] [--no-tracking]

FOLDER is in Replica or 7-Scenes layout. The known focal length and poses are read for the printed
errors only; the search begins at the field of view given, with the principal point in the middle.
--starts estimates from those frames on, as if the video began there;
the trajectories are tracked, and adjusted as a whole, from frame 0 with the known focal length and
with the one estimated there.
"""

import argparse
import math
import time
from pathlib import Path

import numpy as np
import torch

from geogs.config import InputConfig
from geogs.evaluation.trajectory_errors import evaluate_trajectory
from geogs.geometry.camera import Camera
from geogs.loop.global_bundle import global_bundle
from geogs.threads import on_one_torch_thread
from geogs.tracking.calibration.self_calibration import self_calibrate
from geogs.tracking.tracker import lone_tracker
from geogs.types import Trajectory
from sequences import Sequence, load


def guess(camera: Camera, degrees: float) -> Camera:
    """Square pixels, the principal point in the middle, a field of view along the longer side."""
    focal = camera.long_edge / 2 / math.tan(math.radians(degrees / 2))
    centre = (camera.width - 1) / 2, (camera.height - 1) / 2
    return Camera(focal, focal, *centre, camera.width, camera.height)


@on_one_torch_thread
def ate(sequence: Sequence, camera: Camera, device: str) -> float:
    """Centimetres, after the adjustment of all keyframes."""
    tracker = lone_tracker(camera, device=device)
    for frame in sequence.frames:
        tracker.track(frame)
    tracker.finish()
    global_bundle(tracker)
    n = len(sequence.frames)
    truth = Trajectory(np.arange(n) / 30, sequence.T_wc, np.ones(n, bool))
    return float(evaluate_trajectory(tracker.trajectory(), truth).ate_rmse_cm)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("sequences", nargs="+")
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--field-of-view", type=float, default=60.0)
    parser.add_argument("--starts", default="0")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--radial", action="store_true")
    parser.add_argument("--no-tracking", action="store_true")
    options = parser.parse_args()
    torch.set_num_threads(1)
    print(
        "| sequence | from | guess | estimate | deviation | known | error | error/dev. "
        "| keyframes | seconds | ATE known | ATE auto | ratio |"
    )
    print("|---" * 13 + "|")
    for item in options.sequences:
        name, _, path = item.partition("=")
        sequence = load(Path(path), InputConfig(stop=options.frames))
        first = guess(sequence.camera, options.field_of_view)
        known = sequence.camera.fx
        for start in map(int, options.starts.split(",")):
            begin = time.perf_counter()
            found = self_calibrate(sequence.frames[start:], first, options.radial, options.device)
            seconds = time.perf_counter() - begin
            error = found.camera.fx / known - 1
            row = [name, start, f"{first.fx:.1f}"]
            if found.failure is None:
                row += [f"{found.camera.fx:.1f}", f"{100 * found.deviation:.2f} %", f"{known:.1f}",
                        f"{100 * error:+.2f} %", f"{abs(error) / found.deviation:.1f}"]  # fmt: skip
            else:
                row += [found.failure, "-", f"{known:.1f}", "-", "-"]
            row += [found.keyframes, f"{seconds:.1f}"]
            if options.no_tracking or start:
                row += ["-", "-", "-"]
            else:
                exact = ate(sequence, sequence.camera, options.device)
                auto = ate(sequence, found.camera, options.device)
                row += [f"{exact:.2f} cm", f"{auto:.2f} cm", f"{auto / exact:.2f}"]
            print("| " + " | ".join(map(str, row)) + " |", flush=True)


if __name__ == "__main__":
    main()
