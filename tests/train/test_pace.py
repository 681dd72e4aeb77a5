"""Runs that are paced by the clock."""

from dataclasses import dataclass

import pytest
import torch

from depth_tuples import TRAINING
from geogs_train import training_run
from geogs_train.course import Worker
from geogs_train.network_trainer import schedule
from geogs_train.training_run import Clock

CPU = Worker(torch.device("cpu"))


@dataclass
class FakeTime:
    """Seconds as they are told."""

    now: float = 100.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock_time(monkeypatch) -> FakeTime:
    made = FakeTime()
    monkeypatch.setattr(training_run, "time", made)
    return made


def test_progress_is_the_share_of_the_minutes(clock_time):
    clock = Clock(2.0, 0.0, CPU)
    assert clock.progress() == 0.0
    clock_time.now += 30
    assert clock.progress() == pytest.approx(0.25)
    clock_time.now += 500
    assert clock.progress() == 1.0


def test_a_resumed_run_goes_on_from_where_it_was(clock_time):
    clock = Clock(1.0, 0.6, CPU)
    assert clock.progress() == pytest.approx(0.6)
    clock_time.now += 30
    assert clock.progress() == pytest.approx(0.8)
    clock_time.now += 30
    assert clock.progress() == 1.0


def test_one_worker_shares_with_nobody():
    assert CPU.shared(0.3) == 0.3


def test_the_learning_rate_ends_near_zero_whatever_the_step():
    late = [schedule(step, 1.0, TRAINING) for step in (10, 1000)]
    assert late == pytest.approx([0.01, 0.01])
    assert schedule(1000, 0.2, TRAINING) > schedule(1000, 0.8, TRAINING) > 0
