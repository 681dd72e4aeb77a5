"""Keyframe depths of the classical search and of the network against exact depth, by surface.

    python benchmarks/depth_engines.py [--rooms 3] [--keyframes 3] [--width 320] [--device cpu]

Rooms are those of ``geogs synth``, which the network's training never uses, with the noise of a
camera; once unchanged, once with most of their materials of one colour. Poses have errors like the
tracker's, whose depth is simulated: right to 3 % where there is texture, elsewhere a guess.
"""

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import cv2
import numpy as np
import torch

from geogs.config import DepthConfig
from geogs.depth.depth_engine import DepthEngine, DepthTask
from geogs.depth.depth_view import DenseDepth, DepthView, PosedDepth, depth_images
from geogs.depth.engine_choice import depth_engine
from geogs.depth.sweep_neighbors import select_sweep_neighbours
from geogs.geometry.camera import Camera
from geogs.geometry.depth_maps import normals_from_depth
from geogs.geometry.lie import se3_exp
from geogs.threads import worker_count
from geogs.world.grid import OFFSET, STRIDE
from geogs_synth.motion.handheld import HandheldPath
from geogs_synth.places.room import make_room
from geogs_synth.raycast.raycaster import Raycaster
from geogs_synth.scene.textured_scene import Scene
from geogs_synth.sequence.location import centred_camera
from geogs_train.depth.depth_scores import KINDS, texture_kind

STEP = 6
"""Frames between keyframes: 0.2 s."""
AROUND = 4
"""Number of keyframes before and after one from which its neighbours are chosen."""
NOISE = 1.5
"""Noise of the images, grey levels."""
SHIFT, TURN = 0.001, 0.02
"""Standard deviations of the positions along each axis, metres, and of the rotations, degrees."""
FLAT = 0.8
"""Fraction of the materials that are of one colour in the second set."""
COLUMNS = (
    "engine",
    "surface",
    "of all, %",
    "error, %: median / mean",
    "within 2 / 5 %, %",
    "mean confidence, %",
    "sure (above 1/2), %",
    "of the sure within 2 %, %",
    "normals of depth, °",
    "own normals, °",
    "s",
)


@dataclass(frozen=True)
class Keyframe:
    """Input of an engine, and the truth at the size of the render."""

    view: DepthView
    depth: np.ndarray
    normal: np.ndarray
    kind: np.ndarray


@dataclass(frozen=True)
class Found:
    """Errors of the pixels of one engine, one row each."""

    error: np.ndarray
    """Relative error of depth."""
    confidence: np.ndarray
    angle: np.ndarray
    """Angle between true normals and those of the depth, degrees."""
    own_angle: np.ndarray
    """The same for the engine's own normals; nan without them."""
    kind: np.ndarray


def flattened(scene: Scene, seed: int) -> Scene:
    """Give most of the materials one colour."""
    rng = np.random.default_rng([seed, 17])
    textures = tuple(
        replace(t, image=np.full_like(t.image, t.image.mean((0, 1)))) if rng.random() < FLAT else t
        for t in scene.textures
    )
    return replace(scene, textures=textures)


def shoot(
    caster: Raycaster, T_wc: np.ndarray, number: int, working: Camera, render: Camera
) -> Keyframe:
    """Render one keyframe of a room."""
    rng = np.random.default_rng([number, 5])
    fine, coarse = caster.render(working, T_wc), caster.render(render, T_wc)
    noisy = fine.image + rng.normal(0, NOISE, fine.image.shape)
    image = np.clip(noisy.round(), 0, 255).astype(np.uint8)
    kinds = [texture_kind(torch.from_numpy(v.shade**2).movedim(-1, 0)[None])[0].numpy()
             for v in (fine, coarse)]  # fmt: skip
    cells = (slice(OFFSET, -3, STRIDE), slice(OFFSET, -3, STRIDE))
    true, bare = 1 / np.maximum(fine.depth[cells], 0.1), kinds[0][cells] == 2
    wrong = np.where(
        bare, rng.uniform(0.6, 1.6, true.shape), 1 + 0.03 * rng.normal(size=true.shape)
    )
    information = np.where(bare, 1e-2, (1 / (0.15 * true)) ** 2).astype(np.float32)
    error = torch.from_numpy(rng.normal(0, [SHIFT] * 3 + [np.radians(TURN)] * 3))
    T_cw = se3_exp(error).numpy() @ np.linalg.inv(T_wc)
    view = DepthView(
        number, T_cw, *depth_images(image, render), image,
        (true * wrong).astype(np.float32), information,
    )  # fmt: skip
    return Keyframe(view, coarse.depth, coarse.normal, kinds[1])


def neighbours_of(keyframes: Sequence[Keyframe], index: int, render: Camera) -> list[int]:
    """Neighbours by the mapper's selection."""
    typical = float(np.median(keyframes[index].depth))
    views = [k.view for k in keyframes]
    return select_sweep_neighbours(views[index], views, typical, render)


