"""A walk through many rooms: doors fit, the camera keeps clear, and one sees through the doors."""

from itertools import pairwise

import numpy as np
import pytest

from geogs.errors import InputError
from geogs_synth.sequence.location import centred_camera
from portals import SuiteRaycaster
from suite import ROOM, STEP, WALL, Suite

SUITE = Suite(4, seed=2)


def test_a_suite_is_a_ring_of_rooms_with_doors_that_fit():
    suite = Suite.for_walk(5000)
    assert suite.rooms == 18
    for room in range(suite.rooms):
        before, after = suite.doors(room)
        assert (before.to, after.to) == ((room - 1) % 18, (room + 1) % 18)
        back = suite.doors(after.to)[0]
        assert np.allclose(suite.door_centre(room, after), suite.door_centre(after.to, back))
        assert suite.nearest(suite.origin(room) + ROOM / 2) == room
    with pytest.raises(InputError, match="even number of at least 4"):
        Suite(5)


def test_the_walk_leads_through_every_room_and_back():
    suite = Suite.for_walk(5000)
    poses = suite.walk(5000)
    assert np.array_equal(suite.walk(700), poses[:700])
    rooms = [suite.nearest(T[:3, 3]) for T in poses]
    visits = [rooms[0], *(b for a, b in pairwise(rooms) if a != b)]
    assert visits[:20] == [*range(18), 0, 1]
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert steps.mean() == pytest.approx(STEP, rel=0.1)
    assert steps.max() < 1.5 * STEP
    turns = (poses[1:, :3, :3] * poses[:-1, :3, :3]).sum((1, 2))
    assert np.degrees(np.arccos(np.clip((turns - 1) / 2, -1, 1))).max() < 3.0


@pytest.mark.long
def test_rooms_are_drawn_from_seed_and_place_and_leave_room_for_the_camera():
    room, again = SUITE.room(1), Suite(4, seed=2).room(5)  # counted round the ring
    assert np.array_equal(room.solids.centre, again.solids.centre)
    poses = SUITE.walk(1100)
    own = np.array([SUITE.nearest(T[:3, 3]) == 1 for T in poses])
    assert own.sum() > 150
    assert room.clearance(poses[own, :3, 3] - SUITE.origin(1)).min() > 0.2


@pytest.mark.long
def test_other_rooms_are_seen_through_doors():
    camera, caster = centred_camera(96, 54), SuiteRaycaster(SUITE, threads=1)
    poses = SUITE.walk(120)
    T_wc = poses[60]
    assert SUITE.nearest(T_wc[:3, 3]) == 0
    image, depth = caster.render(camera, T_wc)
    local = T_wc.copy()
    local[:3, 3] -= SUITE.origin(0)
    own = caster._casters[0].render(camera, local)
    inside = own.depth > 0
    assert np.array_equal(depth[inside], own.depth[inside])
    assert np.array_equal(image[inside], own.image[inside])
    through = ~inside & (depth > 0)
    assert through.sum() > 50
    assert (depth == 0).mean() < 0.02
    assert image[through].std() > 5
    points = (camera.rays().numpy()[through] * depth[through, None]) @ T_wc[:3, :3].T + T_wc[:3, 3]
    beyond = points - SUITE.origin(0)
    assert (((beyond < -WALL) | (beyond > ROOM + WALL / 2)).any(1)).mean() > 0.9
