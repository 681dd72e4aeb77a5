"""Training of the flow network: starts, losses, scores, resume."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from geogs.cli.main import main
from geogs.geometry.lie import se3_exp
from geogs.tracking.flow.lookup import CHANNELS, DescriptorPyramid, Edges, PyramidLevel
from geogs.tracking.flow.network_parts import cell_pixels
from geogs.tracking.flow.own_network import (
    FlowEstimate,
    FlowFeatures,
    LaplaceMixture,
    NetworkOptions,
    load_flow_network,
)
from geogs_synth.clips.room_options import RoomOptions
from geogs_train.course import Worker
from geogs_train.flow.flow_loss import descriptor_loss, flow_loss
from geogs_train.flow.flow_options import FlowTraining
from geogs_train.flow.flow_pairs import FlowBatch
from geogs_train.flow.flow_validation import CellErrors, has_texture, summarise
from geogs_train.flow.starts import StartOptions, disturbed_starts
from geogs_train.launch import course_of
from geogs_train.network_trainer import NetworkTrainer, schedule
from geogs_train.training_checkpoint import load_checkpoint, read_options, save_checkpoint
from random_rooms import use_fast_rooms

pytestmark = pytest.mark.system

ROOMS = RoomOptions(
    width=64, height=48, textures=6, texture_size=64, least_density=0.02, most_density=0.05
)
TINY = FlowTraining(
    steps=4,
    batch=1,
    iterations=2,
    warmup=2,
    rooms=ROOMS,
    network=NetworkOptions(stem=8, middle=8, deep=16, hidden=16, context=16, motion=16),
)
ONLY_STREETS = [
    f"--training.rooms.scenes.{name}={weight}"
    for name, weight in [("usual", 1), ("street", 1), ("shaken", 0), ("people", 0), ("papered", 0),
                         ("bare", 0)]
]  # fmt: skip
CPU = Worker(torch.device("cpu"))


def trainer_of(options: FlowTraining) -> NetworkTrainer:
    return NetworkTrainer(course_of(options, CPU), CPU)


def plane_pair(count: int = 64) -> dict:
    """A plane two metres away and what a small motion does to it."""
    cells = cell_pixels(6, 8, torch.zeros(1)).reshape(6, 8, 2)
    intrinsics = torch.tensor([60.0, 60.0, 31.5, 23.5]).repeat(count, 1)
    rays = torch.cat([(cells - intrinsics[0, 2:]) / 60, torch.ones(6, 8, 1)], -1)
    depth = torch.full((count, 6, 8), 2.0)
    T = se3_exp(torch.tensor([0.1, 0.0, 0.05, 0.0, 0.02, 0.0])).float().repeat(count, 1, 1)
    y = (T[0, :3, :3] @ (2.0 * rays)[..., None])[..., 0] + T[0, :3, 3]
    truth = (y[..., :2] / y[..., 2:] * 60 + intrinsics[0, 2:]).repeat(count, 1, 1, 1)
    return {"truth": truth, "depth": depth, "rays": rays.repeat(count, 1, 1, 1), "T_ji": T,
            "intrinsics": intrinsics, "cells": cells}  # fmt: skip


def test_starts_are_off_by_what_is_asked_for():
    pair = plane_pair()
    options = StartOptions(smallest=0.5, largest=2.0, cold=0.0)
    start = disturbed_starts(**pair, options=options, generator=torch.Generator().manual_seed(1))
    off = (start - pair["truth"]).norm(dim=-1).flatten(1).median(1).values
    assert off.max() < 2.01
    assert 0.2 < off.median() < 2.0
    # Neighbouring cells are off alike: a wrong pose and depth, not noise.
    error = start - pair["truth"]
    step = (error[:, :, 1:] - error[:, :, :-1]).norm(dim=-1).mean()
    assert step < 0.5 * error.norm(dim=-1).mean()


def test_far_starts_lie_beyond_the_others_and_edges_may_have_limits_of_their_own():
    pair = plane_pair()
    off = {}
    for far in (0.0, 1.0):
        options = StartOptions(smallest=0.5, largest=4.0, cold=0.0, far=far, farthest=12.0)
        largest = torch.full((64,), 1.0)
        generator = torch.Generator().manual_seed(1)
        start = disturbed_starts(**pair, options=options, generator=generator, largest=largest)
        off[far] = (start - pair["truth"]).norm(dim=-1).flatten(1).median(1).values
    assert off[0.0].max() < 1.01
    assert off[1.0].max() < 12.01
    assert off[1.0].quantile(0.9) > 4


def test_cold_starts_know_nothing():
    pair = plane_pair()
    options = StartOptions(cold=1.0)
    start = disturbed_starts(**pair, options=options, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(start, pair["cells"].expand_as(start))


def tiny_batch() -> tuple[FlowBatch, FlowFeatures]:
    rng = torch.Generator().manual_seed(0)
    height, width, gh, gw = 16, 24, 2, 3
    truth = torch.rand(1, height, width, 2, generator=rng) * 10
    visible = torch.ones(1, height, width, dtype=torch.bool)
    visible[:, 4, 4] = False
    start = torch.zeros(1, gh * gw, 2)
    batch = FlowBatch(
        torch.zeros(1, 3, height, width), Edges(*(torch.zeros(1).int() for _ in range(2))),
        truth, visible, torch.ones_like(visible), start,
        truth[:, 4::8, 4::8].flatten(1, 2) + torch.randn(1, gh * gw, 2, generator=rng),
    )  # fmt: skip
    levels = (PyramidLevel(12, 8, 0.5, 0.0), PyramidLevel(3, 2, 0.125, -0.25))
    descriptors = torch.randn(1, 12 * 8 + 6, CHANNELS, generator=rng)
    source = torch.randn(1, gh * gw, CHANNELS, generator=rng)
    state = torch.zeros(1, 4, gh, gw)
    return batch, FlowFeatures(source, DescriptorPyramid(descriptors, levels), state, state)


def estimate(pixels: torch.Tensor, log_scale: float) -> FlowEstimate:
    like = torch.full_like(pixels, log_scale)
    mixture = LaplaceMixture(torch.full_like(pixels[..., :1], 30.0), like, like + 2)
    return FlowEstimate(pixels, mixture, torch.zeros(1, 4, 2, 3))


def test_the_loss_is_the_sum_of_its_parts():
    batch, features = tiny_batch()
    options = replace(TINY, decay=0.5, occluded=0.25, absolute=0.3, dense=0.5, descriptors=0.0)
    truth = batch.at_cells(batch.truth)
    estimates = [estimate(truth + 2.0, 0.0), estimate(truth + 1.0, 0.0)]
    rows, columns = torch.meshgrid(torch.arange(16.0), torch.arange(24.0), indexing="ij")
    dense = batch.truth - torch.stack([columns, rows], -1) + 3.0
    found = flow_loss(features, estimates, dense, batch, options)
    expected = 0.5 * math.log1p(3.0)
    for weight, error in ((0.5, 2.0), (1.0, 1.0)):
        expected += weight * (error + math.log(2) + 0.3 * math.log1p(error))
    assert float(found) == pytest.approx(expected, abs=1e-4)


def test_occluded_cells_count_less():
    batch, features = tiny_batch()
    options = replace(TINY, decay=1.0, absolute=0.0, dense=0.0, descriptors=0.0, occluded=0.25)
    truth = batch.at_cells(batch.truth)
    wrong = truth.clone()
    wrong[:, 0] += 4.0  # the first cell, pixel 4 4, is not seen
    dense = torch.zeros_like(batch.truth)
    found = flow_loss(features, [estimate(wrong, 0.0)], dense, batch, options)
    assert float(found) == pytest.approx(math.log(2) + 0.25 * 4.0 / 5.25, abs=1e-4)


def test_the_descriptors_loss_equals_loops():
    batch, features = tiny_batch()
    expected = 0.0
    truth = batch.at_cells(batch.truth)[0]
    offset = 0
    for level in features.pyramid.levels:
        w, h = level.width, level.height
        total = count = 0.0
        for p in range(1, 6):  # the first is not seen
            away = ((truth[p] - batch.probe[0, p]) * level.scale).tolist()
            if max(map(abs, away)) > 3:
                continue
            centre = (batch.probe[0, p] * level.scale + level.shift).tolist()
            logits, fractions = [], []
            for dv in range(-3, 4):
                for du in range(-3, 4):
                    value = 0.0
                    u, v = centre[0] + du, centre[1] + dv
                    for c in (math.floor(u), math.floor(u) + 1):
                        for r in (math.floor(v), math.floor(v) + 1):
                            if 0 <= c < w and 0 <= r < h:
                                dot = (
                                    features.source[0, p]
                                    @ features.pyramid.descriptors[0, offset + r * w + c]
                                )
                                value += (1 - abs(u - c)) * (1 - abs(v - r)) * float(dot) / 8
                    logits.append(value)
                    fractions.append(max(0, 1 - abs(away[0] - du)) * max(0, 1 - abs(away[1] - dv)))
            log = torch.tensor(logits).log_softmax(0)
            total -= float((torch.tensor(fractions) * log).sum())
            count += 1
        expected, offset = expected + total / max(count, 1), offset + w * h
    assert expected > 1
    assert float(descriptor_loss(features, batch)) == pytest.approx(expected, rel=1e-4)


def test_scores_are_means_over_the_right_cells():
    error = torch.tensor([[3.0, 4.0], [0.3, 0.4], [0.0, 0.1], [0.0, 0.1]])
    scores = summarise([
        CellErrors(
            error, torch.tensor([[1.0, 1.0], [0.2, 0.1], [0.1, 0.1], [0.1, 0.1]]),
            torch.tensor([20.0, 3.0, 17.0, 1.0]), torch.tensor([True, True, True, False]),
            torch.tensor([1.0, 3.0]),
        )
    ])  # fmt: skip
    assert scores.dense == 2.0
    assert scores.epe == pytest.approx((5 + 0.5 + 0.1 + 0.1) / 4)
    assert scores.large == pytest.approx(2.55)
    assert scores.textureless == pytest.approx(0.1)
    assert scores.outliers == 0.25
    assert scores.within == pytest.approx((0 + 0.5 + 1 + 1) / 4)
    assert scores.sure_share == 0.75


def test_texture_is_what_the_tracker_calls_texture():
    from geogs.tracking.flow.cell_texture import MIN_STRUCTURE, cell_structure
    from geogs.world.grid import OFFSET, STRIDE

    rng = np.random.default_rng(2)
    image = np.repeat(rng.normal(120, np.linspace(0, 12, 96), (64, 96))[..., None], 3, 2)
    image = np.clip(image, 0, 255).astype(np.uint8)
    mine = has_texture(torch.from_numpy(image).permute(2, 0, 1)[None].float() / 255)
    mine = mine[0, OFFSET:-3:STRIDE, OFFSET:-3:STRIDE].reshape(-1).numpy()
    theirs = cell_structure(image[..., 0]).smaller > MIN_STRUCTURE
    assert 0.2 < theirs.mean() < 0.9
    assert (mine == theirs).mean() > 0.97


def test_the_learning_rate_rises_and_falls():
    options = FlowTraining(steps=1000, warmup=100)
    rates = [schedule(n, n / 1000, options) for n in range(1000)]
    assert rates[0] == pytest.approx(0.01)
    assert max(rates) == rates[99] == pytest.approx(0.976, abs=0.001)
    assert rates[500] == pytest.approx(0.505, abs=0.001)
    assert rates[-1] < 0.011


def test_a_resumed_run_equals_one_that_was_never_stopped(tmp_path, monkeypatch):
    use_fast_rooms(monkeypatch)
    whole = trainer_of(TINY)
    losses = [float(whole.advance()) for _ in range(3)]
    first = trainer_of(TINY)
    first.advance()
    (tmp_path / "checkpoint").mkdir()
    (tmp_path / "checkpoint" / "notes.txt").touch()  # of somebody else
    save_checkpoint(first, tmp_path)
    save_checkpoint(first, tmp_path)
    assert (tmp_path / "checkpoint" / "notes.txt").is_file()
    assert read_options(tmp_path, FlowTraining) == TINY
    second = trainer_of(replace(TINY, seed=0))
    load_checkpoint(second, tmp_path)
    assert [float(second.advance()) for _ in range(2)] == losses[1:]
    for a, b in zip(whole.network.parameters(), second.network.parameters(), strict=True):
        assert torch.equal(a, b)
    for a, b in zip(whole.mean.parameters(), second.mean.parameters(), strict=True):
        assert torch.equal(a, b)


def test_the_command_trains_resumes_and_writes_weights(tmp_path, monkeypatch):
    use_fast_rooms(monkeypatch)
    out = tmp_path / "run"
    options = ["--training.batch", "1", "--training.iterations", "2", "--run.validation-batches",
               "1", "--training.rooms.width", "64", "--training.rooms.height", "48",
               "--training.rooms.textures", "6", "--training.rooms.texture-size", "64",
               *ONLY_STREETS,
               "--training.rooms.least-density", "0.02",
               "--training.rooms.most-density", "0.05", "--device", "cpu"]  # fmt: skip
    with monkeypatch.context() as patch:
        patch.setattr("geogs_train.launch.draw_curves", lambda *_: None)
        assert main(["train", "flow", str(out), "--training.steps", "1", *options]) == 0
    network = load_flow_network(out / "flow.safetensors")
    assert sum(p.numel() for p in network.parameters()) > 1e6
    entries = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]
    assert entries[-1]["scores"]["usual"]["epe"] > 0
    assert set(entries[-1]["scores"]["others"]) == {"street"}
    assert main(["train", "flow", str(out), "--run.resume", "--device", "cpu"]) == 0
    assert (out / "curves.png").stat().st_size > 10_000


def test_resuming_nothing_is_one_sentence(tmp_path, capsys):
    assert main(["train", "flow", str(tmp_path / "no"), "--run.resume", "--device", "cpu"]) == 2
    assert "There is no checkpoint" in capsys.readouterr().err
    (tmp_path / "checkpoint.safetensors").write_bytes(b"rubbish")
    assert main(["train", "flow", str(tmp_path), "--run.resume", "--device", "cpu"]) == 2
    assert "is damaged" in capsys.readouterr().err


def test_the_weight_in_the_adjustment_is_that_of_a_matched_cell():
    like = torch.full((1, 2, 2), -2.0)
    mixture = LaplaceMixture(torch.full((1, 2, 1), 1.0), like, like + 2)
    expected = 1 / (1 + math.exp(-1)) / (2 * math.exp(-4.0) + 0.04**2)
    assert mixture.weight(0.04).flatten().tolist() == pytest.approx([expected] * 4)
