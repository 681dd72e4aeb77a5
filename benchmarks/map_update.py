"""Correct a map after a loop closure by every update rule, and measure the results.

    python benchmarks/map_update.py [--drift 0.05 0.1] [--scene across outward] [--mesh]

A path leads once around a synthetic room and a little more, so that the end sees the start: looking
*across* the room, where most is seen again and again, or *outward*, where nothing is until the end.
Keyframes have noisy depths and poses that drift like a monocular tracker's: lengths grow by the
drift over the lap, directions rotate by a tenth of a degree for every per cent of it, and every
step adds noise of 0.5 mm and 0.01 degrees. The map is built from them online. Loops between the two
visits of the start are closed by the pose graph, and each update moves a copy of the map. Ground
truth is only used to measure; *true drift* moves every disk by the true error of the keyframe that
made it, and *blended by true drift* blends these. Columns:

- Acc: mean distance of the disks (opacity at least a half) to the true surface after the similarity
  that aligns the corrected keyframes' positions with the true ones; cm.
- torn: |log(distance after / distance before)| between disks and their six nearest of other
  keyframes within eight keyframes, on one surface before, less the smooth stretch there (the linear
  map that best fits the motion of the 32 nearest disks); median and 95th percentile, per cent.
- double: fraction of disks that have, within 3 cm along the surface, one of another visit (20
  keyframes or more) 1.5 to 6 cm above or below with a similar normal; per cent.
- mesh Acc and Comp: of the fused renderings from all keyframes; cm.
- ms: time to plan the update.
"""

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from geogs.application.results.surfaces import fusion_views
from geogs.config import Config, MapAblation, MappingConfig
from geogs.evaluation.surfaces.reconstruction_errors import evaluate_reconstruction
from geogs.evaluation.surfaces.surface import Surface
from geogs.evaluation.surfaces.surface_distance import TriangleTree
from geogs.geometry.lie import quaternion_to_matrix, se3_exp, se3_inverse, sim3_exp, sim3_inverse
from geogs.geometry.neighbors import nearest_neighbors
from geogs.geometry.umeyama import umeyama
from geogs.loop.closure import ClosingQuestion, close_loops
from geogs.mapping.map_update import covisible_keyframe, plan_update
from geogs.mapping.mapper import Mapper
from geogs.mesh.extract import extract_mesh
from geogs.types import PoseCorrection
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeTable
from geogs.world.loops import RelativePoses
from geogs_synth.motion.handheld import FRAMES_PER_LAP, HandheldPath
from geogs_synth.places.room import make_room
from geogs_synth.raycast.raycaster import Raycaster
from geogs_synth.scene.textured_scene import scene_mesh
from geogs_synth.sequence.location import centred_camera
from geogs_synth.sequence.replica_files import SeenSurface

CAMERA = centred_camera(320, 240)
EVERY = 4
"""Frames from keyframe to keyframe."""
LAP = FRAMES_PER_LAP // EVERY
KEYFRAMES = LAP + 14
STEP_NOISE = torch.tensor([0.0005] * 3 + [np.radians(0.01)] * 3, dtype=torch.float64)
LOOP_NOISE = torch.tensor([0.005] * 3 + [0.002] * 3 + [0.003], dtype=torch.float64)
ODOMETRY = torch.tensor([0.002] * 3 + [0.0005] * 3 + [0.0008], dtype=torch.float64)
ROOM = {"across": 0, "outward": 3}
"""Seed of the room of each walk."""
MAPPING = replace(Config().mapping, render_long_edge=200)


@dataclass(frozen=True, eq=False)
class Observed:
    """A keyframe as a tracker estimates it."""

    image: np.ndarray
    T_cw: Tensor
    inverse_depth: Tensor
    information: Tensor


@dataclass(frozen=True, eq=False)
class Walk:
    """Keyframes of a room like a drifting tracker's, and the truth."""

    keyframes: list[Observed]
    truth: Tensor
    """(n, 4, 4) world to camera."""
    unit: Tensor
    """Drifted units per metre at each keyframe."""
    surface: Surface
    seen: Surface
    """Points that the keyframes saw."""

    @property
    def T_cw(self) -> Tensor:
        """The drifted poses."""
        return torch.stack([k.T_cw for k in self.keyframes])


