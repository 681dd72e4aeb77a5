"""The changing exposure of keyframes is compensated."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from geogs.config import Config
from geogs.geometry.lie import se3_inverse
from geogs.mapping import partners
from geogs.mapping.mapper import Mapper
from geogs_synth.sequence.location import centred_camera
from handheld_walk import handheld_trajectory
from keyframe_samples import Sample, segment_of
from lit_rooms import lit_room
from records import copied

CAMERA = centred_camera(160, 120)
GAINS, OFFSETS = [1.0, 0.8, 0.65, 0.9], [0.0, 0.05, 0.1, -0.05]


@pytest.fixture(scope="module")
def samples() -> list[Sample]:
    """Four keyframes with the true depth on the grid."""
    caster, made = lit_room(3), []
    poses = handheld_trajectory(caster.scene, 64)
    for n, (gain, offset) in enumerate(zip(GAINS, OFFSETS, strict=True)):
        view = caster.render(CAMERA, poses[6 * n])
        z = torch.from_numpy(view.depth[4 : CAMERA.height - 3 : 8, 4 : CAMERA.width - 3 : 8])
        image = np.clip(gain * view.image.astype(np.float64) + 255 * offset, 0, 255)
        made.append(
            Sample(
                n, image.round().astype(np.uint8), se3_inverse(torch.from_numpy(poses[6 * n])),
                (1 / z).float(), (z / 0.02).square().float(),
            )
        )  # fmt: skip
    return made


@pytest.fixture(autouse=True)
def _near_partners(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(partners, "MIN_PARALLAX_DEG", 0.5)


def mapped(samples: list[Sample], level: bool = True) -> Mapper:
    config = replace(
        Config().mapping,
        render_long_edge=80,
        lag=0,
        iterations=0,
        photo=replace(Config().mapping.photo, compensate_exposure=level),
    )
    mapper = Mapper(segment_of(samples, CAMERA).table, config)
    for n in range(len(samples)):
        mapper.observe(n)
    for n in range(len(samples)):
        mapper.map_keyframe(n)
    return mapper


def test_gain_and_offset_are_undone(samples):
    mapper = mapped(samples)
    for n, (gain, offset) in enumerate(zip(GAINS, OFFSETS, strict=True)):
        compensated = mapper.views[n].exposure[:2].tolist()
        assert compensated == pytest.approx([1 / gain, -offset / gain], abs=0.04)
        # What was clipped cannot come back, the rest is as it was.
        grey, middle = 0.5, (0.5 * gain + offset)
        assert compensated[0] * middle + compensated[1] == pytest.approx(grey, abs=0.015)


def test_photos_follow_and_come_back_from_a_checkpoint(samples):
    mapper = mapped(samples)
    view, as_taken = mapper.views[2], mapped(samples, level=False).views[2]
    assert as_taken.exposure[:2].tolist() == [1.0, 0.0]
    expected = view.exposure[0] * as_taken.photo.grey + view.exposure[1]
    assert torch.equal(view.photo.grey, expected)
    mapper.settle()
    again = Mapper(mapper.keyframes, mapper.config, table=copied(mapper.table))
    assert torch.allclose(again.views[2].photo.grey, expected, atol=1e-6)
