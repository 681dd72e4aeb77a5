"""The losses of a window of views on a GPU against the plain ones in float64: value, gradients.

Run in the emulator at a small size and, where there is a GPU, on it at a realistic size.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from cuda_emulator import use_emulator
from geogs.config import LossAblation, LossConfig
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_exp
from geogs.losses.cuda import window_losses
from geogs.losses.cuda.view_table import ViewTable
from geogs.losses.cuda.window_losses import WindowLosses
from geogs.losses.exposure import USUAL_NOISE
from geogs.losses.multi_view import PhotoView
from geogs.losses.single_view import MIN_ALPHA, ViewConstants
from loss_scenes import random_view
from oracles.multi_view_reference import multi_view_loss
from oracles.single_view_reference import single_view_loss

UNIT, SHARE = 1.7, 0.5
NOTHING = LossConfig(
    depth_weight=0.0, normal_consistency_weight=0.0, distortion_weight=0.0, opacity_weight=0.0,
    l1_weight=0.0, ncc_weight=0.0,
)  # fmt: skip


@pytest.fixture(params=["emulated", pytest.param("cuda", marks=pytest.mark.gpu)])
def device(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> Iterator[torch.device]:
    if request.param == "cuda":
        if not torch.cuda.is_available():
            pytest.skip("there is no GPU")
        yield torch.device("cuda")
    else:
        use_emulator(monkeypatch, window_losses)
        yield torch.device("cpu")


@dataclass
class Scene:
    """Keyframes of a wavy, textured surface in a table, and rendered maps of a batch of them."""

    table: ViewTable
    views: list[ViewConstants]
    photos: list[PhotoView]
    rendered: list[Tensor | None]
    batch: Tensor
    pairs: Tensor
    maps: list[Float[Tensor, "b ..."]]

    @staticmethod
    def make(device: torch.device, zoom: float = 2.0, normals: bool = True) -> "Scene":
        """Four keyframes, three in the batch of four (one place is empty), up to two partners."""
        scale = 1 if device.type == "cpu" else 8
        width, height = 61 * scale + 1, 37 * scale
        camera = Camera(50.0 * scale, 51.0 * scale, 30.3 * scale, 18.2 * scale, width, height)
        photo = camera.resized(round(zoom * width), round(zoom * height))
        table = ViewTable(camera, photo, device, capacity=2)
        rng = np.random.default_rng(3)
        texture = cv2.GaussianBlur(rng.random((photo.height, photo.width, 3)), (0, 0), 2.0)
        scene = Scene(table, [], [], [], torch.tensor([]), torch.tensor([]), [])
        rendered = []
        for k in range(4):
            maps, view = random_view(20 + k, camera)
            if not normals:
                view = replace(view, prior_normal=None)
            image = np.clip(
                127 + 1500 * (texture - 0.5) + 4 * rng.normal(size=texture.shape), 0, 255
            )
            move = torch.tensor([0.03, -0.02, 0.06, 0.002, 0.003, -0.01]).double()
            T_cw = se3_exp((k - 1.3) * move)
            scene.views.append(constants_on(view, device))
            pixels = image.astype(np.uint8)
            taken = PhotoView.prepare(pixels, photo, T_cw, 0.3, with_colour=True)
            scene.photos.append(
                taken.with_exposure(torch.tensor([1.0, 0.0, (k + 1) * USUAL_NOISE]))
            )
            scene.table.add(view, scene.photos[k])
            rendered.append(maps)
        scene.photos = [photo_on(p, device) for p in scene.photos]
        scene.batch = torch.tensor([2, 0, -1, 3], dtype=torch.int32, device=device)
        scene.pairs = torch.tensor(
            [[1, 0], [3, -1], [-1, -1], [0, 1]], dtype=torch.int32, device=device
        )
        chosen = [rendered[max(int(s), 0)] for s in scene.batch]
        maps = [torch.stack([m[i] for m in chosen]).to(device) for i in range(4)]
        spoil(maps)
        scene.maps = maps
        scene.rendered = [None] * 4
        return scene

    def show(self, losses: WindowLosses) -> None:
        """Let views 0 and 3 have a rendered depth that hides a part of what the others see."""
        depth = self.maps[0].float().nan_to_num(0.0).clone()
        h = depth.shape[1]
        depth[:, h // 2 : h * 3 // 4, 5:20] *= 0.8
        alpha = torch.ones_like(depth)
        alpha[:, : h // 8] = 0.2
        places = torch.tensor([-1, 0, -1, 3], dtype=torch.int32, device=depth.device)
        losses.store_rendered(places, depth, alpha)
        opaque = alpha > MIN_ALPHA
        inside = torch.stack([v.prior_depth >= 0 for v in self.views])[[1, 0, 2, 3]]
        shown = torch.where(opaque & inside, depth, 0.0)
        self.rendered = [shown[1], None, None, shown[3]]

    def launch(self, losses: WindowLosses) -> list[Tensor]:
        """Loss, gradients in the four maps, gradient in the pairs' motions."""
        depth, normal, alpha, spread = (m.float().contiguous() for m in self.maps)
        maps = [depth, normal.permute(0, 3, 1, 2).contiguous(), alpha, spread]
        gradients = [torch.full_like(m, 99.0) for m in maps]
        loss = torch.full((len(self.batch),), 99.0, device=depth.device)
        motion = None
        if losses._with_pose:
            motion = torch.full((*self.pairs.shape, 12), 99.0, device=depth.device).double()
        losses.launch(self.batch, self.pairs, *maps, *gradients, loss, motion)
        gradients[1] = gradients[1].permute(0, 2, 3, 1)
        return [loss, *gradients, *([] if motion is None else [motion])]

    def plain(self, config: LossConfig) -> list[Tensor]:
        """The same from the specification in float64."""
        leaves = [m.detach().clone().requires_grad_() for m in self.maps]
        depth, _, alpha, _ = leaves
        targets, losses = {}, []
        for i, slot in enumerate(self.batch.tolist()):
            loss = depth.new_zeros(())
            if slot >= 0:
                loss = single_view_loss(*(m[i] for m in leaves), self.views[slot], config, UNIT)
                opaque = alpha[i].detach() > MIN_ALPHA
                inside = self.views[slot].prior_depth >= 0
                shown = torch.where(opaque & inside, depth[i], 0.0)
                for j, other in enumerate(self.pairs[i].tolist()):
                    if other < 0:
                        continue
                    T = self.photos[other].T_cw.clone().requires_grad_()
                    targets[i, j] = T, self.photos[slot].T_cw
                    loss = loss + SHARE * multi_view_loss(
                        shown, self.photos[slot], self.photos[other].at(T), self.rendered[other],
                        config,
                    )  # fmt: skip
            losses.append(loss)
        total = torch.stack(losses)
        if total.requires_grad:
            total.sum().backward()
        motion = torch.zeros(*self.pairs.shape, 12, dtype=torch.float64, device=depth.device)
        for (i, j), (T, reference) in targets.items():
            # T_target = T T_reference, so d/dT = d/dT_target T_reference^T.
            if T.grad is not None:
                motion[i, j] = (T.grad @ reference.mT)[:3].reshape(12)
        zeros = [torch.zeros_like(m) if m.grad is None else m.grad for m in leaves]
        return [total.detach(), *zeros, motion]


