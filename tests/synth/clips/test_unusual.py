"""Streets, people, patterns that repeat, cameras that move as they look."""

from dataclasses import astuple, replace

import pytest
import torch

from geogs_synth.camera.camera_batch import pixel_grid, project, rays
from geogs_synth.camera.clip_camera import exposed, motion_while_open
from geogs_synth.clips.clip_batch import ClipBatch
from geogs_synth.clips.dynamics import draw_shake
from geogs_synth.clips.room_options import (
    SCENE_KINDS,
    STREET,
    RoomOptions,
    SceneWeights,
    only_scene,
)
from geogs_synth.clips.sampler import RoomSampler, draw_plan
from geogs_synth.draw import Draw, rotated, rotation_matrix
from geogs_train.flow.flow_pairs import REPEATING, flow_batch
from geogs_train.flow.starts import StartOptions
from random_rooms import looking_along_y, use_fast_rooms

OPTIONS = RoomOptions(width=64, height=48, textures=8, texture_size=32, candidates=8)
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def sampler() -> RoomSampler:
    """Renders with the emulated kernel, many times as fast as the reference."""
    with pytest.MonkeyPatch.context() as patch:
        use_fast_rooms(patch)
        yield RoomSampler(OPTIONS, "cpu")


def film(sampler: RoomSampler, kind: str, count: int = 2) -> ClipBatch:
    options = replace(OPTIONS, scenes=only_scene(kind))
    return sampler.film(draw_plan(options, sampler.bank.materials, 0, 1, count, 0))


def test_usual_rooms_are_what_they_were_before_there_were_others():
    plan = draw_plan(OPTIONS, 4, 0, 3, 2, 0)
    other = draw_plan(replace(OPTIONS, scenes=SceneWeights(shaken=1.0)), 4, 0, 3, 2, 0)
    assert plan.dynamics is None
    assert other.dynamics is not None
    assert torch.equal(plan.rooms.solids.centre, other.rooms.solids.centre)
    assert torch.equal(plan.paths.centre, other.paths.centre)


def test_kinds_come_as_often_as_asked_for():
    weights = SceneWeights(usual=0.5, shaken=0.0, people=0.25, papered=0.0, bare=0.0, street=0.25)
    kind = Draw.keyed(CPU, 1).choose(astuple(weights), 4000)
    fraction = torch.bincount(kind, minlength=len(SCENE_KINDS)) / 4000
    assert fraction.tolist() == pytest.approx([0.5, 0, 0.25, 0, 0, 0.25], abs=0.03)
    assert Draw.keyed(CPU, 1).choose(astuple(only_scene("street")), 5).tolist() == [STREET] * 5


def test_points_are_where_the_row_that_sees_them_says():
    views = looking_along_y([2.0, 1.0, 1.5], [2.2, 1.1, 1.5])
    b, v = views.T_cw.shape[:2]
    g = torch.Generator().manual_seed(1)
    sweep = 0.05 * torch.randn(b, v, 6, generator=g, dtype=views.T_cw.dtype)
    views = replace(views, sweep=sweep)
    x, y = pixel_grid(views)
    for view in range(v):
        origin, direction = rays(views, view, x, y)
        found, before = project(views, view, origin + 2.0 * direction)
        torch.testing.assert_close(found[0], torch.stack([x, y], -1), atol=1e-6, rtol=0)
        assert before.all()
    # The middle row is that of T_cw.
    still = rays(replace(views, sweep=None), 0, x, y)[1].unflatten(1, (views.height, -1))
    swept = rays(views, 0, x, y)[1].unflatten(1, (views.height, -1))
    middle = views.height // 2
    torch.testing.assert_close(still[:, middle], swept[:, middle])
    assert (still[:, 0] - swept[:, 0]).abs().max() > 0.01


def test_blur_is_along_what_finite_differences_say():
    views = looking_along_y([2.0, 1.0, 1.5])
    depth = torch.full((1, 1, views.height, views.width), 3.0, dtype=torch.float64)
    camera = torch.tensor([[[0.01, -0.02, 0.03, 0.02, 0.01, 0.05]]], dtype=torch.float64)
    things = torch.zeros(*depth.shape, 3, dtype=torch.float64)
    things[..., 0] = 0.04
    found = motion_while_open(views, depth, camera, things)
    x, y = pixel_grid(views)
    origin, direction = rays(views, 0, x, y)
    point = origin + 3.0 * direction
    step = 1e-4
    # Every row is late by the step: what the whole camera has done by then.
    later = replace(views, sweep=None, T_cw=_after(views.T_cw, step * camera[0, 0]))
    pixels, _ = project(later, 0, point + step * things.flatten(1, 3))
    moved = (pixels[0] - torch.stack([x, y], -1)) / step
    torch.testing.assert_close(found.flatten(0, 3), moved, atol=5e-3, rtol=1e-3)


