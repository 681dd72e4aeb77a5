"""Training on a CPU: views side by side against one after the other."""

import numpy as np
import pytest
import torch

from geogs import threads
from geogs.mapping.training.cpu import CpuTrainer, view_loss
from geogs.mapping.view_arrays import MapCameras
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


def test_steps_at_half_the_resolution_go_the_same_way(rendered):
    moves, shown = [], []
    for coarse in (False, True):
        made, views = trainer(rendered), make_views(rendered, CPU)
        start = made.disks.parameters.position.detach().clone()
        for _ in range(4):
            made.train([[(views[0], [views[1]])]], coarse=coarse)
        moves.append((made.disks.parameters.position.detach() - start).flatten())
        shown.append(views[0].rendered_depth)
    assert shown[1].shape == shown[0].shape  # which the other views' occlusion tests ask for
    both = (shown[0] > 0) & (shown[1] > 0)
    assert both.float().mean() > 0.25
    assert float((shown[1] / shown[0] - 1).abs()[both].median()) < 0.03
    along = torch.nn.functional.cosine_similarity(*moves, dim=0)
    assert 0.1 < float(along) < 0.999  # the same way; by chance it would be 0.02


def test_small_renderings_are_trained_at_the_full_resolution(rendered):
    assert trainer(rendered).coarse_part == 0.0
    large = MapCameras.of(CAMERAS.working.with_long_edge(240), CONFIG)
    assert CpuTrainer(make_map(rendered, CPU), large, CONFIG, UNIT).coarse_part == 0.5