def constants_on(view: ViewConstants, device: torch.device) -> ViewConstants:
    moved = {
        name: value.double().to(device)
        for name, value in vars(view).items()
        if isinstance(value, torch.Tensor)
    }
    return replace(view, **moved)


def photo_on(photo: PhotoView, device: torch.device) -> PhotoView:
    assert photo.colours is not None
    return replace(
        photo,
        grey=photo.grey.to(device),
        texture=photo.texture.to(device),
        noise=photo.noise.to(device),
        T_cw=photo.T_cw.to(device),
        colours=photo.colours.to(device),
    )


def spoil(maps: list[Tensor]) -> None:
    """Holes, NaN and infinity; alpha is partly below the threshold already."""
    depth, normal, alpha, spread = maps
    alpha.copy_(0.4 + 0.6 * alpha)
    alpha[:, 20:24, 5:12] = 0.3
    depth[0, 10:13, 20:26] = 0
    depth[0, 30, 40] = depth[1, 3, 3] = float("nan")
    depth[3, 17, 9] = float("inf")
    normal[1, 15, 15, 1] = normal[0, 16, 2] = float("nan")
    alpha[1, 7, 30] = float("nan")
    spread[3, 8, 8] = spread[3, 2, 8] = float("inf")


ACROSS = 1e-4
"""Part of the pixels that may lie on the other side of a threshold in float32: none in the
emulator's small images."""


def relative(a: Tensor, b: Tensor, left_out: float = 0.0) -> float:
    """The difference over the size of ``b``, without the part that differs most."""
    difference = (a.double() - b.double()).abs().flatten().sort().values
    kept = len(difference) - int(left_out * len(difference))
    return float(difference[:kept].norm() / b.double().norm())