def path(scene: str, room) -> np.ndarray:
    """Camera-to-world poses of the keyframes."""
    T = HandheldPath(room).at_frames(np.arange(0, EVERY * KEYFRAMES, EVERY))
    if scene == "across":
        return T
    # Outwards and ahead: no surface is seen again before the end of the lap.
    centre = T[:, :3, 3]
    ahead = np.roll(centre, -2, 0) - np.roll(centre, 2, 0)
    ahead[:2], ahead[-2:] = ahead[2], ahead[-3]
    out = centre - [*(room.size[:2] / 2), 0.0]
    z = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
    z = z + 0.7 * out / np.linalg.norm(out[:, :2], axis=1, keepdims=True)
    z[:, 2] = -0.25
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    turned = T.copy()
    turned[:, :3, :3] = np.stack([x, np.cross(z, x), z], -1)
    return turned


def walk(scene: str, drift: float, seed: int) -> Walk:
    """Walk around the room, with a drift of scale over the lap."""
    room = make_room(seed)
    caster = Raycaster(room, threads=1)
    poses = path(scene, room)
    truth = se3_inverse(torch.from_numpy(poses))
    share = torch.arange(KEYFRAMES, dtype=torch.float64) / LAP
    unit = (1 + drift) ** share
    T_cw = drifted(truth, unit, drift, seed)
    random = np.random.default_rng(seed)
    seen = SeenSurface(room, CAMERA)
    keyframes = []
    for n, T_wc in enumerate(poses):
        view = caster.render(CAMERA, T_wc)
        seen.add(view.depth, T_wc)
        z = view.depth[4 : CAMERA.height - 3 : 8, 4 : CAMERA.width - 3 : 8].astype(np.float64)
        # The noise of the tests' keyframes: most cells good to 2 %, a fifth nearly unknown.
        deviation = np.where(random.random(z.shape) < 0.2, 0.4, 0.02)
        noisy = float(unit[n]) * z * np.exp(deviation * random.standard_normal(z.shape))
        inverse, information = 1 / noisy, (noisy / deviation) ** 2
        keyframes.append(
            Observed(view.image, T_cw[n], torch.from_numpy(inverse), torch.from_numpy(information))
        )
    vertices, faces = scene_mesh(room)
    none = np.zeros((0, 3), np.int64)
    return Walk(
        keyframes,
        truth,
        unit,
        Surface(np.asarray(vertices, np.float64), np.asarray(faces, np.int64)),
        Surface(np.asarray(seen.points, np.float64), none),
    )


def drifted(truth: Tensor, unit: Tensor, drift: float, seed: int) -> Tensor:
    """Chain the true steps, each in its drifted unit and rotated a little."""
    g = torch.Generator().manual_seed(seed)
    noise = STEP_NOISE * torch.randn(len(truth), 6, generator=g, dtype=torch.float64)
    axis = torch.tensor([0.4, 0.8, -0.45], dtype=torch.float64)
    noise[:, 3:] += np.radians(10 * drift) / LAP * axis / axis.norm()
    T = [truth[0]]
    for k in range(1, len(truth)):
        step = truth[k] @ se3_inverse(truth[k - 1])
        step[:3, 3] *= unit[k]
        T.append(se3_exp(noise[k]) @ step @ T[-1])
    return torch.stack(T)


def close(walk: Walk) -> PoseCorrection:
    """Close the loop of the lap by the pose graph."""
    T = walk.T_cw
    n = torch.arange(KEYFRAMES - 1)
    i, j = torch.cat([n, n[:-1]]), torch.cat([n + 1, n[:-1] + 2])
    late = torch.arange(LAP, KEYFRAMES)
    first, second = late - LAP, late
    S = walk.truth.clone()
    S[:, :3] *= walk.unit[:, None, None]
    g = torch.Generator().manual_seed(9)
    error = sim3_exp(LOOP_NOISE * torch.randn(len(late), 7, generator=g, dtype=torch.float64))
    G = torch.cat([T[j] @ se3_inverse(T[i]), error @ S[second] @ sim3_inverse(S[first])])
    deviation = torch.cat([ODOMETRY.expand(len(i), 7), LOOP_NOISE.expand(len(late), 7)])
    relative = RelativePoses(
        torch.cat([i, first]),
        torch.cat([j, second]),
        G,
        1 / deviation.square(),
        torch.arange(len(G)) >= len(i),
    )
    closure = close_loops(ClosingQuestion(range(KEYFRAMES), T, relative))
    assert closure is not None, "no loop was believed"
    return closure.correction


def build(keyframes: Sequence[Observed], config: MappingConfig) -> Mapper:
    """Build the map like an online run."""
    segment = KeyframeTable.on(SampleGrid(CAMERA)).new_set()
    mapper = Mapper(segment.table, config)
    for n, seen in enumerate(keyframes):
        keyframe = segment.add(EVERY * n, EVERY * n / 30, seen.image, None, seen.T_cw)
        keyframe.inverse_depth = seen.inverse_depth.float().ravel()
        keyframe.information = seen.information.float().ravel()
        mapper.observe(n)
        if n >= config.lag:
            mapper.map_keyframe(n - config.lag)
    for n in range(len(keyframes) - config.lag, len(keyframes)):
        mapper.map_keyframe(n)
    return mapper


