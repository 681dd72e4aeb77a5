"""Calibration of a tracker's depth uncertainty, against the true surface of a room.

    python benchmarks/tracking.py SEQUENCE [--frames 150] [--every 12] [OPTIONS]

SEQUENCE is in Replica layout with mesh.ply; OPTIONS are those of geogs run (--tracking.operator
own). Keyframes are scored after the stream and after the adjustment of all of them; depth only of
every ``--every``-th one. ``geogs bench motions SEQUENCE`` scores the trajectory.
"""

import argparse
from pathlib import Path

import numpy as np
import torch

from geogs.application.run_settings import RunSettings
from geogs.cli.options import record
from geogs.cli.run import parse
from geogs.evaluation.surfaces.raster import render_mesh
from geogs.evaluation.surfaces.surface import read_surface
from geogs.geometry.camera import Camera
from geogs.loop.global_bundle import global_bundle
from geogs.threads import on_one_torch_thread
from geogs.tracking.tracker import Tracker, lone_tracker
from geogs.world.grid import OFFSET, STRIDE
from sequences import Sequence, align, load

BINS = 8


def report(tracker: Tracker, sequence: Sequence, mesh: Path, every: int) -> None:
    """Print the errors of keyframes' positions, and of depths over their standard deviations."""
    states = [tracker.keyframes[k] for k in tracker.segment.ids]
    T_wc = sequence.T_wc[[s.frame_index for s in states]]
    centres = np.stack([torch.linalg.inv(s.T_cw)[:3, 3].numpy() for s in states])
    ate, scale = align(centres, T_wc[:, :3, 3])
    print(f"{len(states)} keyframes, ATE {ate:.3f} cm")
    surface, grid = read_surface(mesh), tracker.keyframes.grid
    c = sequence.camera
    cells = Camera(
        c.fx / STRIDE, c.fy / STRIDE, (c.cx - OFFSET) / STRIDE, (c.cy - OFFSET) / STRIDE,
        grid.width, grid.height,
    )  # fmt: skip
    errors, sigmas = [], []
    for state, T in zip(states[::every], T_wc[::every], strict=True):
        z = render_mesh(surface.vertices, surface.faces, cells, np.linalg.inv(T))[0].ravel()
        d, information = state.inverse_depth.numpy(), state.information.numpy()
        ok = (information > 0) & np.isfinite(z)
        errors.append(np.abs(scale / d[ok] / z[ok] - 1))
        sigmas.append(1 / (d[ok] * np.sqrt(information[ok])))
    error, sigma = np.concatenate(errors), np.concatenate(sigmas)
    measured = len(error) / (len(errors) * grid.size)
    print(
        f"{measured:.0%} of the cells have a depth\n  sigma     |error|   |error| / sigma   > 5 %"
    )
    for part in np.array_split(np.argsort(sigma), BINS):
        e, s = error[part], sigma[part]
        print(f"  {np.median(s):7.4f}  {np.median(e):7.4f}   {np.median(e / s):7.2f}"
              f"           {(e > 0.05).mean():6.1%}")  # fmt: skip
    median, one, two = np.quantile(error / sigma, [0.5, 0.683, 0.954])
    print(f"  all: median {median:.2f} (normal: 0.67), 68 % {one:.2f} (1), 95 % {two:.2f} (2)")


@on_one_torch_thread
def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("source", type=Path)
    parser.add_argument("--frames", type=int)
    parser.add_argument("--every", type=int, default=12)
    args, options = parser.parse_known_args()
    if args.frames:
        options += ["--input.stop", str(args.frames)]
    config = record(RunSettings, parse([str(args.source), *options])).config
    sequence = load(args.source, config.input)
    tracker = lone_tracker(sequence.camera, config)
    for frame in sequence.frames:
        tracker.track(frame)
    tracker.finish()
    report(tracker, sequence, args.source / "mesh.ply", args.every)
    global_bundle(tracker)
    report(tracker, sequence, args.source / "mesh.ply", args.every)


if __name__ == "__main__":
    main()
