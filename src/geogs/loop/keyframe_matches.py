"""Matches between all keyframes of a tracker: measurement, correction and adjustment."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from jaxtyping import Float
from torch import Tensor

from geogs.bundle.protocols import BundleOptions
from geogs.geometry.camera import Camera
from geogs.stopwatch import StageProgress, unwatched
from geogs.tracking.frames.row_errors import in_parts
from geogs.tracking.graph.frame_graph import HUBER, FrameGraph
from geogs.tracking.graph.proximity import RADIUS, proximity_pairs
from geogs.tracking.tracker import Tracker
from geogs.world.edges import PackedEdge, Pair
from geogs.world.frames import FrameLog
from geogs.world.keyframes import KeyframeSet

STAGE = "bundle adjustment"
"""Name of the stage in progress reports."""
ROUNDS = 4
"""Most rounds of flow and adjustment: each improves the next, later ones by little."""
REMEASURE = 0.25
"""Change of its reprojection, in pixels, after which a pair is matched again."""
MAX_DISTANCE = 0.5
"""Largest frame distance of a pair, as a fraction of the long edge."""
SUPPRESSION = 3
"""Distance in keyframes from a chosen pair within which others are left out as redundant."""
PAIRS = 10
"""Most pairs per keyframe: time against precision."""
MATCHED_TOGETHER = 16, 48
"""Pairs matched at a time, on the CPU and on a GPU."""
CONVERGED = 0.02
"""Fraction of pairs whose reprojection still moves, below which the rounds end."""
GLOBAL_OPTIONS = BundleOptions(
    iterations=10, huber=HUBER, damping=1e-6, least_damping=1e-8, depth_damping=1e-5, tolerance=1e-5
)
"""Solver options of a round; it ends with a step that changes poses by less than the tolerance, in
units and radians. A drift of scale along many keyframes has a curvature far below 1e-4 of the
diagonal, the smaller the more they are, and changes all depths: with the usual damping of either
the steps end long before it is corrected (docs/adjustment.md)."""

Measured = Mapping[Pair, PackedEdge]
Shifts = Callable[[list[Pair]], Float[Tensor, "e p 2"]]
"""Returns the correction, in pixels, of the matches of some edges, by present poses and depths."""


@dataclass(frozen=True)
class KeyframeMatches:
    """Matches between the keyframes of a tracker, and the free unknowns of their adjustment."""

    tracker: Tracker
    free_pose: Sequence[int]
    free_depth: Sequence[int]
    pairs: Sequence[Pair] = ()
    """Matched pairs."""
    progress: StageProgress = unwatched
    options: BundleOptions = GLOBAL_OPTIONS
    measured: dict[Pair, PackedEdge] = field(default_factory=dict)
    """Edges as measured; the graph has the corrected ones."""
    corrections: dict[str, Shifts] = field(default_factory=dict)
    """Corrections added to all matches before each adjustment, by name."""

    def __post_init__(self) -> None:
        self.measured.update(self.graph.packed)

    @staticmethod
    def of(tracker: Tracker, progress: StageProgress = unwatched) -> "KeyframeMatches":
        """Return those of all keyframes. The first pose is fixed or, in the world of a saved map,
        all its keyframes."""
        segment = tracker.segment
        free_pose = segment.free if segment.fixed else segment.ids[1:]
        return KeyframeMatches(
            tracker, free_pose, segment.free, global_pairs(tracker), progress, GLOBAL_OPTIONS
        )

    @property
    def camera(self) -> Camera:
        """Camera of the matches."""
        return self.keyframes.grid.camera

    @property
    def keyframes(self) -> KeyframeSet:
        """Keyframes of the tracker."""
        return self.tracker.keyframes

    @property
    def graph(self) -> FrameGraph:
        """Frame graph of the edges."""
        return self.tracker.map.graph

    @property
    def log(self) -> FrameLog:
        """Frames between the keyframes."""
        return self.tracker.map.recorder.log

    def measure(self, fine: bool, anew: bool = True) -> None:
        """Measure all pairs and adjust everything; in further rounds measure those that have moved.

        At full resolution if ``fine``, else at half of it; small images always at full. If not
        ``anew``, pairs that have not moved since they were measured are kept.
        """
        graph = self.graph
        odometry = self.tracker.map.odometry
        batch = MATCHED_TOGETHER[self.keyframes.grid.on_gpu]
        if anew:
            graph.edges.clear()
            self.measured.clear()
        for n in range(ROUNDS if self.pairs else 0):
            # Pairs are sorted by keyframe: images of old ones are read from a file.
            stale = sorted(graph.stale(self.pairs, REMEASURE))
            if len(stale) <= CONVERGED * len(self.pairs):
                break
            for start in range(0, len(stale), batch):
                graph.measure(stale[start : start + batch], fine=fine, packed=True)
                self.progress(STAGE, (n + start / len(stale)) / ROUNDS)
            both = {*stale, *((j, i) for i, j in stale)}
            self.measured.update({e: v for e, v in graph.packed.items() if e in both})
            self.adjust()
            graph.update_dynamic(set(self.free_depth), self.tracker.config.moving)
            odometry.update_scale_by_all()

    def adjust(self, most: int | None = None) -> None:
        """Solve for the free poses and depths, by at most ``most`` steps, with the present
        corrections of all matches."""
        if self.corrections:
            self.graph.edges.update(self.corrected())
        steps = min(self.options.iterations, most or self.options.iterations)
        options = replace(self.options, iterations=steps)
        self.graph.adjust(list(self.graph.edges), self.free_pose, self.free_depth, options)

    def corrected(self, but: str = "") -> Measured:
        """Return the edges with all corrections, or all but one."""
        grid = self.keyframes.grid
        shifts = [s for n, s in self.corrections.items() if n != but]
        found = dict(self.measured)
        for part in in_parts(sorted(found) if shifts else [], grid.on_gpu):
            total = sum((each(part) for each in shifts[1:]), shifts[0](part))
            for pair, shift in zip(part, total, strict=True):
                found[pair] = found[pair].moved(grid.camera, shift)
        return found


def global_pairs(tracker: Tracker) -> list[Pair]:
    """Return pairs of neighbours in time and of revisits, thinned; not within a saved map."""
    grid = tracker.keyframes.grid
    ids = tracker.segment.ids
    pairs = proximity_pairs(
        tracker.keyframes,
        ids,
        ids,
        [],
        RADIUS,
        SUPPRESSION,
        MAX_DISTANCE * grid.camera.long_edge,
        PAIRS * len(ids),
    )
    wanted = set(ids)
    fixed = set(tracker.segment.fixed)
    return [p for p in pairs if wanted.issuperset(p) and not fixed.issuperset(p)]