def _after(T_cw: torch.Tensor, twist: torch.Tensor) -> torch.Tensor:

    done = torch.eye(4, dtype=T_cw.dtype)
    done[:3, :3], done[:3, 3] = rotation_matrix(twist[:3]), twist[3:]
    return torch.linalg.inv(done) @ T_cw


def test_a_point_is_drawn_out_and_loses_no_light():
    colour = torch.zeros(1, 1, 3, 9, 21)
    colour[..., 4, 10] = 1.0
    blur = torch.zeros(1, 1, 9, 21, 2)
    blur[..., 0] = 10.0
    found = exposed(colour, blur)[0, 0, 0]
    assert found.sum() == pytest.approx(1.0, abs=1e-5)
    assert found[4, 6:15].min() > 0.05
    assert found[3].max() == found[5].max() == 0


def test_people_move_and_their_flow_is_their_own(sampler):
    clips = film(sampler, "people", 4)
    assert clips.dynamics is not None
    truth, still = clips.flow(0, 1), clips.still_flow(clips.points(0), 1)
    moving = clips.dynamics.velocity_of(clips.solid[:, 0]).norm(dim=-1) > 0
    apart = (truth.pixels - still).norm(dim=-1)
    assert 0.005 < moving.float().mean() < 0.7
    assert apart[~moving].max() < 1e-3
    assert apart[moving & truth.valid].max() > 2
    # What a pixel shows is where its flow says, in the image of its light.
    there = truth.visible & moving
    at = truth.pixels.round().long()
    solid = clips.solid[:, 1][torch.arange(4)[:, None, None], at[..., 1].clamp(0, 47),
                              at[..., 0].clamp(0, 63)]  # fmt: skip
    assert (solid == clips.solid[:, 0])[there].float().mean() > 0.8


def test_a_street_has_a_sky_that_stays_where_it_is_and_ground_below(sampler):
    clips = film(sampler, "street", 8)
    depth = clips.depth[:, 0]
    far = depth > 60
    assert 0.03 < far.float().mean() < 0.8
    low = depth[:, 40:]
    assert (low < 60).float().mean() > 0.6
    shift = (clips.views.T_cw[:, 1, :3, 3] - clips.views.T_cw[:, 0, :3, 3]).norm(dim=-1)
    assert shift.max() < 300
    assert clips.images.isfinite().all()
    assert clips.images.std() > 0.05


def test_papered_walls_start_from_the_right_one(sampler):
    clips = film(sampler, "papered")
    assert clips.dynamics is not None
    generator = torch.Generator().manual_seed(0)
    batch = flow_batch(clips, StartOptions(cold=0.0), generator)
    still = torch.cat([clips.still_flow(clips.points(k), 1 - k) for k in (0, 1)])
    off = (batch.start - batch.at_cells(still)).norm(dim=-1).median(1).values
    assert off.max() < REPEATING + 0.01
    generator.manual_seed(0)
    far = flow_batch(clips, StartOptions(cold=0.0, far=1.0), generator)
    off = (far.start - far.at_cells(still)).norm(dim=-1).median(1).values
    assert off.max() > REPEATING


def test_only_shaken_clips_are_read_row_by_row():
    kind = torch.tensor([0, 1] * 200)
    shake = draw_shake(Draw.keyed(CPU, 5), kind, 2)
    assert (shake.sweep[kind == 0] == 0).all()
    assert (shake.exposure[kind == 0] == 0).all()
    rolling = shake.sweep[kind == 1].abs().amax((1, 2)) > 0
    assert 0.7 < rolling.float().mean() < 0.9
    assert torch.rad2deg(shake.sweep[..., :3].abs()).max() < 15


def test_vectors_are_turned_as_by_the_matrix():
    g = torch.Generator().manual_seed(3)
    vector, rotation = (torch.randn(5, 7, 3, generator=g, dtype=torch.float64) for _ in range(2))
    rotation[0, 0] = 0
    expected = (rotation_matrix(rotation) @ vector[..., None])[..., 0]
    torch.testing.assert_close(rotated(vector, rotation), expected)
