"""Training on a CPU: views side by side against one after the other."""

import numpy as np
import pytest
import torch

from geogs import threads
from geogs.mapping.training.cpu import CpuTrainer, view_loss
from geogs.splat.render import render
from trained_room import (
    CAMERAS,
    CONFIG,
    UNIT,
    make_batches,
    make_map,
    make_views,
    rendered_keyframes,
)

CPU = torch.device("cpu")
pytestmark = pytest.mark.system


@pytest.fixture(scope="module")
def rendered():
    return rendered_keyframes()


def trainer(rendered) -> CpuTrainer:
    return CpuTrainer(make_map(rendered, CPU), CAMERAS, CONFIG, UNIT)


def test_gradients_are_those_of_the_summed_losses(rendered, monkeypatch):
    fast, views, found = trainer(rendered), make_views(rendered, CPU), []
    step = fast.optimizer.step
    monkeypatch.setattr(
        fast.optimizer, "step",
        lambda seen: (found.extend(p.grad.clone() for p in fast.disks.parameters), step(seen)),
    )  # fmt: skip
    batch = [*make_batches(views)[0], (views[3], [views[0]])]
    total = fast.step(batch)

    slow, others = trainer(rendered), make_views(rendered, CPU)
    by_id = {view.id: view for view in others}
    losses = []
    for view, partners in batch:
        output = render(slow.disks, CAMERAS.render, view.T_cw)
        own = [by_id[p.id] for p in partners]
        losses.append(view_loss(by_id[view.id], own, output, CONFIG, UNIT))
    whole = sum(losses)
    whole.backward()
    assert total == pytest.approx(float(whole.detach()), rel=1e-5)
    for gradient, p in zip(found, slow.disks.parameters, strict=True):
        assert float(p.grad.norm()) > 0
        assert float((gradient - p.grad).norm()) < 1e-5 * float(p.grad.norm())
    for view, _ in batch:
        assert by_id[view.id].rendered_depth is None
        assert float(view.rendered_depth.max()) > 0


def test_results_do_not_depend_on_the_number_of_threads(rendered, monkeypatch):
    results = []
    for count in (1, 2, 3):
        monkeypatch.setattr(threads, "worker_count", lambda count=count: count)
        made, views = trainer(rendered), make_views(rendered, CPU)
        made.train([*make_batches(views), [*make_batches(views)[0], *make_batches(views)[2]]])
        results.append([p.detach().clone() for p in made.disks.parameters])
    for other in results[1:]:
        for p, q in zip(results[0], other, strict=True):
            assert torch.equal(p, q)
    start = make_map(rendered, CPU).parameters[0].detach()
    assert np.median((results[0][0] - start).norm(dim=1)) > 0
