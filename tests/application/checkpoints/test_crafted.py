"""Checkpoints that a stranger made up and signed again: refused in a sentence, or gone on with."""

import math
import shutil
from collections.abc import Callable
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
from geogs.config import InputConfig
from geogs.errors import InputError
from geogs.io.sources.sniff import open_source
from geogs.slam import Slam
from quick_systems import quick_config

pytestmark = pytest.mark.system
SEEDS, EACH = range(4), 25
POSE, K = "world.keyframes.poses.T_cw.1", "world.keyframes.keyframes.1"


@pytest.fixture(scope="module")
def frames(small_room):
    """The camera and some frames of a small room."""
    source = open_source(small_room, InputConfig(stop=18))
    return source.camera, list(source)


@pytest.fixture(scope="module")
def begun(frames, once) -> Path:
    """A run with keyframes, edges, a map and disks."""

    def run(folder: Path) -> None:
        camera, images = frames
        slam = Slam(camera, quick_config(pose_iterations=1))
        for frame in images:
            slam.process(frame)
        assert len(slam.executor.mapper.table.disks) > 0
        metadata = RunMetadata(RunSettings(), "cpu", "", None)
        write_checkpoint(checkpoint_folder(folder), RunState(metadata, slam.settled()))

    return once("crafted-begun", run)


def resumed(output: Path, frames) -> Slam:
    with SavedRun(output).world(torch.device("cpu")) as world:
        return Slam(frames[0], quick_config(pose_iterations=1), world=world)


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
