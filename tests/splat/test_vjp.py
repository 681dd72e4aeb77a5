"""Rendering with a pull-back against autograd and the specification."""

from collections.abc import Callable

import pytest
import torch

import geogs
from cuda_emulator import use_emulator
from geogs.splat.cuda import rasterize
from geogs.splat.render import Backend, PullBack, RenderGradients, RenderOutput, render, render_vjp
from geogs.world.disks import DiskParameters, GaussianMap
from splat_scenes import CAMERA, MAPS, SCENES, edge_on, ordinary, pose, relative

Where = tuple[Backend, torch.device]
FIELDS = (*MAPS, "median_depth", "visible")


@pytest.fixture(params=["cpu", "emulated", pytest.param("gpu", marks=pytest.mark.gpu)])
def where(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Where:
    """The backend and where its disks lie."""
    if request.param == "cpu":
        return "cpu", torch.device("cpu")
    if request.param == "emulated":
        use_emulator(monkeypatch, rasterize)
        return "cuda", torch.device("cpu")
    if not torch.cuda.is_available():
        pytest.skip("needs an NVIDIA GPU")
    return "cuda", torch.device("cuda")


def cotangents(device: torch.device) -> dict[str, torch.Tensor]:
    g, shape = torch.Generator().manual_seed(0), (CAMERA.height, CAMERA.width)
    shapes = {name: (*shape, 3) if name == "normal" else shape for name in MAPS}
    return {name: torch.randn(s, generator=g).to(device) for name, s in shapes.items()}


def on(disks: DiskParameters, device: torch.device) -> DiskParameters:
    return DiskParameters(*(p.to(device) for p in disks))


def by_autograd(
    disks: DiskParameters, given: dict[str, torch.Tensor], backend: Backend
) -> tuple[RenderOutput, list[torch.Tensor]]:
    leaves = [p.clone().requires_grad_() for p in disks]
    T_cw = pose().requires_grad_()
    out = render(DiskParameters(*leaves), CAMERA, T_cw, backend=backend)
    maps = [getattr(out, name) for name in given]
    found = torch.autograd.grad(maps, [*leaves, T_cw], [g.to(maps[0]) for g in given.values()])
    return out, list(found)


def flat(gradients: RenderGradients) -> list[torch.Tensor]:
    return [*gradients.disks, gradients.T_cw]


def test_gradients_are_those_of_autograd(where: Where) -> None:
    backend, device = where
    disks, given = on(ordinary(), device), cotangents(device)
    expected, gradients = by_autograd(disks, given, backend)
    out, pull_back = render_vjp(disks, CAMERA, pose(), backend)
    for name in FIELDS:
        assert torch.equal(getattr(out, name), getattr(expected, name)), name
        assert getattr(out, name).grad_fn is None, name
    found = flat(pull_back(**given))
    assert found[-1].dtype == torch.float64
    for a, b in zip(found, gradients, strict=True):
        assert a.shape == b.shape
        assert torch.equal(a, b) if backend == "cpu" else relative(a.cpu(), b.cpu().double()) < 1e-5


@pytest.mark.parametrize("scene", SCENES)
def test_gradients_are_those_of_the_specification(
    scene: Callable[[], DiskParameters], where: Where
) -> None:
    backend, device = where
    given = cotangents(torch.device("cpu"))
    doubles = DiskParameters(*(p.double() for p in scene()))
    _, exact = render_vjp(doubles, CAMERA, pose())
    _, pull_back = render_vjp(on(scene(), device), CAMERA, pose(), backend)
    # Across a disk seen edge-on, float32 pixel offsets are coarse.
    tolerance = 1e-2 if scene is edge_on else 1e-3
    for a, b in zip(flat(pull_back(**given)), flat(exact(**given)), strict=True):
        assert relative(a.cpu(), b) < tolerance


def test_it_is_linear_and_may_be_asked_again(where: Where) -> None:
    backend, device = where
    given = cotangents(device)
    _, pull_back = render_vjp(on(ordinary(), device), CAMERA, pose(), backend)
    parts = [flat(pull_back(**{name: g})) for name, g in given.items()]
    whole, again = flat(pull_back(**given)), flat(pull_back(**given))
    for n, (a, b) in enumerate(zip(whole, again, strict=True)):
        assert relative(a, b.double()) < 1e-6
        assert relative(sum(part[n].double() for part in parts), b.double()) < 1e-5


def test_renderings_in_between_change_nothing(where: Where) -> None:
    backend, device = where
    disks, given = on(ordinary(), device), cotangents(device)
    _, first = render_vjp(disks, CAMERA, pose(), backend)
    alone = flat(first(**given))
    moved = pose()
    moved[0, 3] += 0.3
    _, second = render_vjp(disks, CAMERA, moved, backend)
    other = flat(second(**given))
    for a, b, c in zip(flat(first(**given)), alone, other, strict=True):
        assert relative(a, b.double()) < 1e-6
        assert relative(c, b.double()) > 1e-3


def test_disks_of_a_map_get_no_gradients_of_their_own(where: Where) -> None:
    backend, device = where
    map_ = GaussianMap.of(on(ordinary(), device), torch.zeros(160, dtype=torch.int64))
    out, pull_back = geogs.render_vjp(map_, CAMERA, pose().numpy(), backend)
    gradients = pull_back(depth=out.depth)
    assert map_.position.grad is None
    _, expected = by_autograd(map_.parameters, {"depth": out.depth}, backend)
    assert relative(gradients.disks.position, expected[0].double()) < 1e-5


def test_an_empty_map_has_empty_gradients(where: Where) -> None:
    backend, device = where
    out, pull_back = render_vjp(GaussianMap.empty(device), CAMERA, pose(), backend)
    gradients = pull_back(alpha=torch.ones_like(out.alpha))
    assert gradients.disks.quaternion.shape == (0, 4)
    assert gradients.T_cw.abs().max() == 0


def test_descent_by_the_pull_back_finds_the_pose() -> None:
    disks = ordinary()
    measured = render(disks, CAMERA, pose()).depth
    T_cw = pose()
    T_cw[2, 3] += 0.02
    errors = []
    for _ in range(40):
        out, pull_back = render_vjp(disks, CAMERA, T_cw)
        error = (out.depth - measured).clamp(-0.05, 0.05)
        errors.append(float(error.square().mean()))
        T_cw[2, 3] -= 0.3 / error.numel() * pull_back(depth=error).T_cw[2, 3]
    assert abs(float(T_cw[2, 3] - pose()[2, 3])) < 0.004
    assert errors[-1] < 0.1 * errors[0]


@pytest.fixture
def pull_back() -> PullBack:
    return render_vjp(ordinary(), CAMERA, pose())[1]


def test_a_gradient_of_another_shape_is_refused(pull_back: PullBack) -> None:
    with pytest.raises(ValueError, match=r"by depth is 45x75, the map 75x45\."):
        pull_back(depth=torch.zeros(45, 75))


def test_nothing_to_pull_back_is_refused(pull_back: PullBack) -> None:
    with pytest.raises(ValueError, match="at least one"):
        pull_back()