def compare(keyframe: Keyframe, dense: DenseDepth, render: Camera) -> Found:
    """Errors of the pixels of one keyframe with known depth."""
    found = dense.arrays()
    normal, valid = normals_from_depth(torch.from_numpy(found.depth), render)
    known = (keyframe.depth > 0) & valid.numpy()
    nothing = np.full(keyframe.depth.shape, np.nan)
    own = nothing if dense.normal is None else angle(dense.normal.cpu().numpy(), keyframe.normal)
    columns = (
        np.abs(found.depth / np.maximum(keyframe.depth, 1e-6) - 1), found.confidence,
        angle(normal.numpy(), keyframe.normal), own, keyframe.kind,
    )  # fmt: skip
    return Found(*(c[known] for c in columns))


def angle(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Angle in degrees; nan where the first is no normal."""
    cosine = (first * second).sum(-1)
    known = np.linalg.norm(first, axis=-1) > 0.5
    return np.where(known, np.degrees(np.arccos(np.clip(cosine, -1, 1))), np.nan)


def report(name: str, parts: Sequence[Found], seconds: float) -> None:
    """Print a row for each kind of surface, and one for all."""
    names = [f.name for f in fields(Found)]
    everything = Found(*(np.concatenate([getattr(p, n) for p in parts]) for n in names))
    for kind in (None, *range(len(KINDS))):
        some = np.ones(len(everything.error), bool) if kind is None else everything.kind == kind
        if not some.any():
            continue
        error, sure = everything.error[some], everything.confidence[some] > 0.5
        own = everything.own_angle[some]
        row = [
            name,
            "all" if kind is None else KINDS[kind],
            f"{100 * some.mean():.0f}",
            f"{100 * np.median(error):.2f} / {100 * error.mean():.2f}",
            f"{100 * (error < 0.02).mean():.0f} / {100 * (error < 0.05).mean():.0f}",
            f"{100 * everything.confidence[some].mean():.0f}",
            f"{100 * sure.mean():.0f}",
            f"{100 * (error[sure] < 0.02).mean():.0f}" if sure.any() else "-",
            f"{np.median(everything.angle[some]):.1f}",
            f"{np.nanmedian(own):.1f}" if np.isfinite(own).any() else "-",
            f"{seconds:.2f}" if kind is None else "",
        ]
        print("| " + " | ".join(row) + " |", flush=True)


def searched(
    engine: DepthEngine, keyframes: Sequence[Keyframe], index: int, checked: bool, render: Camera
) -> tuple[DenseDepth, float]:
    """The depth of a keyframe, if ``checked`` by its neighbours', and the seconds of its search."""
    chosen = neighbours_of(keyframes, index, render)

    def search(at: int) -> DenseDepth:
        some = [keyframes[j].view for j in neighbours_of(keyframes, at, render)]
        (dense,) = engine.estimate([DepthTask(keyframes[at].view, some)])
        return dense

    start = time.perf_counter()
    dense = search(index)
    _ = dense.typical  # waits for a GPU
    seconds = time.perf_counter() - start
    if checked:
        others = [PosedDepth(keyframes[j].view.T_cw, search(j)) for j in chosen]
        own = PosedDepth(keyframes[index].view.T_cw, dense)
        (dense,) = engine.check([own], [others])
    return dense, seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rooms", type=int, default=3)
    parser.add_argument("--keyframes", type=int, default=3, help="of each room")
    parser.add_argument("--first", type=int, default=100, help="seed of the first room")
    parser.add_argument("--width", type=int, default=320, help="of the images, pixels")
    parser.add_argument("--render", type=int, default=320, help="width of the depths, pixels")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--checked", action="store_true", help="let neighbours check the depths")
    parser.add_argument("--engines", default="classical,network,joint")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    working = centred_camera(arguments.width, arguments.width * 3 // 4)
    render = working.with_long_edge(min(arguments.render, arguments.width))
    engines = {
        name: depth_engine(arguments.device, render, working, DepthConfig(engine=name), 64)
        for name in arguments.engines.split(",")
    }
    print("| " + " | ".join(COLUMNS) + " |")
    print("|---" * len(COLUMNS) + "|")
    for bare in (False, True):
        found: dict[str, list[Found]] = {name: [] for name in engines}
        seconds: dict[str, list[float]] = {name: [] for name in engines}
        number = 1000 * bare
        for seed in range(arguments.first, arguments.first + arguments.rooms):
            scene = make_room(seed)
            path = HandheldPath(scene, seed).at_frames(np.arange(280))
            caster = Raycaster(flattened(scene, seed) if bare else scene, threads=worker_count())
            for n in range(arguments.keyframes):
                middle = 30 + n * 220 // arguments.keyframes
                frames = [middle + STEP * i for i in range(-AROUND, AROUND + 1)]
                keyframes = []
                for frame in frames:
                    keyframes.append(shoot(caster, path[frame], number, working, render))
                    number += 1
                for name, engine in engines.items():
                    dense, took = searched(engine, keyframes, AROUND, arguments.checked, render)
                    found[name].append(compare(keyframes[AROUND], dense, render))
                    seconds[name].append(took)
        for name in engines:
            title = f"{name}, plain room" if bare else name
            report(title, found[name], float(np.median(seconds[name])))


if __name__ == "__main__":
    main()
