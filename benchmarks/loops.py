"""Find loops in folders with known poses and print precision, recall and cost.

    python benchmarks/loops.py FOLDER[:POINTS.ply] ... [--every 5] [--long-edge 512] [--drift 1]

Each FOLDER is in Replica or 7-Scenes layout. POINTS.ply holds points of the visible
surface; without it, points_seen_1cm.ply or tsdf_pseudo_gt.ply of the folder is used. No tracker
runs: keyframes are every n-th frame with depth from the points (3 % smooth error) and true poses
with a drift (a random walk of 0.3 degrees, 4 mm and 1 % scale per keyframe, times --drift). Ground
truth determines which pairs show the same surface (at least 30 % of both images) and whether a
relative pose is right (5 degrees, 10 % of the median depth: all loops of 7-Scenes differ from its
poses alike, by 2 to 3 degrees and 6 to 10 cm).
"""

import argparse
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from geogs.bundle.device_choice import grid_fields
from geogs.config import InputConfig, LoopConfig
from geogs.evaluation.surfaces.surface import read_surface
from geogs.geometry.lie import se3_exp, se3_inverse, so3_log
from geogs.loop.dense_check import dense_check
from geogs.loop.detect import LoopDetector
from geogs.loop.orb_features import orb_features
from geogs.loop.retrieval import AppearanceIndex
from geogs.loop.verification import FeatureView, TwoViewVerifier
from geogs.tracking.flow.classical_flow import ClassicalFlow
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeSet, KeyframeTable
from geogs.world.loops import ImageFeatures
from sequences import load

OVERLAP, DEGREES, SHARE_OF_DEPTH = 0.3, 5.0, 0.1
SIMILAR = 30.0
"""Largest angle between similar directions, degrees."""


@dataclass
class Clock:
    """CPU time per named step in milliseconds."""

    spent: dict[str, list[float]] = field(default_factory=dict)

    def __call__(self, name: str, work: Callable[[], Any]) -> Any:
        """Do the work and store its time."""
        start = time.process_time()
        out = work()
        self.spent.setdefault(name, []).append(1e3 * (time.process_time() - start))
        return out

    def report(self) -> str:
        """Text of the mean time per call."""
        return ", ".join(f"{k} {np.mean(v):.1f}" for k, v in self.spent.items())


@dataclass(frozen=True)
class Truth:
    """Ground truth of the keyframes."""

    T_cw: torch.Tensor
    depth: torch.Tensor
    """(n, p) on the grid, metres; inf where empty."""
    overlap: np.ndarray
    """(n, n) fraction of the cells of both images that show the same surface."""
    scale: np.ndarray
    """Drifted units per metre at each keyframe."""

    def turn(self, first: int, second: int) -> float:
        """Angle between two orientations, degrees."""
        R = self.T_cw[second][:3, :3] @ self.T_cw[first][:3, :3].mT
        return float(torch.rad2deg(so3_log(R).norm()))

    def right(self, first: int, second: int, T_ji: torch.Tensor) -> bool:
        """Whether a relative pose, in the drifted unit of the first, is right."""
        true = self.T_cw[second] @ se3_inverse(self.T_cw[first])
        turn = float(torch.rad2deg(so3_log(T_ji[:3, :3] @ true[:3, :3].mT).norm()))
        shift = float((T_ji[:3, 3] / self.scale[first] - true[:3, 3]).norm())
        middle = float(self.depth[first][self.depth[first].isfinite()].median())
        return turn < DEGREES and shift < SHARE_OF_DEPTH * middle


def depths(points: np.ndarray, T_wc: np.ndarray, grid: SampleGrid) -> np.ndarray:
    """Nearest point in every cell from each pose."""
    out = np.full((len(T_wc), grid.size), np.inf)
    cam = grid.camera
    for T, depth in zip(T_wc, out, strict=True):
        p = (points - T[:3, 3]) @ T[:3, :3]
        p = p[p[:, 2] > 0.05]
        pixels = [cam.fx, cam.fy] * p[:, :2] / p[:, 2:] + [cam.cx, cam.cy]
        cell, inside = grid.cells_of(torch.from_numpy(pixels))
        np.minimum.at(depth, cell[inside].numpy(), p[inside.numpy(), 2])
    return out


