"""A map that is made at the end, instead of on the way."""

from dataclasses import replace
from operator import attrgetter
from pathlib import Path

import numpy as np
import pytest
import torch

from geogs.application.checkpoints.checkpoint import SavedState, checkpoint_folder, write_checkpoint
from geogs.config import Config, InputConfig, preset
from geogs.config.idle import ON_THE_WAY
from geogs.io.sources.sniff import open_source
from geogs.slam import Slam
from quick_systems import Work, quick_config

pytestmark = pytest.mark.system

FRAMES, AT = 20, 15


class Interrupted(Exception):
    """Somebody does not want to wait."""


def quick() -> Config:
    return quick_config(pose_iterations=0, final_iterations=15)


@pytest.fixture(scope="module")
def frames(small_room):
    """The camera and the frames of a small room."""
    source = open_source(small_room, InputConfig(stop=FRAMES))
    return source.camera, list(source)


def followed(frames, defers_map: bool, count: int = FRAMES, config: Config | None = None) -> Slam:
    """A system that has seen so many frames."""
    camera, images = frames
    slam = Slam(camera, config or quick(), defers_map=defers_map, device="cpu")
    for frame in images[:count]:
        slam.process(frame)
    return slam


@pytest.fixture(scope="module")
def both(frames):
    """A finished system with a map that grew on the way, and one with a map of the end."""
    online, after = followed(frames, False), followed(frames, True)
    assert online.executor.mapper.table.mapped
    assert not after.executor.mapper.table.mapped
    for slam in (online, after):
        slam.finish()
    return online, after


def test_poses_are_the_same_and_the_surface_nearly(both):
    online, after = both
    assert np.array_equal(online.trajectory().T_wc, after.trajectory().T_wc)
    every, mapped = (slam.executor.mapper.table.mapped for slam in both)
    assert set(mapped) <= set(every)
    # The camera of this room moves slowly: one keyframe or another sees nothing from elsewhere.
    assert 0.7 * len(every) < len(mapped) < len(every)
    assert after.world.is_refined
    of_all = dict(zip(every, online.renders(), strict=True))
    for id, b in zip(mapped, after.renders(), strict=True):
        a = of_all[id]
        seen = (a.depth > 0) & (b.depth > 0)
        assert seen.float().mean() > 0.9 * (a.depth > 0).float().mean()
        assert float(((a.depth - b.depth).abs() / a.depth)[seen].median()) < 0.01


def test_what_is_said_to_act_on_the_way_only_changes_no_bit(frames, both):
    """All settings that ``idle_settings`` names; and a number of steps, which it does not."""
    config = quick()
    mapping = replace(
        config.mapping,
        lag=1,
        window=3,
        views_per_step=0,
        final_depth=not config.mapping.final_depth,
        pose_iterations=3,
        pose_every=1,
        pose_lr=1e-3,
        ablation=replace(config.mapping.ablation, map_update="coherent"),
    )
    assert all(attrgetter(name)(mapping) != attrgetter(name)(config.mapping) for name in ON_THE_WAY)
    more = replace(config.mapping, iterations=config.mapping.final_iterations)
    after = both[1]
    for other, is_same in ((mapping, True), (more, False)):
        slam = followed(frames, True, config=replace(config, mapping=other))
        slam.finish()
        assert np.array_equal(slam.trajectory().T_wc, after.trajectory().T_wc)
        own, usual = slam.snapshot(), after.snapshot()
        assert torch.equal(own.position, usual.position) == is_same


def test_there_is_no_online_result(both):
    online, after = both
    assert online.stopwatch.until_stream_end is not None
    assert after.stopwatch.until_stream_end is None
    assert "mapping" not in after.stopwatch.seconds


@pytest.mark.parametrize("seen", [pytest.param(AT, marks=pytest.mark.long), FRAMES])
def test_a_system_goes_on_from_a_checkpoint(frames, both, tmp_path: Path, seen: int):
    slam = followed(frames, True, seen)
    if seen == FRAMES:
        slam.end_stream()
    write_checkpoint(checkpoint_folder(tmp_path), Work(slam.settled()))
    world = SavedState(tmp_path, Work).work("world")
    other = Slam(slam.camera, slam.config, world=world, device="cpu")
    for frame in frames[1][seen:]:
        other.process(frame)
    other.end_stream()
    other.finish()
    after = both[1]
    assert np.array_equal(other.trajectory().T_wc, after.trajectory().T_wc)
    for p, q in zip(
        other.executor.mapper.table.disks.parameters,
        after.executor.mapper.table.disks.parameters,
        strict=True,
    ):
        assert torch.equal(p, q)


def test_a_map_is_made_briefly_after_an_interruption(frames):
    slam = followed(frames, True)
    slam.finish(correct=False)

    def interrupt(stage: str, fraction: float) -> None:
        raise Interrupted

    with pytest.raises(Interrupted):  # while depths are searched
        slam.refine(interrupt)
    assert len(slam.world.map.disks) == 0
    slam.refine(seconds=0.0)
    mapped, disks = list(slam.world.map.mapped), len(slam.world.map.disks)
    assert mapped
    assert disks > 200
    assert len(slam.renders()) == len(mapped)
    taken = dict(slam.stopwatch.seconds)
    slam.refine(seconds=100.0)  # there is one now
    assert (slam.world.map.mapped, len(slam.world.map.disks)) == (mapped, disks)
    assert slam.stopwatch.seconds == taken
    assert not slam.world.is_refined


@pytest.mark.parametrize("distance", [0.0, 0.009])
def test_keyframes_that_nothing_removes_are_mapped_as_soon_as_they_exist(frames, distance):
    config = quick()
    tracking = replace(config.tracking, keyframe_distance=distance)
    mapping = replace(config.mapping, lag=0, iterations=0)
    slam = Slam(frames[0], replace(config, tracking=tracking, mapping=mapping), device="cpu")
    waiting, keyframes = set(), slam.segments
    for frame in frames[1]:
        slam.process(frame)
        if slam.world.map.mapped:
            waiting.add(len(keyframes.keyframe_ids) - len(slam.world.map.mapped))
    assert waiting == ({0} if distance == 0 else {1})


def test_without_a_keyframe_there_is_no_map(frames):
    slam = Slam(frames[0], quick(), defers_map=True, device="cpu")
    slam.refine()
    assert len(slam.snapshot()) == 0
    assert not slam.stopwatch.seconds


def test_what_is_not_refined_takes_no_time(frames):
    slam = Slam(frames[0], quick(), device="cpu")
    slam.refine(seconds=1.0)
    assert not slam.stopwatch.seconds


def test_what_needs_the_map_on_the_way_has_it(frames):
    config = quick()
    for other in (
        replace(config.mapping, when="online"),
        replace(config.mapping, final_iterations=0),
    ):
        assert not Slam(
            frames[0], replace(config, mapping=other), defers_map=True, device="cpu"
        ).world.maps_at_end
    assert not Slam(frames[0], config, device="cpu").world.maps_at_end
    assert Slam(frames[0], config, defers_map=True, device="cpu").world.maps_at_end
    assert preset("fast").mapping.may_follow
