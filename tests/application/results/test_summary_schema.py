"""The published schema of summary.json, and what it is held to."""

import copy
import json
from pathlib import Path

import pytest

from json_schema import faults

SCHEMA = json.loads((Path(__file__).parents[3] / "docs" / "summary.schema.json").read_text())
RUN = {
    "source": "v.mp4", "kind": "video", "fingerprint": "0123456789abcdef", "frames": 120,
    "input": {"found": "v.mp4, 120 images", "used": ["camera: as given"], "left": []},
    "scale": "arbitrary (monocular)", "skipped_images": 0, "damaged_images": 1,
    "shutter": {"readout": 0.0276, "origin": "as given"},
    "verdict": {"is_reliable": True, "sentence": "Well.", "lost": 0.0, "orientation_only": 0.1,
                "position": 0.01, "rotation_deg": None, "depth": 0.02, "focal": 0.01,
                "focal_change": 0.0, "lens_change": 0.0, "joined": 1.0,
                "lens_varies": False},
    "metric_scale": {"origin": "a known distance", "factor": 1.2, "deviation": 0.01},
    "keyframes": 20, "lost_spans": [[0.5, 1.25]], "orientation_only_spans": [], "moving": 0.0,
    "segments": [{"first_time": 0.0, "last_time": 4.0, "keyframes": 20, "fate": "world"}],
    "not_started": None, "loops": 1, "loop_closures": 1, "disks": 20_000, "mesh_faces": 5,
    "seconds": {"tracking": 1.5, "total": 2.0},
    "frames_per_second": {"until_stream_end": 70.0, "with_final_stages": 60.0},
    "peak_memory_bytes": 10**9, "device": "cpu", "interrupted": False, "intrinsics": "as given",
    "seed": 0, "versions": {"geogs": "0.1.0", "torch": "2", "python": "3.11"},
}  # fmt: skip


def test_a_summary_is_as_the_schema_says():
    assert list(faults(RUN, SCHEMA)) == []


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("frames",), -1), (("frames",), 1.5), (("frames",), True), (("kind",), "film"),
        (("verdict", "lost"), 1.5), (("verdict", "position"), float("nan")),
        (("verdict", "depth"), float("inf")), (("lost_spans", 0), [1.0]),
        (("segments", 0, "fate"), None), (("seconds", "tracking"), "1"), (("seconds",), {}),
        (("metric_scale", "factor"), -1), (("fingerprint",), "x"), (("shutter", "readout"), 0.2),
        (("versions", "torch"), 2),
    ],
)  # fmt: skip
def test_what_is_wrong_is_found(path, value):
    changed = copy.deepcopy(RUN)
    inner = changed
    for name in path[:-1]:
        inner = inner[name]
    inner[path[-1]] = value
    assert len(list(faults(changed, SCHEMA))) == 1


@pytest.mark.parametrize("name", SCHEMA["required"])
def test_nothing_may_be_missing(name):
    missing = {k: v for k, v in RUN.items() if k != name}
    assert list(faults(missing, SCHEMA)) == [f"$ has no {name}"]


def test_words_that_are_not_looked_at_are_told():
    with pytest.raises(ValueError, match="anyOf"):
        list(faults(1, {"anyOf": []}))