class Judge:
    """Measures maps against the truth."""

    def __init__(self, walk: Walk, before: Mapper, with_mesh: bool) -> None:
        self.walk, self.with_mesh = walk, with_mesh
        self.tree = TriangleTree(walk.surface)
        self.position = before.table.disks.position.detach().double()
        self.around = nearest_neighbors(self.position, self.position, 33)[1]
        self.pairs = neighbouring(before)

    def alignment(self, T_cw: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Similarity from the keyframes' world to the true one."""
        return umeyama(se3_inverse(T_cw)[:, :3, 3], se3_inverse(self.walk.truth)[:, :3, 3])

    def ate(self, T_cw: Tensor) -> float:
        """ATE of the keyframes, cm."""
        s, R, t = self.alignment(T_cw)
        left = s * se3_inverse(T_cw)[:, :3, 3] @ R.T + t - se3_inverse(self.walk.truth)[:, :3, 3]
        return 100 * float(left.square().sum(1).mean().sqrt())

    def row(self, name: str, mapper: Mapper, T_cw: Tensor, seconds: float) -> str:
        """Format a line of the table."""
        s, R, t = self.alignment(T_cw)
        solid = mapper.table.disks.opacity >= 0.5
        x = mapper.table.disks.position.detach().double()
        world = s * x @ R.T + t
        accuracy = 100 * self.tree(world[solid].numpy()).mean()
        cells = [name, f"{accuracy:.2f}", *self.tearing(mapper), f"{double(mapper, float(s)):.1f}"]
        if self.with_mesh:
            cells += self.mesh(mapper, (s, R, t))
        cells += [f"{len(x)}", f"{1e3 * seconds:.0f}"]
        return "| " + " | ".join(cells) + " |"

    def tearing(self, mapper: Mapper) -> tuple[str, str]:
        """Median and 95th percentile; empty if disks were dropped."""
        if len(mapper.table.disks) != len(self.position):
            return "", ""
        i, j = self.pairs
        x = mapper.table.disks.position.detach().double()
        before, after = self.position[j] - self.position[i], x[j] - x[i]
        smooth = (self.stretch(x)[i] @ before[:, :, None])[:, :, 0]
        torn = (after.norm(dim=1) / smooth.norm(dim=1)).log().abs()
        return f"{100 * torn.median():.2f}", f"{100 * torn.quantile(0.95):.2f}"

    def stretch(self, x: Tensor) -> Tensor:
        """The linear map around each disk that best fits the motion of its neighbours."""
        before, after = (p[self.around] - p[:, None] for p in (self.position, x))
        square = before.mT @ before
        ridge = 1e-3 * square.diagonal(dim1=1, dim2=2).sum(1)[:, None, None] * torch.eye(3)
        # The nearly undetermined direction off the surface gets the mean growth.
        growth = (after.square().sum((1, 2)) / before.square().sum((1, 2))).sqrt()
        right = before.mT @ (after - growth[:, None, None] * before)
        return torch.linalg.solve(square + ridge, right).mT + growth[:, None, None] * torch.eye(3)

    def mesh(self, mapper: Mapper, alignment: tuple[Tensor, Tensor, Tensor]) -> tuple[str, str]:
        """Acc and Comp of the fused renderings."""
        s, R, t = (a.numpy() for a in alignment)
        mesh = extract_mesh(fusion_views(mapper.renders()), replace(Config().mesh, colour=False))
        vertices = s * mesh.vertices.astype(np.float64) @ R.T + t
        scores = evaluate_reconstruction(
            Surface(vertices, mesh.faces), self.walk.surface, self.walk.seen, samples=50_000
        ).scores
        return f"{scores.accuracy_cm:.2f}", f"{scores.completeness_cm:.2f}"


def normals(mapper: Mapper) -> Tensor:
    """Normals of the disks."""
    return quaternion_to_matrix(mapper.table.disks.parameters.quaternion.detach().double())[:, :, 2]


def neighbouring(mapper: Mapper, reach: int = 8) -> tuple[Tensor, Tensor]:
    """Pairs of disks of different keyframes, near in time and on one surface."""
    x, n = mapper.table.disks.position.detach().double(), normals(mapper)
    anchor = mapper.table.disks.keyframe_id
    _, j = nearest_neighbors(x, x, 25)
    i = torch.arange(len(x))[:, None].expand_as(j)
    apart = (anchor[i] - anchor[j]).abs()
    offset, distance = x[j] - x[i], (x[j] - x[i]).norm(dim=2)
    level = (offset * n[i]).sum(2).abs() < 0.3 * distance
    good = (apart > 0) & (apart <= reach) & level & ((n[i] * n[j]).sum(2) > 0.9)
    good &= distance > 1e-3
    good &= good.cumsum(1) <= 6
    return i[good], j[good]


def double(mapper: Mapper, metre: float, apart: int = 20) -> float:
    """Per cent of the disks above or below the surface of another visit."""
    solid = mapper.table.disks.opacity >= 0.5
    x = metre * mapper.table.disks.position.detach().double()[solid]
    n, anchor = normals(mapper)[solid], mapper.table.disks.keyframe_id[solid]
    _, j = nearest_neighbors(x, x, 48)
    offset = x[j] - x[:, None]
    height = (offset * n[:, None]).sum(2).abs()
    along = (offset.square().sum(2) - height.square()).clamp(min=0).sqrt()
    layer = (height > 0.015) & (height < 0.06) & (along < 0.03)
    layer &= (anchor[:, None] - anchor[j]).abs() >= apart
    layer &= (n[:, None] * n[j]).sum(2).abs() > 0.8
    return 100 * float(layer.any(1).double().mean())


def true_drift(walk: Walk) -> PoseCorrection:
    """Correction by the true errors of the keyframes."""
    ids = range(len(walk.keyframes))
    return PoseCorrection(
        dict(zip(ids, walk.T_cw, strict=True)),
        dict(zip(ids, walk.truth, strict=True)),
        dict(zip(ids, walk.unit.tolist(), strict=True)),
    )


def compare(scene: str, drift: float, with_mesh: bool) -> None:
    """Print the table of one walk."""
    there = walk(scene, drift, ROOM[scene])
    mapper = build(there.keyframes, MAPPING)
    correction = close(there)
    judge = Judge(there, mapper, with_mesh)
    corrected = torch.stack([correction.after[k] for k in range(KEYFRAMES)])
    print(
        f"\n{scene}, drift {100 * drift:.0f} %: {KEYFRAMES} keyframes, "
        f"ATE {judge.ate(there.T_cw):.2f} cm, after the closure {judge.ate(corrected):.2f} cm\n"
    )
    columns = ["", "Acc", "torn", "95 %", "double", *(["mesh Acc", "Comp"] if with_mesh else [])]
    columns += ["disks", "ms"]
    print("| " + " | ".join(columns) + " |\n|---" + "|---:" * (len(columns) - 1) + "|")
    print(judge.row("before", mapper, there.T_cw, 0.0), flush=True)
    ways = [
        ("true drift", "per_keyframe", true_drift(there)),
        ("blended by true drift", "blended", true_drift(there)),
        ("per_keyframe", "per_keyframe", correction),
        ("coherent", "coherent", correction),
        ("blended", "blended", correction),
    ]
    for name, strategy, c in ways:
        moved = build(there.keyframes, MAPPING)
        moved.config = replace(MAPPING, ablation=MapAblation(map_update=strategy))
        moved.keyframes.set_of[0].correct(c)
        seconds = planning_time(moved, c)
        moved.correct(c)
        T_cw = torch.stack([c.after[k] for k in range(KEYFRAMES)])
        print(judge.row(name, moved, T_cw, seconds), flush=True)
    moved.growth.prune([moved.views[k] for k in moved.table.mapped])
    print(judge.row("blended, then pruned", moved, T_cw, seconds), flush=True)


def planning_time(mapper: Mapper, correction: PoseCorrection) -> float:
    """Seconds of planning alone, the least of two."""

    def plan() -> torch.Tensor:
        seen = [covisible_keyframe(v, correction) for v in mapper.views.values() if v.has_depth]
        disks = mapper.table.disks
        strategy = mapper.config.ablation.map_update
        return plan_update(disks.position, disks.keyframe_id, correction, strategy, seen)

    times = []
    for _ in range(2):
        start = time.perf_counter()
        plan()
        times.append(time.perf_counter() - start)
    return min(times)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", nargs="+", default=list(ROOM), choices=list(ROOM))
    parser.add_argument("--drift", nargs="+", type=float, default=[0.05, 0.1])
    parser.add_argument("--mesh", action="store_true")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    for scene in arguments.scene:
        for drift in arguments.drift:
            compare(scene, drift, arguments.mesh)


if __name__ == "__main__":
    main()