def check(
    scene: Scene, config: LossConfig, with_pose: bool, tolerance: float = 6e-3, across: float = 0.0
) -> None:
    # Most of the difference is single pixels on the other side of a threshold; ``across`` is the
    # part of the depth's gradient that is left out for that.
    size = (len(scene.batch), scene.pairs.shape[1])
    losses = WindowLosses(scene.table, config, UNIT, *size, SHARE, with_pose)
    scene.show(losses)
    fast, slow = scene.launch(losses), scene.plain(config)
    assert fast[0].tolist() == pytest.approx(slow[0].tolist(), rel=3e-4, abs=1e-8)
    assert slow[0].norm() > 0
    for f, s, left_out in zip(fast[1:], slow[1:], [across, 0, 0, 0, 0], strict=False):
        assert torch.isfinite(f).all()
        if s.norm() == 0:
            assert (f == 0).all()
        else:
            assert relative(f, s, left_out) < tolerance
            assert (f[2] == 0).all()  # the empty place


SINGLE = {
    "depth": {"depth_weight": 2.0},
    "absolute depth": {"depth_weight": 2.0, "ablation": LossAblation(depth_relative=False)},
    "normal": {"normal_weight": 0.1},
    "consistency": {"normal_consistency_weight": 0.02},
    "distortion": {"distortion_weight": 0.1},
    "opacity": {"opacity_weight": 0.02},
    "smoothness": {"smoothness_weight": 0.1},
    "smoothness both": {
        "smoothness_weight": 0.1,
        "ablation": LossAblation(smoothness_rewards_edges=True),
    },
}
PAIRS = {
    "l1": {"l1_weight": 1.0},
    "l1 plain": {"l1_weight": 1.0, "l1_huber": 0.0, "l1_cut": 1.0, "photo_texture": 0.0},
    "l1 by texture": {"l1_weight": 1.0, "photo_texture": 200.0},
    "l1 by texture, ncc": {"l1_weight": 1.0, "photo_texture": 200.0, "ncc_weight": 0.5},
    "ncc": {"ncc_weight": 0.5},
    "ncc 3": {"ncc_weight": 0.5, "ncc_patch": 3},
    "ncc 11": {"ncc_weight": 0.5, "ncc_patch": 11, "ncc_reject": 1.5},
    "ssim": {"ssim_weight": 0.3},
    "colour": {"ssim_weight": 0.3, "l1_weight": 1.0, "ncc_weight": 0.5, "colour": True},
    "tau": {"l1_weight": 1.0, "occlusion_ratio": 0.05},
    "ssim, l1": {"ssim_weight": 0.3, "l1_weight": 1.0},
}
EVERYTHING = replace(
    LossConfig(), normal_weight=0.1, smoothness_weight=0.1, ssim_weight=0.3,
    ablation=LossAblation(smoothness_rewards_edges=True),
)  # fmt: skip


@pytest.mark.parametrize("name", SINGLE)
def test_each_single_view_term_matches_the_plain_loss(name: str, device: torch.device) -> None:
    check(Scene.make(device), replace(NOTHING, **SINGLE[name]), False, tolerance=2e-4)


def test_smoothness_divides_by_the_lower_median(device: torch.device) -> None:
    scene = Scene.make(device)
    losses = WindowLosses(scene.table, EVERYTHING, UNIT, 4, 2, SHARE)
    for holes in (0, 1):
        scene.maps[0][1, -1, :holes] = 0
        scene.launch(losses)
        for i in (0, 1, 3):
            depth, alpha = scene.maps[0][i].float(), scene.maps[2][i]
            inside = scene.views[int(scene.batch[i])].prior_depth >= 0
            known = depth[inside & (alpha > 0.5) & (depth > 0) & torch.isfinite(depth)]
            assert float(losses._inverse_median[i]) == pytest.approx(
                1 / float(known.median()), rel=1e-6
            )


@pytest.mark.parametrize("name", PAIRS)
def test_each_multi_view_term_matches_the_plain_loss(name: str, device: torch.device) -> None:
    check(Scene.make(device), replace(NOTHING, **PAIRS[name]), True, across=ACROSS)


@pytest.mark.parametrize("zoom", [0.8, 1.0, 1.5, 2.0])
@pytest.mark.parametrize("config", [LossConfig(), EVERYTHING], ids=["default", "everything"])
def test_all_terms_together_match_the_plain_loss(
    zoom: float, config: LossConfig, device: torch.device
) -> None:
    check(Scene.make(device, zoom), config, zoom == 2.0)


