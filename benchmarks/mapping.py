"""What the map adds: its mesh beside that of TSDF fusion of the tracker's own depth.

    python benchmarks/mapping.py SEQUENCE [--state FILE] [--true-poses] [--baselines] [OPTIONS]

SEQUENCE is a folder in Replica layout with traj.txt, mesh.ply and points_seen_1cm.ply. It is
tracked once (the tracker's final state is kept in --state and reused); then the map is built from
that state, online keyframe by keyframe, and refined. --true-poses replaces the tracker's poses by
the true ones, in the tracker's frame and scale: an experiment that tells the errors of tracking and
mapping apart. OPTIONS are those of geogs run (--mapping.window 8). Errors are in cm.
"""

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch

from geogs.application.machine.device import peak_memory
from geogs.application.results.surfaces import fusion_views
from geogs.config import Config
from geogs.depth.completion import upsample_grid
from geogs.errors import InputError
from geogs.evaluation.surfaces.reconstruction_errors import evaluate_reconstruction
from geogs.evaluation.surfaces.surface import Surface, read_surface
from geogs.geometry.camera import Camera
from geogs.geometry.umeyama import umeyama
from geogs.io.pose_files import read_replica_trajectory
from geogs.io.sources.sniff import open_source
from geogs.loop.global_bundle import global_bundle
from geogs.mapping.mapper import Mapper
from geogs.mesh.extract import extract_mesh
from geogs.mesh.triangle_mesh import DepthMapView, Mesh
from geogs.tracking.tracker import lone_tracker
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeSet, KeyframeTable


def track(sequence: Path, config: Config) -> KeyframeSet:
    """Keyframes after tracking and the global bundle adjustment."""
    source = open_source(sequence, config.input)
    tracker = lone_tracker(source.camera, config)
    for frame in source:
        tracker.track(frame)
    tracker.finish()
    global_bundle(tracker)
    return tracker.keyframes


def save_state(path: Path, keyframes: KeyframeSet) -> None:
    """Everything but the images."""
    np.savez(
        path,
        frame=[k.frame_index for k in keyframes],
        time=[k.timestamp for k in keyframes],
        T=torch.stack([k.T_cw for k in keyframes]).numpy(),
        d=torch.stack([k.inverse_depth for k in keyframes]).numpy(),
        info=torch.stack([k.information for k in keyframes]).numpy(),
    )


def load_state(path: Path, sequence: Path, config: Config) -> KeyframeSet:
    """The keyframes of :func:`save_state`, images read again."""
    state = np.load(path)
    source = open_source(sequence, config.input)
    wanted = {int(f): n for n, f in enumerate(state["frame"])}
    keyframes = KeyframeTable.on(SampleGrid(source.camera)).new_set()
    for frame in source:
        if frame.index in wanted:
            n = wanted[frame.index]
            T_cw = torch.from_numpy(state["T"][n])
            k = keyframes.add(frame.index, float(state["time"][n]), frame.image, None, T_cw)
            k.inverse_depth = torch.from_numpy(state["d"][n])
            k.information = torch.from_numpy(state["info"][n])
    return keyframes