def overlaps(depth: np.ndarray, T_wc: np.ndarray, grid: SampleGrid) -> np.ndarray:
    """Fraction of the cells of both images that show the same surface, for all pairs."""
    n, cam, rays = len(depth), grid.camera, grid.rays.double().numpy()
    seen = np.zeros((n, n))
    for i in range(n):
        good = np.isfinite(depth[i])
        world = (rays[good] * depth[i][good, None]) @ T_wc[i, :3, :3].T + T_wc[i, :3, 3]
        for j in range(n):
            p = (world - T_wc[j, :3, 3]) @ T_wc[j, :3, :3]
            z = np.maximum(p[:, 2], 1e-6)
            pixels = [cam.fx, cam.fy] * p[:, :2] / z[:, None] + [cam.cx, cam.cy]
            cell, inside = grid.cells_of(torch.from_numpy(pixels))
            same = np.abs(depth[j][cell.numpy()] - p[:, 2]) < 0.06 * p[:, 2] + 0.03
            seen[i, j] = (inside.numpy() & (p[:, 2] > 0.05) & same).sum() / grid.size
    return np.minimum(seen, seen.T)


def prepare(
    folder: Path, points: Path, every: int, long_edge: int, drift: float
) -> tuple[KeyframeSet, ClassicalFlow, Truth]:
    """Keyframes like a drifting tracker's, and the truth about them."""
    sequence = load(folder, InputConfig(long_edge=long_edge, stride=every))
    grid = SampleGrid(sequence.camera)
    depth = depths(read_surface(points).vertices, sequence.T_wc, grid)
    T_cw = se3_inverse(torch.from_numpy(sequence.T_wc))
    rng = np.random.default_rng(0)
    scale = np.exp(np.cumsum(drift * 0.01 * rng.standard_normal(len(depth))))
    store, operator = KeyframeTable.on(grid).new_set(), ClassicalFlow(grid)
    T, fields = T_cw[0], grid_fields(grid)
    for n, frame in enumerate(sequence.frames):
        if n:
            step = T_cw[n] @ se3_inverse(T_cw[n - 1])
            step[:3, 3] *= scale[n]
            noise = rng.standard_normal(6) * ([0.004] * 3 + [np.radians(0.3)] * 3)
            T = se3_exp(torch.from_numpy(drift * noise)) @ step @ T
        state = store.add(n * every, n / 30, frame.image, operator.encode(frame.image), T)
        coarse = rng.standard_normal((5, 8)).astype(np.float32)
        smooth = cv2.resize(coarse, (grid.width, grid.height), interpolation=cv2.INTER_CUBIC)
        z = torch.from_numpy(depth[n] * scale[n] * np.exp(0.03 * smooth.reshape(-1))).float()
        state.information = z.isfinite().float()
        state.inverse_depth = fields.fill(torch.where(z.isfinite(), 1 / z, 0.0), state.information)
    overlap = overlaps(depth, sequence.T_wc, grid)
    return store, operator, Truth(T_cw, torch.from_numpy(depth), overlap, scale)


class Checks:
    """The checks of candidate loops one by one: pairs that each accepts, and their correctness."""

    def __init__(self, store: KeyframeSet, operator: ClassicalFlow, truth: Truth) -> None:
        self.store, self.operator, self.truth = store, operator, truth
        self.clock = Clock()
        self.features: dict[int, ImageFeatures] = {}
        self.accepted: Counter[str] = Counter()
        self.right: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()
        self.flow: list[tuple[float, ...]] = []
        """Correctness, matched fraction, residual and contradiction of each pair with flow."""
        self.scale_errors: list[float] = []
        self._verifier = TwoViewVerifier(store.grid.camera)

    def closed(self, i: int, k: int) -> set[str]:
        """Check a pair; return the checks that rightly accept it."""
        store, truth = self.store, self.truth
        found = set[str]()

        def count(name: str, is_right: bool) -> None:
            self.accepted[name] += 1
            self.right[name] += is_right
            found.update([name] if is_right else [])

        bare = [FeatureView(self.features[n]) for n in (i, k)]
        plain = self.clock("essential", lambda: self._verifier.verify(*bare))
        if plain.accepted:
            true = truth.T_cw[k] @ se3_inverse(truth.T_cw[i])
            turn = torch.rad2deg(so3_log(plain.T_ji[:3, :3] @ true[:3, :3].mT).norm())
            count("essential", bool(turn < DEGREES))
        known = ((store[n].inverse_depth, store[n].information, self.features[n]) for n in (i, k))
        views = [FeatureView.of(store.grid, *parts) for parts in known]
        view = self.clock("pnp", lambda: self._verifier.verify(*views))
        if not view.accepted:
            self.refused[" ".join(w for w in view.reason.split() if not w[0].isdigit())] += 1
            return found
        is_right = truth.right(i, k, view.T_ji)
        count("pnp", is_right)
        scale = view.scale or 1.0
        if is_right and view.scale:
            self.scale_errors.append(abs(np.log(scale * truth.scale[i] / truth.scale[k])))
        pair = store[i], store[k]
        check = self.clock(
            "flow", lambda: dense_check(store.grid, self.operator, *pair, view.T_ji, scale)
        )
        if check.T_ji is not None:
            is_right = truth.right(i, k, check.T_ji)
            self.flow.append((is_right, check.matched, check.residual, check.contradiction))
            if check.accepted:
                count("pnp + flow", is_right)
        return found