def test_views_without_prior_normals_have_no_normal_term(device: torch.device) -> None:
    check(Scene.make(device, normals=False), EVERYTHING, False)


def test_a_window_may_be_empty(device: torch.device) -> None:
    scene = Scene.make(device)
    scene.batch.fill_(-1)
    losses = WindowLosses(scene.table, LossConfig(), UNIT, 4, 2, SHARE, with_pose=True)
    assert all((each == 0).all() for each in scene.launch(losses))


@pytest.mark.parametrize("value", [0.0, float("nan"), float("inf")])
def test_views_without_depth_give_no_loss_and_no_gradient(
    value: float, device: torch.device
) -> None:
    scene = Scene.make(device)
    scene.maps = [torch.full_like(m, value) for m in scene.maps]
    config = replace(EVERYTHING, opacity_weight=0.0, silhouette_weight=0.0)
    losses = WindowLosses(scene.table, config, UNIT, 4, 2, SHARE, with_pose=True)
    assert all((each == 0).all() for each in scene.launch(losses))


def test_only_visible_depth_is_stored(device: torch.device) -> None:
    scene = Scene.make(device)
    losses = WindowLosses(scene.table, LossConfig(), UNIT, 4, 2, SHARE)
    depth, alpha = scene.maps[0].float(), scene.maps[2].float()
    losses.store_rendered(scene.batch, depth, alpha)
    known = (depth > 0) & torch.isfinite(depth) & (alpha > 0.5)
    for i, slot in enumerate([2, 0, -1, 3]):
        if slot >= 0:
            inside = scene.views[slot].prior_depth >= 0
            expected = torch.where(known[i] & inside, depth[i], 0.0)
            assert torch.equal(scene.table.rendered_depth(slot), expected)
    assert scene.table.rendered[:4].tolist() == [1, 0, 1, 1]
    scene.table.forget_rendered()
    assert not scene.table.rendered.any()


def test_the_table_grows_and_says_so(device: torch.device) -> None:
    scene = Scene.make(device)
    table, pointers = scene.table, scene.table.pointers.clone()
    assert (len(table), table.generation, len(table.pointers)) == (4, 1, 4)
    slot = table.add(scene.views[0], photo_on(scene.photos[0], torch.device("cpu")))
    assert (slot, len(table), table.generation, len(table.pointers)) == (4, 5, 2, 8)
    assert torch.equal(table.pointers[:4], pointers)
    assert torch.equal(table.poses[4], table.poses[0])


def test_losses_follow_new_poses_and_constants(device: torch.device) -> None:
    scene = Scene.make(device)
    losses = WindowLosses(scene.table, LossConfig(), UNIT, 4, 2, SHARE)
    before = scene.launch(losses)
    poses = [p.T_cw for p in scene.photos]
    shift = se3_exp(torch.tensor([0.01, 0.02, 0.0, 0.001, 0.0, 0.002]).double()).to(device)
    scene.photos[0] = scene.photos[0].at(shift @ poses[0])
    scene.photos[3] = scene.photos[3].at(poses[3] @ shift)
    scene.table.set_poses([3, 0], torch.stack([scene.photos[3].T_cw, scene.photos[0].T_cw]))
    changed = replace(scene.views[2], prior_depth=1.1 * scene.views[2].prior_depth)
    scene.views[2] = changed
    scene.table.set_constants(2, changed)
    fast, slow = scene.launch(losses), scene.plain(LossConfig())
    assert relative(fast[0], slow[0]) < 3e-4 < relative(before[0], slow[0])
    assert relative(fast[1], slow[1], ACROSS) < 3e-3


@pytest.mark.gpu
def test_a_captured_launch_follows_its_inputs() -> None:
    if not torch.cuda.is_available():
        pytest.skip("there is no GPU")
    scene = Scene.make(torch.device("cuda"))
    losses = WindowLosses(scene.table, EVERYTHING, UNIT, 4, 2, SHARE)
    scene.launch(losses)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        captured = scene.launch(losses)
    for batch in ([0, 1, 2, 3], [3, -1, 0, 1]):
        scene.batch.copy_(torch.tensor(batch, dtype=torch.int32))
        graph.replay()
        again = scene.launch(losses)
        for a, b in zip(captured, again, strict=True):
            assert relative(a, b) < 1e-5
