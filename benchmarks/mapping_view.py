"""Milliseconds of one mapping view: render, all losses, backward, and the view's share of Adam.

    python benchmarks/mapping_view.py [--disks 20000] [--width 320] [--repeat 30]

The map is made of a synthetic room's true depth by the system's own initialisation; the view has
two photometric partners at twice the render's size, and every loss of a run is on.
"""

import argparse
import statistics
import time
from dataclasses import replace

import numpy as np
import torch

from geogs.config import DiskConfig, MappingConfig
from geogs.depth.depth_view import DenseDepth, KeyframeDepth
from geogs.geometry.lie import se3_inverse
from geogs.mapping.keyframe_views import KeyframeViews, MapView
from geogs.mapping.training.cpu import CpuTrainer, view_loss
from geogs.mapping.view_arrays import MapCameras, ViewArrays
from geogs.splat.init import initialise_disks
from geogs.splat.render import render
from geogs.threads import worker_count
from geogs.world.disks import GaussianMap
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeTable
from geogs.world.map import MapTable
from geogs_synth.motion.handheld import HandheldPath
from geogs_synth.places.room import make_room
from geogs_synth.raycast.raycaster import Raycaster
from geogs_synth.sequence.location import centred_camera


def make_views(config: MappingConfig, width: int) -> tuple[list[MapView], MapCameras]:
    """Keyframes of a synthetic room with their true depth as prior."""
    photo = centred_camera(2 * width, 3 * width // 2)
    cameras = MapCameras(photo, photo.with_long_edge(width), photo)
    scene = make_room(0)
    caster = Raycaster(scene)
    poses = HandheldPath(scene).at_frames(np.arange(60))
    segment = KeyframeTable.on(SampleGrid(photo)).new_set()
    views, pool = (
        [],
        KeyframeViews(ViewArrays(MapTable.empty("cpu"), segment.table, cameras, config.loss)),
    )
    for index in (0, 12, 24, 36, 48):
        image = caster.render(photo, poses[index]).image
        depth = caster.render(cameras.render, poses[index]).depth
        T_cw = se3_inverse(torch.from_numpy(poses[index]))
        view = pool.add(segment.add(index, index / 30, image, None, T_cw).id)
        view.set_depth(DenseDepth.of(KeyframeDepth(depth, np.ones_like(depth))))
        view.rendered_depth = torch.from_numpy(depth)
        views.append(view)
    return views, cameras


def make_map(views: list[MapView], cameras: MapCameras, count: int) -> GaussianMap:
    """``count`` disks on the surfaces that the views see, from evenly drawn pixels."""
    disks = GaussianMap.empty()
    random = torch.Generator().manual_seed(0)
    camera = cameras.render
    for view in views:
        pixels = torch.randperm(camera.width * camera.height, generator=random)
        pixels = pixels[: -(-count // len(views))]
        depth = view.dense.depth
        T_wc = view.T_wc.float()
        points = camera.back_project(depth).reshape(-1, 3)[pixels] @ T_wc[:3, :3].T + T_wc[:3, 3]
        spacing = (camera.width * camera.height / len(pixels)) ** 0.5
        new = initialise_disks(
            points, T_wc[:3, 3], spacing * depth.flatten()[pixels] / camera.fx, points[:0],
            DiskConfig(),
        )  # fmt: skip
        disks.append(new, view.id)
    disks.keep(torch.arange(len(disks)) < count)
    return disks


def main() -> None:
    """See the module's text."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--disks", type=int, default=20_000)
    parser.add_argument("--width", type=int, default=320)
    parser.add_argument("--repeat", type=int, default=30)
    options = parser.parse_args()
    torch.set_num_threads(1)  # as in a run
    config = MappingConfig()
    config = replace(config, loss=replace(config.loss, smoothness_weight=0.01))
    views, cameras = make_views(config, options.width)
    disks = make_map(views, cameras, options.disks)
    trainer = CpuTrainer(disks, cameras, config, unit=2.5)
    view, partners = views[2], [views[1], views[3]]
    stages: dict[str, list[float]] = {}
    for _ in range(options.repeat + 3):
        marks = [time.perf_counter()]
        output = render(disks, cameras.render, view.T_cw)
        marks.append(time.perf_counter())
        loss = view_loss(view, partners, output, config, 2.5)
        marks.append(time.perf_counter())
        loss.backward()
        marks.append(time.perf_counter())
        trainer.optimizer.step(output.visible)
        trainer.optimizer.zero_grad()
        marks.append(time.perf_counter())
        for name, seconds in zip(
            ("render", "losses", "backward", "Adam"), np.diff(marks), strict=True
        ):
            stages.setdefault(name, []).append(1000 * seconds)
    medians = {name: statistics.median(values[3:]) for name, values in stages.items()}
    print(
        f"{len(disks)} disks, {cameras.render.width}x{cameras.render.height}, "
        f"{worker_count()} threads: "
        + ", ".join(f"{name} {ms:.1f}" for name, ms in medians.items())
        + f"; view {sum(medians.values()):.1f} ms (with half of Adam's: "
        f"{sum(medians.values()) - medians['Adam'] / 2:.1f} ms)"
    )


if __name__ == "__main__":
    main()