def separate(store: KeyframeSet, operator: ClassicalFlow, truth: Truth, gap: int) -> None:
    """Test the retrieval, then the verification of all its results, with and without depth."""
    checks, index = Checks(store, operator, truth), AppearanceIndex()
    clock, features = checks.clock, checks.features
    precision, recall, first = [], [], []
    closed: Counter[str] = Counter()
    closed_alike: Counter[str] = Counter()
    alike = 0
    for k in store.ids:
        features[k] = clock("extract", lambda k=k: orb_features(store[k].image))
        old = [i for i in store.ids if i < k - gap]
        exclude = set(store.ids) - set(old)
        found = clock("query", lambda k=k, e=exclude: index.query(features[k], e))
        clock("add", lambda k=k: index.add(k, features[k]))
        closing = set().union(*(checks.closed(c.keyframe, k) for c in found))
        wanted = [i for i in old if truth.overlap[i, k] > OVERLAP]
        if not wanted:
            continue
        similar = any(truth.turn(i, k) < SIMILAR for i in wanted)
        alike += similar
        hits = [c.keyframe in wanted for c in found]
        precision.append(np.mean(hits) if hits else 0.0)
        recall.append(any(hits))
        first.append(bool(hits) and hits[0])
        closed.update(closing)
        closed_alike.update(closing if similar else ())
    queries = len(recall)
    print(
        f"  retrieval: {queries} keyframes see an old place; precision@5 {np.mean(precision):.2f}, "
        f"recall@5 {np.mean(recall):.2f}, first right {np.mean(first):.2f}"
    )
    for name in ("essential", "pnp", "pnp + flow"):
        accepted, right = checks.accepted[name], checks.right[name]
        print(
            f"  {name}: {accepted} accepted, precision {right / max(accepted, 1):.3f}, "
            f"recall {closed[name] / max(queries, 1):.2f} of these keyframes, "
            f"{closed_alike[name] / max(alike, 1):.2f} of the {alike} that see it from a similar "
            "direction"
        )
    print(f"  refused: {dict(checks.refused.most_common())}")
    for is_right in (True, False):
        rows = np.array([values for ok, *values in checks.flow if ok == is_right])
        if len(rows):
            low, middle, high = np.percentile(rows, [5, 50, 95], axis=0).round(2).tolist()
            print(
                f"  flow (matched, residual, contradiction) {'right' if is_right else 'wrong'}: "
                f"{len(rows)}, 5 % {low}, 50 % {middle}, 95 % {high}"
            )
    print(f"  scale by features: median error {100 * np.median(checks.scale_errors):.1f} %")
    print(f"  CPU ms: {clock.report()}")


def together(store: KeyframeSet, operator: ClassicalFlow, truth: Truth, gap: int) -> None:
    """Test the detector as the system runs it."""
    detector, clock = (LoopDetector(store.table, operator, LoopConfig(min_gap=gap)), Clock())
    for k in store.ids:
        clock("update", lambda k=k: detector.update([k], is_last=True))
    right = [truth.right(o.first, o.second, o.T_ji) for o in detector.table.loops]
    closed = {o.second for o, ok in zip(detector.table.loops, right, strict=True) if ok}
    can = {k for k in store.ids for i in store.ids if i < k - gap and truth.overlap[i, k] > OVERLAP}
    looks = sum(o.cause == "appearance" for o in detector.table.loops)
    print(
        f"  detector: {len(right)} loops ({looks} by looks), precision "
        f"{np.mean(right) if right else 1.0:.3f}, {len(closed & can)} of {len(can)} keyframes that "
        f"could close one did; CPU ms per keyframe {clock.report()}, "
        f"worst {max(clock.spent['update']):.0f}"
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", nargs="+", metavar="FOLDER[:POINTS.ply]")
    parser.add_argument("--every", type=int, default=5)
    parser.add_argument("--long-edge", type=int, default=512)
    parser.add_argument("--gap", type=int, default=15, help="keyframes between the two views")
    parser.add_argument("--drift", type=float, default=1.0)
    args = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    for argument in args.folders:
        folder, _, points = argument.partition(":")
        usual = [Path(folder) / n for n in ("points_seen_1cm.ply", "tsdf_pseudo_gt.ply")]
        cloud = Path(points) if points else next(p for p in usual if p.exists())
        keyframes = prepare(Path(folder), cloud, args.every, args.long_edge, args.drift)
        print(f"{Path(folder).name}: {len(keyframes[0])} keyframes", flush=True)
        separate(*keyframes, args.gap)
        together(*keyframes, args.gap)


if __name__ == "__main__":
    main()