def alignment(keyframes: KeyframeSet, truth: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Similarity from the tracker's world to the true one, and their ATE in cm."""
    centres = torch.stack([torch.linalg.inv(k.T_cw)[:3, 3] for k in keyframes])
    true = torch.from_numpy(truth[[k.frame_index for k in keyframes], :3, 3])
    scale, R, t = umeyama(centres, true)
    error = scale * centres @ R.T + t - true
    print(f"keyframes {len(keyframes)}, ATE {100 * error.square().sum(1).mean().sqrt():.3f} cm")
    return float(scale), R.numpy(), t.numpy()


def take_true_poses(
    keyframes: KeyframeSet, truth: np.ndarray, sim: tuple[float, np.ndarray, np.ndarray]
) -> None:
    """Give keyframes the true poses, expressed in the tracker's frame and scale."""
    scale, R, t = sim
    for k in keyframes:
        T_wc = truth[k.frame_index].copy()
        T_wc[:3, 3] = R.T @ (T_wc[:3, 3] - t) / scale
        T_wc[:3, :3] = R.T @ T_wc[:3, :3]
        k.T_cw = torch.from_numpy(np.linalg.inv(T_wc))


def build(keyframes: KeyframeSet, config: Config) -> Mapper:
    """The map, keyframe by keyframe as in a run, then refined."""
    mapper = Mapper(keyframes.table, config.mapping, seed=config.seed)
    lag, start, ids = config.mapping.lag, time.perf_counter(), keyframes.ids
    for n, id in enumerate(ids):
        mapper.observe(id)
        if n >= lag:
            mapper.map_keyframe(ids[n - lag])
    for id in ids[max(0, len(ids) - lag) :]:
        mapper.map_keyframe(id)
    print(
        f"online: {len(mapper.table.disks)} disks, {time.perf_counter() - start:.1f} s", flush=True
    )
    return mapper


class Scorer:
    """Prints the errors of meshes."""

    def __init__(self, sequence: Path, config: Config, sim, keyframes, truth, render: Camera):
        self.config, self.sim, self.render = config, sim, render
        self.truth = read_surface(sequence / "mesh.ply")
        self.seen = read_surface(sequence / "points_seen_1cm.ply")
        self.poses = np.array([truth[k.frame_index] for k in keyframes])
        self.true_depths = self._raycast()
        self.rows: list[dict] = []

    def _raycast(self) -> np.ndarray | None:
        from geogs.evaluation.surfaces.raster import render_mesh

        depths = [
            render_mesh(self.truth.vertices, self.truth.faces, self.render, np.linalg.inv(T))[0]
            for T in self.poses
        ]
        return np.where(np.isfinite(depths), depths, 0)

    def depth(self, name: str, depths: list[np.ndarray]) -> None:
        """Error of depth maps at the keyframes' true depths; zeros count as uncovered."""
        d = self.sim[0] * np.array(depths)
        both = (d > 0) & (self.true_depths > 0)
        e = 100 * np.abs(d - self.true_depths)[both]
        print(
            f"{name:24s} depth median {np.median(e):.2f} mean {e.mean():.2f} cm, under 1/2/5 cm "
            f"{100 * (e < 1).mean():.0f}/{100 * (e < 2).mean():.0f}/{100 * (e < 5).mean():.0f} %, "
            f"cover {100 * both.sum() / (self.true_depths > 0).sum():.1f} %",
            flush=True,
        )

    def mesh(
        self, name: str, views: Sequence[DepthMapView], min_weight: float | None = None
    ) -> None:
        """Fuse depth maps with the settings of a run and compare."""
        config = self.config.mesh
        if min_weight is not None:
            config = replace(config, min_weight=min_weight)
        try:
            mesh = extract_mesh(views, replace(config, colour=False))
        except InputError as error:
            print(f"{name:24s} {error}")
            return
        scale, R, t = self.sim
        vertices = scale * mesh.vertices.astype(np.float64) @ R.T + t
        s = evaluate_reconstruction(
            Surface(vertices, mesh.faces), self.truth, self.seen, samples=100_000
        ).scores
        print(
            f"{name:24s} Acc {s.accuracy_cm:.2f} (median {s.accuracy_median_cm:.2f}) "
            f"Comp {s.completeness_cm:.2f} Comp.Rat {s.completeness_ratio:.1f} "
            f"Prec {s.precision_ratio:.1f}  ({len(mesh.faces)} faces)",
            flush=True,
        )
        self.rows.append({"name": name, **asdict(s)})
        self.last: Mesh = mesh


def report_map(name: str, mapper: Mapper, scorer: Scorer) -> None:
    """Depth and mesh of the map as it stands, with and without the spread mask."""
    renders = mapper.renders()
    scorer.depth(name, [r.depth.numpy() for r in renders])
    scorer.mesh(name, fusion_views(renders))
    whole = [replace(v, weight=torch.ones_like(v.weight)) for v in fusion_views(renders)]
    scorer.mesh(f"{name}, no spread mask", whole)


def baselines(mapper: Mapper, scorer: Scorer, camera: Camera) -> None:
    """TSDF of the tracker's depth (all, sure) and of the searched keyframe depths."""
    every, sure, searched = [], [], []
    for i in mapper.table.mapped:
        view = mapper.views[i]
        inverse, information = view.depth_view.inverse_depth, view.depth_view.information
        d = 1 / upsample_grid(inverse, camera, scorer.render)
        precision = upsample_grid(inverse * np.sqrt(information), camera, scorer.render)
        item = DepthMapView(torch.from_numpy(d), torch.ones(d.shape), scorer.render, view.T_cw)
        every.append(item)
        sure.append(replace(item, weight=torch.from_numpy((precision > 1 / 0.05).astype("f4"))))
        searched.append(
            replace(
                item,
                depth=view.dense.depth.cpu(),
                weight=view.dense.confidence.cpu(),
            )
        )
    scorer.depth("tracker, all", [v.depth.numpy() for v in every])
    scorer.mesh("TSDF tracker, all", every)
    scorer.depth("tracker, sure", [(v.depth * v.weight).numpy() for v in sure])
    scorer.mesh("TSDF tracker, sure", sure)
    scorer.depth("searched, all", [v.depth.numpy() for v in searched])
    scorer.depth("searched, sure", [(v.depth * (v.weight > 0.5)).numpy() for v in searched])
    scorer.mesh("TSDF searched, weighted", searched, 0.5)


def main() -> None:
    """See the module's text."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sequence", type=Path)
    parser.add_argument("--state", type=Path)
    parser.add_argument("--true-poses", action="store_true")
    parser.add_argument("--baselines", action="store_true")
    parser.add_argument("--no-refine", action="store_true")
    parser.add_argument("--save-mesh", type=Path)
    arguments, rest = parser.parse_known_args()
    config = parse_config(rest)
    if arguments.state and arguments.state.exists():
        keyframes = load_state(arguments.state, arguments.sequence, config)
    else:
        keyframes = track(arguments.sequence, config)
        if arguments.state:
            save_state(arguments.state, keyframes)
    truth = read_replica_trajectory(arguments.sequence / "traj.txt").T_wc
    sim = alignment(keyframes, truth)
    if arguments.true_poses:
        take_true_poses(keyframes, truth, sim)
    torch.set_num_threads(1)  # as in a run
    mapper = build(keyframes, config)
    scorer = Scorer(arguments.sequence, config, sim, keyframes, truth, mapper.cameras.render)
    if arguments.baselines:
        baselines(mapper, scorer, keyframes.grid.camera)
    report_map("map, online", mapper, scorer)
    if not arguments.no_refine:
        start = time.perf_counter()
        mapper.refine()
        print(f"refined: {len(mapper.table.disks)} disks, {time.perf_counter() - start:.1f} s")
        if arguments.baselines:
            baselines(mapper, scorer, keyframes.grid.camera)
        report_map("map, final", mapper, scorer)
    print(f"peak memory {peak_memory() / 2**30:.2f} GiB")
    if arguments.save_mesh:
        from geogs.io.writers.ply_writer import write_mesh

        write_mesh(arguments.save_mesh, scorer.last.vertices, scorer.last.faces)
    print(json.dumps(scorer.rows[-1]))


def parse_config(options: list[str]) -> Config:
    """Settings from the options of geogs run."""
    from geogs.cli.run import parse

    return parse(["none", *options]).config


if __name__ == "__main__":
    sys.exit(main())
