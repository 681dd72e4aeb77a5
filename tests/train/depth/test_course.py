"""The depth network's training as a whole: it learns, and a resumed run equals a whole one."""

import json
from dataclasses import replace

import pytest
import torch

from depth_tuples import NETWORK, TRAINING
from geogs.cli.main import main
from geogs.depth.network.model import load_depth_network
from geogs_train.course import Worker
from geogs_train.depth.depth_course import DepthCourse
from geogs_train.depth.depth_options import DepthTraining
from geogs_train.network_trainer import NetworkTrainer
from geogs_train.training_checkpoint import load_checkpoint, read_options, save_checkpoint
from random_rooms import use_fast_rooms

CPU = Worker(torch.device("cpu"))


@pytest.fixture(autouse=True)
def fast_rooms(monkeypatch) -> None:
    use_fast_rooms(monkeypatch)


def trainer_of(options: DepthTraining) -> NetworkTrainer:
    return NetworkTrainer(DepthCourse(options, CPU), CPU)


class OneBatch(DepthCourse):
    """The first batch again and again, as late in the run as the step."""

    def batch(self, step, progress):
        if not hasattr(self, "kept"):
            self.kept = super().batch(0, 0.0)
        return replace(self.kept, progress=progress)


@pytest.mark.system
@pytest.mark.long
def test_one_batch_is_learnt_by_heart():
    options = replace(TRAINING, steps=50, learning_rate=3e-3, warmup=5)
    course = OneBatch(options, CPU)
    trainer = NetworkTrainer(course, CPU)
    batch = course.batch(0, 0.0)

    def error() -> float:
        with torch.no_grad():
            found = trainer.network(batch.views).depth(batch.views.typical)
        return float((found / batch.depth).log().abs().mean())

    before = error()
    losses = [float(trainer.advance()) for _ in range(50)]
    assert losses[-1] < 0.5 * losses[0]
    assert error() < 0.4 * before
    assert error() < 0.15


def test_small_images_come_first():
    course = DepthCourse(replace(TRAINING, small=0.6), CPU)
    for progress, size in ((0.0, (32, 48)), (0.59, (32, 48)), (0.61, (48, 64))):
        assert course.batch(3, progress).depth.shape[1:] == size


def test_a_resumed_run_equals_one_that_was_never_stopped(tmp_path):
    whole = trainer_of(TRAINING)
    losses = [float(whole.advance()) for _ in range(3)]
    first = trainer_of(TRAINING)
    first.advance()
    save_checkpoint(first, tmp_path)
    assert read_options(tmp_path, DepthTraining) == TRAINING
    second = trainer_of(TRAINING)
    load_checkpoint(second, tmp_path)
    assert [float(second.advance()) for _ in range(2)] == losses[1:]
    for a, b in zip(whole.mean.parameters(), second.mean.parameters(), strict=True):
        assert torch.equal(a, b)


@pytest.mark.system
def test_the_command_trains_resumes_and_writes_weights(tmp_path, capsys, monkeypatch):
    out = tmp_path / "run"
    network = [
        word
        for name in ("planes", "groups", "matching", "metadata", "decoder")
        for word in (f"--training.network.{name}", str(getattr(NETWORK, name)))
    ]
    for name in ("encoder", "context", "volume"):
        network += [f"--training.network.{name}", ",".join(map(str, getattr(NETWORK, name)))]
    rooms = [
        word
        for name in ("width", "height", "views", "textures", "texture_size", "candidates")
        for word in (f"--training.rooms.{name}", str(getattr(TRAINING.rooms, name)))
    ]
    options = [*network, *rooms, "--training.rooms.most-density", "0.2", "--training.small-width",
               "48", "--training.small-height", "32", "--training.pool.plans", "1",
               "--training.pool.rooms", "1", "--training.batch", "2", "--training.small-batch",
               "2", "--training.tuples.most-neighbours", "4", "--run.validation-batches", "1",
               "--training.steps", "1", "--run.validate-every", "9"]  # fmt: skip
    with monkeypatch.context() as patch:
        patch.setattr("geogs_train.launch.draw_curves", lambda *_: None)
        assert main(["train", "depth", str(out), "--device", "cpu", *options]) == 0
    trained = load_depth_network(out / "depth.safetensors")
    assert trained.options == NETWORK
    assert trained.calibration.scale > 0
    entries = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]
    assert entries[-1]["scores"]["absolute"] > 0
    assert main(["train", "depth", str(out), "--run.resume", "--device", "cpu"]) == 0
    assert (out / "curves.png").stat().st_size > 10_000
    capsys.readouterr()
    assert main(["train", "flow", str(out), "--run.resume", "--device", "cpu"]) == 2
    assert "is of another network" in capsys.readouterr().err
