"""The wall with a white panel: what is left to match in front of it."""

import numpy as np
import pytest

from geogs_synth.motion.motion_kinds import MotionKind
from geogs_synth.raycast.raycaster import Raycaster
from geogs_synth.sequence.location import centred_camera, make_location

CAMERA = centred_camera(160, 120)


def seen_of_wall(kind: MotionKind, seed: int) -> np.ndarray:
    """The fraction of the image that is coloured, so no part of the panel, along the walk."""
    place = make_location(kind, seed)
    times = np.linspace(0, place.motion.seconds, 5)
    caster = Raycaster(place.scene, 1)
    views = [caster.render(CAMERA, T_wc) for T_wc in place.motion.path(times)]
    assert min(float((v.depth > 0).mean()) for v in views) == 1.0
    return np.array([float((np.ptp(v.image.astype(int), axis=2) > 20).mean()) for v in views])


@pytest.mark.parametrize("seed", [0, 1])
def test_a_panel_leaves_a_margin_or_nothing_between_two_sides(seed: int) -> None:
    panel, weak = seen_of_wall("white-panel", seed), seen_of_wall("weak-link", seed)
    assert min(panel[0], panel[-1], weak[0], weak[-1]) > 0.2
    assert 0.05 < panel[2] < 0.4
    assert weak[2] < 0.02


@pytest.mark.parametrize("kind", ["white-panel", "weak-link"])
def test_the_walk_keeps_clear_of_the_wall(kind: MotionKind) -> None:
    place = make_location(kind, 3)
    centres = place.motion.path(np.arange(0, place.motion.seconds, 1 / 15))[:, :3, 3]
    assert place.scene.clearance(centres).min() > 0.4
    assert np.ptp(centres[:, 0]) == pytest.approx(4.0, abs=0.2)
    assert place.name.startswith("procedural panelled wall")
    again = make_location(kind, 3).scene
    assert (again.solids.centre == place.scene.solids.centre).all()
