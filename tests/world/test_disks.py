"""The map's bookkeeping and its motion under similarities."""

import pytest
import torch

from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_exp, se3_inverse, sim3_exp, transform
from geogs.splat.render import render
from geogs.world.disks import DiskParameters, GaussianMap


def disks(n: int, seed: int = 0) -> DiskParameters:
    g = torch.Generator().manual_seed(seed)
    position = torch.randn(n, 3, generator=g) + torch.tensor([0.0, 0.0, 4.0])
    scale = 0.3 * torch.randn(n, 2, generator=g) - 1.5
    opacity = torch.randn(n, generator=g)
    return DiskParameters(position, torch.randn(n, 4, generator=g), scale, opacity)


def filled(n: int = 20) -> GaussianMap:
    full = GaussianMap.empty()
    full.append(disks(n), keyframe_id=3)
    return full


def test_append_and_keep() -> None:
    full = filled(4)
    full.seen += torch.tensor([True, False, True, False])
    full.append(disks(2, seed=1), torch.tensor([7, 8]))
    assert len(full) == 6
    assert full.keyframe_id.tolist() == [3, 3, 3, 3, 7, 8]
    assert full.seen.tolist() == [1, 0, 1, 0, 0, 0]
    position = full.position.detach().clone()
    full.keep(torch.tensor([False, True, True, False, True, False]))
    assert full.keyframe_id.tolist() == [3, 3, 7]
    assert full.seen.tolist() == [0, 1, 0]
    assert torch.equal(full.position.detach(), position[[1, 2, 4]])
    assert all(p.requires_grad and p.is_leaf and len(p) == 3 for p in full.parameters)


def test_appended_tensors_are_copied() -> None:
    new = disks(3)
    full = GaussianMap.empty()
    full.append(new, 0)
    new.position.fill_(9)
    assert full.position.max() < 9


def test_snapshot_is_detached_and_normalised() -> None:
    full = filled()
    snapshot = full.snapshot()
    assert torch.allclose(snapshot.quaternion.norm(dim=1), torch.ones(20))
    assert torch.allclose(snapshot.scale.log(), full.parameters.log_scale.detach())
    assert torch.allclose(
        snapshot.opacity.logit(), full.parameters.opacity_logit.detach(), atol=1e-5
    )
    before = snapshot.position.clone()
    with torch.no_grad():
        full.position.add_(1)
    assert torch.equal(snapshot.position, before)


def test_one_similarity_moves_the_whole_scene() -> None:
    """Seen from a camera that moves along, only the unit of depth changes."""
    full, camera = filled(), Camera(40.0, 40.0, 20.0, 15.0, 41, 31)
    T_cw = se3_exp(torch.tensor([0.1, 0.1, 0.2, 0.1, 0.0, 0.1], dtype=torch.float64))
    before = render(full, camera, T_cw)
    S = sim3_exp(torch.tensor([0.5, -1.0, 2.0, 0.3, 1.0, -0.7, 0.4], dtype=torch.float64))
    scale = torch.tensor(0.4, dtype=torch.float64).exp()
    full.transform(S)
    R = S[:3, :3] / scale
    centre = transform(S, se3_inverse(T_cw)[:3, 3][None])[0]
    moved = torch.eye(4, dtype=torch.float64)
    moved[:3, :3] = T_cw[:3, :3] @ R.mT
    moved[:3, 3] = -moved[:3, :3] @ centre
    after = render(full, camera, moved)
    assert torch.allclose(after.depth, before.depth * scale.float(), rtol=1e-4, atol=1e-4)
    assert torch.allclose(after.alpha, before.alpha, atol=1e-4)
    assert torch.allclose(after.normal, before.normal, atol=1e-4)
    assert before.alpha.mean() > 0.1


def test_a_similarity_per_disk() -> None:
    xi = 0.3 * torch.randn(20, 7, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    together = filled()
    together.transform(sim3_exp(xi))
    for k in (0, 7, 19):
        alone = filled()
        alone.transform(sim3_exp(xi[k]))
        for a, b in zip(together.parameters, alone.parameters, strict=True):
            assert torch.allclose(a[k], b[k], atol=1e-6)
    assert together.parameters.log_scale.detach().numpy() == pytest.approx(
        filled().parameters.log_scale.detach().numpy() + xi[:, 6:].numpy(), abs=1e-5
    )


def test_transform_of_an_empty_map() -> None:
    empty = GaussianMap.empty()
    empty.transform(sim3_exp(torch.ones(7, dtype=torch.float64)))
    assert len(empty) == 0
