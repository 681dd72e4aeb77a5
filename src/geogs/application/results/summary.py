"""``summary.json``: statistics of a result."""

import math
import platform
from dataclasses import asdict
from typing import TYPE_CHECKING

import numpy as np
import torch

from geogs.application.machine.device import device_summary, peak_memory
from geogs.application.results.result import Result
from geogs.io.sources.frame_source import Source
from geogs.io.sources.posed.posed_source import PosedSource
from geogs.stopwatch import Stopwatch
from geogs.types import FrameState, Trajectory
from geogs.version import __version__

if TYPE_CHECKING:
    from geogs.application.results.mapped_scene import MappedScene


def summarise(result: Result) -> dict[str, object]:
    """Content of ``summary.json``."""
    scene = result.scene
    source = result.source
    mesh = result.mesh
    return {
        "source": source.name,
        "kind": source.kind,
        "fingerprint": source.fingerprint(),
        "frames": scene.frames,
        "input": {"found": source.found, **asdict(source.account)},
        **source_summary(source),
        "verdict": None if result.verdict is None else _finite(asdict(result.verdict)),
        "keyframes": len(result.keyframes.timestamps),
        "lost_spans": state_spans(result.trajectory, "lost"),
        "orientation_only_spans": state_spans(result.trajectory, "orientation only"),
        **statistics(scene),
        "disks": len(result.map),
        "mesh_faces": 0 if mesh is None else len(mesh.faces),
        **time_summary(scene.stopwatch, scene.frames),
        "peak_memory_bytes": peak_memory(),
        **device_summary(result.map.position.device),
        "interrupted": result.is_interrupted,
        "intrinsics": source.intrinsics_origin,
        "seed": scene.config.seed,
        "versions": {
            "geogs": __version__,
            "torch": torch.__version__,
            "python": platform.python_version(),
        },
    }


def statistics(scene: "MappedScene") -> dict[str, object]:
    """Statistics of the scene; where its lengths are metres, ``scale`` has their origin."""
    said = dict(scene.statistics())
    metric = said.get("metric_scale")
    if isinstance(metric, dict):
        said["scale"] = f"metric ({metric['origin']})"
    return said


def _finite(values: dict[str, object]) -> dict[str, object]:
    """The values with none instead of infinity and NaN, which JSON does not know."""
    return {
        k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in values.items()
    }


def source_summary(source: Source | PosedSource) -> dict[str, object]:
    """Unit of the map, and unused images."""
    if isinstance(source, PosedSource):
        held_out = {"held_out": source.held_out} if source.held_out else {}
        left_out = [{"image": name, "reason": why} for name, why in source.left_out]
        return {
            "scale": f"of the poses ({source.scene_scale})",
            "skipped_images": len(left_out),
            **({"pose_check": source.pose_error} if source.pose_error else {}),
            **({"left_out": left_out} if left_out else {}),
            **held_out,
        }
    live = {"dropped_frames": source.dropped} if source.is_live else {}
    videos = {"videos": [asdict(span) for span in source.spans]} if source.spans else {}
    return {
        "scale": "arbitrary (monocular)",
        "skipped_images": source.place.skipped,
        "damaged_images": source.place.damaged,
        "shutter": {"readout": source.shutter.readout, "origin": source.shutter.origin},
        **live,
        **videos,
    }


def time_summary(stopwatch: Stopwatch, frames: int) -> dict[str, object]:
    """Seconds of every stage, and frames/s.

    ``until_stream_end`` counts every stage up to the last frame: reading, tracking, loops, mapping,
    map updates, adjustments on the way, checkpoints. ``with_final_stages`` counts those after it,
    too: final adjustment and refinement, rendering, the mesh.
    """
    total = stopwatch.total
    rates = {"with_final_stages": round(frames / max(total, 1e-9), 3)}
    if stopwatch.until_stream_end is not None:
        online = round(frames / max(stopwatch.until_stream_end, 1e-9), 3)
        rates = {"until_stream_end": online, **rates}
    seconds = {name: round(s, 3) for name, s in stopwatch.seconds.items()}
    return {"seconds": {**seconds, "total": round(total, 3)}, "frames_per_second": rates}


def state_spans(trajectory: Trajectory, state: FrameState) -> list[list[float]]:
    """First and last time of each span of frames in a state."""
    inside = np.array([False, *(s == state for s in trajectory.states), False]).astype(int)
    first = np.flatnonzero(np.diff(inside) == 1)
    last = np.flatnonzero(np.diff(inside) == -1) - 1
    times = trajectory.timestamps
    return [[float(times[a]), float(times[b])] for a, b in zip(first, last, strict=True)]
