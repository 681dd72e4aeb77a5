"""Thin things of random rooms: that they are thin, that there are many, and what they displace."""

from dataclasses import replace

import pytest
import torch

from geogs_synth.clips import pieces
from geogs_synth.clips.furnishing import draw_furnishing
from geogs_synth.clips.room_options import RoomOptions
from geogs_synth.clips.sampler import draw_plan
from geogs_synth.draw import Draw
from geogs_synth.scene.rooms import MOST_SOLIDS
from geogs_synth.scene.solids import NONE

SIZE = torch.tensor([[4.0, 5.0, 2.5], [6.0, 3.0, 3.0]])
OPTIONS = RoomOptions(width=64, height=48, textures=8, texture_size=32, candidates=4)


def draw() -> Draw:
    return Draw.keyed(torch.device("cpu"), 5)


def test_gaps_of_railings_are_wider_than_their_balusters():
    piece, _ = pieces.railings(draw(), SIZE, 20)
    uprights = piece.centre[:, :, 2:, 0]
    gap = torch.diff(uprights, dim=-1)
    thick = 2 * piece.half[:, :, 2:, 0]
    assert (gap > 0).all()
    assert (gap > thick[..., 1:]).float().mean() > 0.95
    assert thick.max() <= 0.05


def test_cables_hang_together_and_stay_in_the_room():
    cables = pieces.cables(draw(), SIZE, 10)
    shape = (2, 10, pieces.SEGMENTS)
    axis = cables.rotation[..., :, 2].reshape(*shape, 3)
    centre, half = cables.centre.reshape(*shape, 3), cables.half.reshape(*shape, 3)
    length = half[..., 2:] - 0.5 * half[..., :1]  # without the overlap
    ends, starts = centre + length * axis, centre - length * axis
    torch.testing.assert_close(ends[:, :, :-1], starts[:, :, 1:], atol=1e-5, rtol=0)
    assert (starts > 0).all()
    assert (ends < SIZE[:, None, None]).all()
    middle, chord = centre[:, :, 2, 2], 0.5 * (starts[:, :, 0, 2] + ends[:, :, -1, 2])
    assert (middle < chord + 1e-6).float().mean() > 0.9
    rotation = cables.rotation
    torch.testing.assert_close(
        rotation @ rotation.mT, torch.eye(3).expand_as(rotation), atol=1e-5, rtol=0
    )


def test_rooms_without_thin_things_are_what_they_were():
    plain, thin = (draw_furnishing(draw(), SIZE, 0.2, 0.6, t) for t in (0.0, 0.9))
    count = plain.solids.kind.shape[1]
    assert torch.equal(thin.solids.kind[:, :count], plain.solids.kind)
    assert torch.equal(thin.solids.centre[:, :count], plain.solids.centre)
    added = (thin.solids.kind[:, count:] != NONE).sum(1)
    assert added.max() > 20


def test_rooms_have_no_more_places_than_the_kernels_take_and_keep_their_looks():
    options = replace(OPTIONS, least_density=0.1, most_density=0.3, thin=1.0)
    rooms = draw_plan(options, 4, 0, 3, 6, 0).rooms
    kind = rooms.solids.kind
    assert kind.shape == (6, MOST_SOLIDS)
    assert rooms.surfaces.contrast.shape == (6, 6 + 2 * MOST_SOLIDS)
    assert (kind != NONE).sum(1).float().mean() > 30


def test_a_solid_keeps_its_surfaces_where_others_leave():
    rooms = draw_plan(OPTIONS, 4, 0, 3, 2, 0).rooms
    fewer = rooms.with_places(40)
    for b in range(2):
        kept = (rooms.solids.kind[b] != NONE).nonzero()[:40, 0]
        there = int((fewer.solids.kind[b] != NONE).sum())
        assert there == len(kept) > 5
        torch.testing.assert_close(fewer.solids.centre[b, :there], rooms.solids.centre[b, kept])
        for side in (0, 1):
            own = fewer.surfaces.tint[b, 6 + side : 6 + 2 * there : 2]
            torch.testing.assert_close(own, rooms.surfaces.tint[b, 6 + 2 * kept + side])
    assert torch.equal(fewer.surfaces.texture[:, :6], rooms.surfaces.texture[:, :6])
    assert rooms.with_places(MOST_SOLIDS) is rooms


@pytest.mark.parametrize("make", [pieces.lattices, pieces.bushes])
def test_parts_are_thin(make):
    piece, place = make(draw(), SIZE, 12)
    thinnest = piece.half.amin(-1)
    assert thinnest.max() <= 0.05
    assert place.position.shape == (2, 12, 3)
