"""Checkpoints that a stranger made up and signed again: refused in a sentence, or gone on with."""

import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from crafted_checkpoints import Crafted, crafted
from geogs.application.checkpoints.checkpoint import checkpoint_folder, write_checkpoint
from geogs.application.checkpoints.run_state import RunMetadata, RunState, SavedRun
from geogs.application.run_settings import RunSettings
from geogs.camera.shutter.rows import CELL
from geogs.config import InputConfig
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.io.sources.sniff import open_source
from geogs.priors.monocular_prior import DepthKind, PriorMaps
from geogs.slam import Slam
from geogs.types import MeasuredPose, SeenRows
from geogs.world.world import World
from quick_systems import quick_config

pytestmark = pytest.mark.system
SEEDS, EACH = range(4), 25
POSE, K = "world.keyframes.poses.T_cw.1", "world.keyframes.keyframes.1"


class FlatPrior:
    """Sees a wall in every image."""

    def predict(self, image: np.ndarray) -> PriorMaps:
        normal = torch.tensor([0.0, 0.0, -1.0]).expand(*image.shape[:2], 3)
        depth = torch.linspace(1, 2, image[..., 0].size).reshape(image.shape[:2])
        return PriorMaps(DepthKind.AFFINE_DEPTH, depth, normal)


@pytest.fixture(scope="module")
def frames(small_room):
    """The camera and some frames of a small room: with all that may be known beside the images,
    but for the depth of every second, of which a prior is asked."""
    source = open_source(small_room, InputConfig(stop=18, depth="sensor"))
    T_wc = torch.from_numpy(np.loadtxt(small_room / "traj.txt").reshape(-1, 4, 4))
    camera = source.camera
    size = [-(-n // CELL) + 2 for n in (camera.height, camera.width)]
    rows = SeenRows(torch.zeros(*size, 2).half(), torch.zeros(*size).half(), 0.1)
    known = [
        replace(f, depth=f.depth if f.index % 4 else None, rows=rows,
                pose=MeasuredPose(torch.linalg.inv(T_wc[f.index])))
        for f in source
    ]  # fmt: skip
    return camera, known


@pytest.fixture(scope="module")
def begun(frames, once) -> Path:
    """A run with keyframes, edges, a map and disks."""

    def run(folder: Path) -> None:
        camera, images = frames
        slam = system(camera)
        for frame in images:
            slam.process(frame)
        assert len(slam.executor.mapper.table.disks) > 0
        made = [slam.world.keyframes[i] for i in slam.segments.keyframe_ids]
        assert all(any(x is not None for x in what) for what in (
            [k.prior for k in made], [k.measured for k in made], [k.prior_normal for k in made]
        ))  # fmt: skip
        metadata = RunMetadata(RunSettings(), "cpu", "", None)
        write_checkpoint(checkpoint_folder(folder), RunState(metadata, slam.settled()))

    return once("crafted-begun", run)


def resumed(output: Path, frames) -> Slam:
    with SavedRun(output).world(torch.device("cpu")) as world:
        return system(frames[0], world)


def system(camera: Camera, world: World | None = None) -> Slam:
    config = replace(quick_config(pose_iterations=1), resident_keyframes=2)
    return Slam(camera, config, prior=FlatPrior(), world=world, device="cpu")


def array(name: str, value: float) -> Callable[[Any, dict[str, Tensor]], None]:
    def change(_: Any, tensors: dict[str, Tensor]) -> None:
        tensors[name].view(-1)[0] = value

    return change


def kind(name: str, dtype: torch.dtype) -> Callable[[Any, dict[str, Tensor]], None]:
    return lambda _, tensors: tensors.update({name: tensors[name].to(dtype)})


def segment(state: Any) -> Any:
    return state["world"]["segments"]["segments"][0]


def keyframe(state: Any) -> Any:
    return state["world"]["keyframes"]["keyframes"][1][1]


BAD = [math.nan, math.inf, -math.inf, 1e30, 0.0]
WRONG: dict[str, Callable[[Any, dict[str, Tensor]], object]] = {
    **{f"a pose with {x}": array(POSE, x) for x in BAD},
    **{f"a depth of {x}": array(f"{K}.inverse_depth", x) for x in (*BAD, -1.0)},
    **{f"information of {x}": array(f"{K}.information", x) for x in (math.nan, math.inf, -1.0)},
    **{f"a scale of {x}": lambda s, _, x=x: keyframe(s).update(scale=x) for x in (*BAD, "1")},
    "a disk nowhere": array("world.map.disks.parameters.position", math.nan),
    "a disk far off": array("world.map.disks.parameters.position", 1e30),
    "depths of another type": kind(f"{K}.inverse_depth", torch.float16),
    "poses of another type": kind(POSE, torch.float32),
    "disks of another type": kind("world.map.disks.parameters.position", torch.float64),
    "an edge to nobody": lambda s, _: segment(s)["edges"][0].__setitem__(0, [0, 999]),
    "an edge to itself": lambda s, _: segment(s)["edges"][0].__setitem__(0, [0, 0]),
    "an edge one way": lambda s, _: segment(s)["edges"].pop(0),
    "a frame of nobody": lambda s, _: segment(s)["frames"]["records"][3].update(anchor=999),
    "frames in no order": lambda s, _: segment(s)["frames"]["records"].reverse(),
    "a segment of nobody": lambda s, _: s["world"]["segments"].update(main=7),
    "an endless table": lambda s, _: keyframe(s).update(id=2**40),
    "keyframes to come": lambda s, _: s["world"]["keyframes"].update(next_id=1),
    "a keyframe to be mapped again": lambda s, _: segment(s)["final"].clear(),
    "keyframes mapped twice": lambda s, _: s["world"]["unmapped"].extend(
        s["world"]["map"]["mapped"]
    ),
    "final keyframes in no order": lambda s, _: segment(s)["final"].reverse(),
    "partners of nobody": lambda s, _: s["world"]["map"]["views"][0][1].update(partners=[999]),
}


@pytest.mark.parametrize("what", WRONG)
def test_what_cannot_be_is_refused_before_going_on(begun, frames, tmp_path, what):
    Crafted(what, WRONG[what]).write(begun, tmp_path)
    with pytest.raises(InputError) as caught:
        resumed(tmp_path, frames)
    assert str(caught.value).endswith("start anew without --resume.")
    assert "\n" not in str(caught.value)


def test_what_nobody_changed_goes_on(begun, frames, tmp_path):
    Crafted("nothing", lambda state, tensors: None).write(begun, tmp_path)
    assert resumed(tmp_path, frames).frames == len(frames[1])


@pytest.mark.long
@pytest.mark.parametrize("seed", SEEDS)
def test_whatever_is_changed_ends_in_a_sentence_or_in_poses(begun, frames, tmp_path, seed):
    """What is not refused at once is as good as what a run may have come to."""
    for number, change in enumerate(crafted(begun, seed, EACH)):
        output = tmp_path / str(number)
        change.write(begun, output)
        try:
            slam = resumed(output, frames)
        except InputError:
            continue
        finally:
            shutil.rmtree(output)
        slam.process(np.ascontiguousarray(frames[1][-1].image), slam.world.timestamp + 0.03)
        slam.end_stream()
        assert np.isfinite(slam.trajectory().T_wc).all(), change.what
