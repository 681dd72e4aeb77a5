"""The CUDA keyframe depth against the CPU's, stage by stage and as a whole."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
import torch

from cuda_emulator import use_emulator
from depth_scene import WORKING, DepthScene, fattened, make_scene, trace
from geogs.config import DepthConfig
from geogs.depth import plane_sweep as cpu_sweep
from geogs.depth import plane_sweep_kernels as sweep_loops
from geogs.depth import refinement as cpu_refinement
from geogs.depth.carve import vote
from geogs.depth.classical import CpuDepthEngine
from geogs.depth.confidence import depth_confidence
from geogs.depth.cuda import classical as engine_module
from geogs.depth.cuda import plane_sweep as sweep_module
from geogs.depth.cuda import refinement as refine_module
from geogs.depth.cuda import revision as check_module
from geogs.depth.cuda.classical import CudaDepthEngine
from geogs.depth.cuda.images import KeyframeImages, packed
from geogs.depth.cuda.plane_sweep import PlaneSlots, SweptDepth
from geogs.depth.cuda.refinement import PixelPositions, SlantedMaps, TrackerMaps
from geogs.depth.depth_engine import DepthTask
from geogs.depth.depth_view import DenseDepth, KeyframeDepth, PosedDepth, homographies
from geogs.depth.edges import resolve_edges
from geogs.depth.evidence import (
    TrackerEvidence,
    choose_start,
    prior_weight,
    relative_precision,
    tracker_evidence,
)
from geogs.depth.grid_completion import (
    complete_grid,
    complete_inverse_depth,
    known_cells,
    upsample_grid,
)
from geogs.depth.plane_sweep import SweepResult, matching_costs, plane_sweep
from geogs.geometry.camera import Camera

F = np.float32


@dataclass(frozen=True)
class Setting:
    """Where the kernels run, and on what."""

    device: torch.device
    working: Camera
    render: Camera
    scene: DepthScene
    most_planes: int

    @property
    def planes(self) -> np.ndarray:
        return np.linspace(0.2, 0.8, self.most_planes, dtype=F)


def _setting(device: str, working: Camera, scale: float, most_planes: int) -> Setting:
    render = working.resized(round(working.width / scale), round(working.height / scale))
    scene = make_scene(working=working, render=render)
    return Setting(torch.device(device), working, render, scene, most_planes)


@pytest.fixture(scope="module")
def settings() -> dict[str, Setting]:
    """Made once each."""
    return {}


@pytest.fixture(params=["emulated", pytest.param("gpu", marks=pytest.mark.gpu)])
def setting(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, settings: dict[str, Setting]
) -> Setting:
    """A few pixels in the emulator; the real size on a GPU."""
    if request.param == "emulated":
        use_emulator(monkeypatch, engine_module, sweep_module, refine_module, check_module)
        monkeypatch.setattr(cpu_sweep, "SUPPORT_RADIUS", 2)
        most_planes, device, size = 29, "cpu", (WORKING.resized(37, 30), 1.6)
    elif torch.cuda.is_available():
        most_planes, device, size = DepthConfig.planes, "cuda", (WORKING.resized(512, 384), 1.6)
    else:
        pytest.skip("needs an NVIDIA GPU")
    if request.param not in settings:
        settings[request.param] = _setting(device, *size, most_planes)
    return settings[request.param]


def _random(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random(shape).astype(F)


def _to(setting: Setting, array: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(array)).to(setting.device)


def _by_plane(volume: torch.Tensor, planes: PlaneSlots) -> np.ndarray:
    """A volume of slots as (..., planes)."""
    plane = np.arange(planes.count)
    return volume.cpu().numpy()[..., plane % planes.per * 32 + plane // planes.per]


def _by_slot(setting: Setting, volume: np.ndarray, planes: PlaneSlots) -> torch.Tensor:
    """The inverse of ``_by_plane``, FAR where there is no plane."""
    plane = np.arange(planes.count)
    out = np.full((*volume.shape[:-1], 32 * planes.per), sweep_loops.FAR, F)
    out[..., plane % planes.per * 32 + plane // planes.per] = volume
    return _to(setting, out)


def _close(a: torch.Tensor, b: np.ndarray, tolerance: float, share: float = 1.0) -> None:
    """Relative to 1 + |b|, on at least a share of the elements."""
    off = np.abs(a.cpu().numpy() - b) / (1.0 + np.abs(b))
    assert np.isfinite(off).all()
    assert (off < tolerance).mean() >= share, np.sort(off.ravel())[::-1][:5]


@pytest.mark.parametrize("window", [3, 5])
def test_matching_costs(setting, window):
    reference, *others = setting.scene.views
    planes = PlaneSlots.of(setting.planes, setting.device)
    images = [KeyframeImages.of(v, setting.device) for v in setting.scene.views]
    across = packed(*homographies(reference, others, setting.render, setting.render))
    volume = sweep_module.match_planes(
        images[0].grey, torch.stack([i.grey for i in images[1:]]), _to(setting, across), planes,
        window,
    )  # fmt: skip
    expected = matching_costs(reference, others, setting.render, setting.planes, window)
    # Samples at the very border of an image fall on one side of it or the other.
    _close(torch.from_numpy(_by_plane(volume, planes)), expected, 2e-3, 0.999)


def test_planes_fill_the_lanes_of_a_warp_in_order(setting):
    for count in (29, 72, 100, 144, 256):
        rho = np.linspace(0.1, 1.0, count, dtype=F)
        planes = PlaneSlots.of(rho, setting.device)
        assert np.array_equal(_by_plane(planes.rho, planes), rho)
        assert int((planes.rho < 0).sum()) == len(planes.rho) - count
    with pytest.raises(ValueError, match="257"):
        PlaneSlots.of(np.linspace(0.1, 1.0, 257, dtype=F), setting.device)


@pytest.mark.parametrize("count", [30, 40])
def test_support_average_and_prior(setting, count):
    h, w = 9, 11
    rho = np.linspace(0.2, 0.8, count, dtype=F)
    planes = PlaneSlots.of(rho, setting.device)
    volume, colours = _random(h, w, count), _random(h, w, 3, seed=1)
    prior, weight = F(0.3) + F(0.2) * _random(h, w, seed=2), _random(h, w, seed=3)
    weight[2:5] = 0.0
    expected = np.empty_like(volume)
    radius, sharpness = cpu_sweep.SUPPORT_RADIUS, F(cpu_sweep.SUPPORT_SHARPNESS)
    sweep_loops.average_support(0, len(volume), volume, colours, radius, sharpness, expected)
    pull = F(cpu_sweep.PRIOR_PULL) * weight
    sweep_loops.pull_to_prior(
        0, len(expected), expected, rho, prior, pull, F(cpu_sweep.PRIOR_TOLERANCE)
    )
    out = sweep_module.average_support(
        _by_slot(setting, volume, planes), _to(setting, colours.transpose(2, 0, 1)), planes,
        _to(setting, prior), _to(setting, weight),
    )  # fmt: skip
    _close(torch.from_numpy(_by_plane(out, planes)), expected, 1e-4)


@pytest.mark.parametrize(("count", "size"), [(30, (8, 11)), (40, (7, 5)), (144, (4, 5))])
def test_path_costs_and_winners(setting, count, size):
    h, w = size if setting.device.type == "cpu" else (90, 161)
    rho = np.linspace(0.2, 0.8, count, dtype=F)
    planes = PlaneSlots.of(rho, setting.device)
    volume, guide = _random(h, w, count), _random(h, w, seed=1)
    total = np.zeros_like(volume)
    small, large, edge = cpu_sweep.SMALL_JUMP, cpu_sweep.LARGE_JUMP, cpu_sweep.JUMP_CONTRAST
    for forward in (True, False):
        sweep_loops.aggregate_paths(volume, guide, F(small), F(large), F(edge), forward, total)
    slots = _by_slot(setting, volume, planes)
    paths = sweep_module.follow_paths(slots, _to(setting, guide), planes)
    _close(torch.from_numpy(_by_plane(paths.sum(0), planes)), total, 1e-4)
    expected = [np.empty((h, w), F) for _ in range(3)]
    sweep_loops.pick_planes(0, len(total), total, volume, *expected)
    won = sweep_module.pick_planes(paths, slots, planes)
    position = (won.inverse_depth.cpu() - planes.first) / planes.spacing
    for a, b in zip((position, won.cost, won.margin), expected, strict=True):
        _close(a, b, 2e-3, 0.999)


def _tracker(setting: Setting) -> TrackerEvidence:
    view = setting.scene.views[0]
    completed = complete_inverse_depth(view.inverse_depth, view.information, view.image)
    return tracker_evidence(completed, setting.working, setting.render)


def _maps(setting: Setting) -> TrackerMaps:
    tracker = _tracker(setting)
    maps = (tracker.inverse_depth, tracker.prior_weight, tracker.precision)
    return TrackerMaps(*(_to(setting, m) for m in maps))


def test_grids_are_upsampled_and_patches_gathered_as_opencv_does(setting):
    view = setting.scene.views[0]
    grids = np.stack([_random(*view.inverse_depth.shape, seed=s) for s in range(3)])
    places = PixelPositions.of(setting.render, setting.working, setting.device)
    maps = TrackerMaps.of(_to(setting, grids), places)
    upsampled = (maps.inverse_depth, maps.prior_weight, maps.precision)
    # Before version 5, OpenCV interpolates with weights rounded to 1/32.
    rounding = 1e-5 if cv2.__version__ >= "5" else 0.03
    for grid, out in zip(grids, upsampled, strict=True):
        _close(out, upsample_grid(grid, setting.working, setting.render), rounding)
    patches = cpu_refinement._gather_patches(
        view, setting.scene.views[1:], setting.render, setting.working
    )
    images = KeyframeImages.of(view, setting.device)
    _close(refine_module.gather_patches(images.fine, places), patches.samples, rounding)
    guide = cpu_refinement.colour_guide(view, setting.render)
    _close(images.colours, guide, 1e-6)


@pytest.mark.system
@pytest.mark.parametrize(
    "shape", [*(pytest.param(s, marks=pytest.mark.long) for s in ((6, 11), (9, 5))), (3, 4)]
)
def test_completed_grids(setting, shape):
    shape = tuple(7 * n for n in shape)
    v, u = np.mgrid[: shape[0], : shape[1]]
    grids, typical, expected = [], [], []
    for seed in range(2):
        grid = (
            0.4 + 0.2 * u / shape[1] - 0.1 * v / shape[0] + 0.03 * _random(*shape, seed=seed)
        ).astype(F)
        information = F(2e3) * _random(*shape, seed=2 + seed) ** 2
        grid[1, 2], grid[0, 1], information[-2:, -3:] = 1.9, np.nan, 0.0
        smooth = np.exp(-2 * _random(*shape, seed=4 + seed))
        known = known_cells(grid, information)
        done = complete_grid(grid, information, smooth)
        assert not done.inlier[1, 2]
        evidence = (done.inverse_depth, prior_weight(done), relative_precision(done))
        grids.append(np.stack([grid, information, smooth]))
        typical.append(float(np.median(grid[known])))
        expected.append(np.stack(evidence))
    assert engine_module.can_complete(shape, setting.device)
    out = engine_module.complete(_to(setting, np.stack(grids)), typical).cpu()
    for got, want in zip(out, expected, strict=True):
        assert np.abs(got[0].numpy() / want[0] - 1).max() < 1e-5
        _close(got[1], want[1], 1e-5)
        _close(got[2], want[2], 2e-3)


def test_grids_too_large_for_the_gpu_or_without_knowledge_are_completed_on_the_cpu(setting):
    assert not engine_module.can_complete((120, 100), setting.device)
    _, cuda = _engines(setting)
    view = setting.scene.views[0]
    lost = replace(view, information=0 * view.information)
    for views in ([view, lost], [view]):
        for v in views:
            cuda.observe(v)
        grids = cuda._complete([cuda._plan(DepthTask(v, [])) for v in views]).cpu().numpy()
        for got, v in zip(grids, views, strict=True):
            done = complete_inverse_depth(v.inverse_depth, v.information, v.image)
            assert np.abs(got[0] / done.inverse_depth - 1).max() < 1e-4
            assert np.abs(got[1] - prior_weight(done)).max() < 1e-4


def test_start_is_the_surer_of_sweep_and_tracker(setting):
    tracker = _tracker(setting)
    shape = tracker.prior_weight.shape
    swept = tracker.inverse_depth * (F(0.9) + F(0.2) * _random(*shape))
    cost, margin = _random(*shape, seed=1), F(4.0) * _random(*shape, seed=2)
    costs = np.zeros((*shape, setting.most_planes), F)
    expected = choose_start(tracker, SweepResult(swept, cost, margin, setting.planes, costs))
    slots = PlaneSlots.of(setting.planes, setting.device)
    maps = SweptDepth(
        *(_to(setting, m) for m in (swept, cost, margin)), slots, _by_slot(setting, costs, slots)
    )
    rho, sure = refine_module.choose_start(_maps(setting), maps)
    _close(rho, expected[0], 1e-6)
    _close(sure, expected[1], 1e-5)


def test_photometric_step(setting):
    views = setting.scene.views
    patches = cpu_refinement._gather_patches(views[0], views[1:], setting.render, setting.working)
    tracker = _tracker(setting)
    shape = setting.scene.truth[0].shape
    rho = (1.0 / setting.scene.truth[0]) * (F(0.98) + F(0.04) * _random(*shape))
    slopes = [F(1e-3) * _random(*shape, seed=s) for s in (1, 2)]
    state = cpu_refinement.SlantedDepth(rho, *slopes, np.zeros_like(rho))
    photo = cpu_refinement._photometric_step(state, patches)
    misfit = (tracker.inverse_depth / state.inverse_depth - 1.0) ** 2 * tracker.precision
    known = tracker.precision / (1.0 + misfit / 4.0)
    data = (photo * state.inverse_depth + known * tracker.inverse_depth) / (photo + known)
    images = [KeyframeImages.of(v, setting.device) for v in views]
    finely = packed(*homographies(views[0], views[1:], setting.render, setting.working))
    maps = SlantedMaps(*(_to(setting, m) for m in (rho, *slopes, 0 * rho)))
    precision, sure = refine_module.photometric_step(
        maps, _to(setting, patches.samples), torch.stack([i.fine for i in images[1:]]),
        _to(setting, finely), _maps(setting),
    )  # fmt: skip
    _close(maps.inverse_depth, data, 1e-4, 0.995)
    _close(precision, photo + known, 1e-2, 0.995)
    expected = 1.0 / (1.0 + 1.0 / ((photo + known) * F(cpu_refinement.FIT_DEVIATION**2))) + F(1e-3)
    _close(sure, expected, 1e-3, 0.995)


def test_plane_fits_with_and_without_averaging(setting):
    h, w = (13, 18) if setting.device.type == "cpu" else (180, 320)
    rho, sure = F(0.5) + F(0.02) * _random(h, w), _random(h, w, seed=1) + F(0.1)
    slopes = [F(4e-3) * _random(h, w, seed=s) for s in (2, 3)]
    colours, precision = _random(3, h, w, seed=4), F(1e5) * _random(h, w, seed=5)
    cpu = cpu_refinement.SlantedDepth(rho, *slopes, np.zeros_like(rho))
    cpu_refinement._fit_planes(cpu, sure, colours, 4, 0.03, 0.5)
    plane = np.minimum(cpu.support / F(cpu_refinement.FULL_SUPPORT), F(1.0))
    plane = plane * F(1.0 / cpu_refinement.PLANE_DEVIATION**2)
    averaged = (precision * rho + plane * cpu.inverse_depth) / (precision + plane)
    for weight, expected in ((None, cpu.inverse_depth), (precision, averaged)):
        maps = SlantedMaps(*(_to(setting, m) for m in (rho, *slopes, 0 * rho)))
        given = None if weight is None else _to(setting, weight)
        refine_module.fit_planes(
            maps, _to(setting, sure), _to(setting, colours), 4, 0.03, 0.5, given
        )
        _close(maps.inverse_depth, expected, 2e-5)
        _close(maps.slope_x, cpu.slope_x, 2e-5)
        _close(maps.slope_y, cpu.slope_y, 2e-5)
        _close(maps.support, cpu.support, 1e-4)


def test_confidence(setting):
    tracker = _tracker(setting)
    shape = tracker.precision.shape
    rho = tracker.inverse_depth * (F(0.95) + F(0.1) * _random(*shape))
    margin, support = F(5.0) * _random(*shape, seed=1), F(20.0) * _random(*shape, seed=2)
    near, far = float(1.0 / np.median(rho)), float(2.0 / rho.min())
    held = np.clip(rho, 0.5 / far, 2.0 / near).astype(F)
    zero = np.zeros_like(rho)
    refined = cpu_refinement.SlantedDepth(held, zero, zero, support)
    expected = depth_confidence(refined, margin, tracker)
    maps = SlantedMaps(*(_to(setting, m) for m in (rho, zero, zero, support)))
    confidence = refine_module.judge(maps, _to(setting, margin), _maps(setting), near, far)
    _close(maps.inverse_depth, held, 1e-6)
    _close(confidence, expected, 1e-4)


def test_edges(setting):
    shape = setting.scene.truth[0].shape
    refined, confidence, guide, swept = fattened(*shape)
    expected, sure = resolve_edges(refined, confidence, guide, swept)
    slots = PlaneSlots.of(swept.planes, setting.device)
    zero = _to(setting, 0 * confidence)
    costs = _by_slot(setting, swept.costs, slots)
    planes = (refined.inverse_depth, refined.slope_x, refined.slope_y, refined.support)
    got, got_sure = refine_module.resolve_edges(
        SlantedMaps(*(_to(setting, m) for m in planes)), _to(setting, confidence),
        _to(setting, guide), SweptDepth(zero, zero, zero, slots, costs),
    )  # fmt: skip
    assert float((expected.inverse_depth != refined.inverse_depth).mean()) > 0.01
    _close(got.inverse_depth, expected.inverse_depth, 1e-4, 0.998)
    _close(got.slope_x, expected.slope_x, 1e-4, 0.998)
    _close(got.slope_y, expected.slope_y, 1e-4, 0.998)
    _close(got_sure, sure, 1e-3, 0.998)


def _engines(setting: Setting) -> tuple[CpuDepthEngine, CudaDepthEngine]:
    cameras = (setting.render, setting.working)
    return (
        CpuDepthEngine(*cameras, setting.most_planes),
        CudaDepthEngine(setting.device, *cameras, 128, setting.most_planes),
    )


def test_sweep_of_a_view(setting):
    reference, *others = setting.scene.views
    tracker = _tracker(setting)
    expected = plane_sweep(
        reference, others, setting.render, setting.planes, tracker.inverse_depth,
        tracker.prior_weight,
    )  # fmt: skip
    images = [KeyframeImages.of(v, setting.device) for v in setting.scene.views]
    across = packed(*homographies(reference, others, setting.render, setting.render))
    maps = _maps(setting)
    swept = sweep_module.sweep(
        images[0], torch.stack([i.grey for i in images[1:]]), _to(setting, across),
        PlaneSlots.of(setting.planes, setting.device), maps.inverse_depth, maps.prior_weight,
    )  # fmt: skip
    _close(swept.inverse_depth, expected.inverse_depth, 1e-3, 0.99)
    _close(swept.cost, expected.cost, 2e-3, 0.99)
    _close(swept.margin, expected.margin, 5e-3, 0.98)


def test_whole_estimate(setting):
    cpu, cuda = _engines(setting)
    views = setting.scene.views
    (expected,) = cpu.estimate([DepthTask(views[0], views[1:])])
    done: list[float] = []
    (depth,) = cuda.estimate([DepthTask(views[0], views[1:])], done.append)
    assert done == [1.0]
    off = (depth.depth.cpu() / expected.depth - 1).abs()
    assert float((off < 1e-3).float().mean()) > 0.98
    unsure = (depth.confidence.cpu() - expected.confidence).abs()
    assert float((unsure < 0.01).float().mean()) > 0.97
    assert depth.typical == pytest.approx(expected.typical, rel=5e-3)


def test_estimate_between_given_limits(setting):
    cpu, cuda = _engines(setting)
    views = setting.scene.views
    tasks = [DepthTask(views[0], views[1:], (2.6, 5.0))]
    (expected,), (depth,) = (e.estimate(tasks) for e in (cpu, cuda))
    off = (depth.depth.cpu() / expected.depth - 1).abs()
    assert float((off < 1e-3).float().mean()) > 0.98


def test_without_neighbours_the_completed_tracker_remains(setting):
    cpu, cuda = _engines(setting)
    (expected,), (depth,) = (
        e.estimate([DepthTask(setting.scene.views[0], [])]) for e in (cpu, cuda)
    )
    _close(depth.depth, expected.depth.numpy(), 1e-5)
    _close(depth.confidence, expected.confidence.numpy(), 1e-5)
    assert cuda.estimate([]) == []


@pytest.mark.parametrize("how", ["bad values", "nothing known, black images"])
def test_hopeless_input_gives_finite_depth(setting, how):
    views = setting.scene.views[:3]
    if how == "bad values":
        inverse = views[0].inverse_depth.copy()
        inverse.ravel()[:4] = [np.nan, 0.0, -1.0, np.inf]
        views = [replace(views[0], inverse_depth=inverse), *views[1:]]
    else:
        v = views[0]
        black = {"grey": 0 * v.grey, "fine": 0 * v.fine, "image": 0 * v.image}
        views = [replace(v, information=0 * v.information, **black) for v in views]
    _, cuda = _engines(setting)
    (depth,) = cuda.estimate([DepthTask(views[0], views[1:])])
    assert bool(torch.isfinite(depth.depth).all() & (depth.depth > 0).all())
    assert bool(torch.isfinite(depth.confidence).all())
    if how != "bad values":
        assert float(depth.confidence.max()) < 0.6


def _disturbed(setting: Setting) -> list[KeyframeDepth]:
    """True depths with noise, patches that are wrong, and confidences all over."""
    random = np.random.default_rng(3)
    depths = []
    for z in setting.scene.truth:
        noisy = z * (1 + 0.01 * random.standard_normal(z.shape)).astype(F)
        h, w = z.shape
        noisy[h // 6 : h // 2, w // 8 : w // 2] *= F(0.7)
        confidence = random.random(z.shape).astype(F)
        depths.append(KeyframeDepth(noisy, confidence))
    return depths


def _posed(setting: Setting, depths: list[KeyframeDepth], device: str) -> list[PosedDepth]:
    out = []
    for view, depth in zip(setting.scene.views, depths, strict=True):
        d = DenseDepth.of(depth)
        d = replace(d, depth=d.depth.to(device), confidence=d.confidence.to(device))
        out.append(PosedDepth(view.T_cw, d))
    return out


def test_check(setting):
    cpu, cuda = _engines(setting)
    depths = _disturbed(setting)
    here, there = _posed(setting, depths, "cpu"), _posed(setting, depths, str(setting.device))
    expected = cpu.check(here[:2], [here[1:], []])
    checked = cuda.check(there[:2], [there[1:], []])
    repaired = expected[0].depth.numpy() / depths[0].depth
    assert (np.abs(repaired - 1) > 0.1).mean() > 0.005
    # A point may fall on the next pixel, for a rounding.
    _close(checked[0].depth, expected[0].depth.numpy(), 1e-3, 0.99)
    _close(checked[0].confidence, expected[0].confidence.numpy(), 2e-3, 0.99)
    assert torch.equal(checked[1].depth.cpu(), expected[1].depth)


def test_votes_on_points(setting, monkeypatch):
    cpu, cuda = _engines(setting)
    depths = _disturbed(setting)
    here, there = _posed(setting, depths, "cpu"), _posed(setting, depths, str(setting.device))
    T_wc = np.linalg.inv(setting.scene.views[0].T_cw)
    points = trace(setting.render, T_wc)[1].reshape(-1, 3).astype(F)
    points *= np.random.default_rng(1).uniform(0.6, 1.2, (len(points), 1)).astype(F)
    points[0, 0], points[3, 2] = np.nan, np.inf
    expected = cpu.keep(torch.from_numpy(points), here)
    assert 0.1 < float(expected.float().mean()) < 0.95
    kept = cuda.keep(_to(setting, points), there)
    assert float((kept.cpu() == expected).float().mean()) > 0.995
    assert not kept[0]
    assert not kept[3]
    poses, arrays = [v.T_cw for v in setting.scene.views], depths
    assert np.array_equal(
        expected.numpy(), vote(points, zip(poses, arrays, strict=True), setting.render)
    )
    monkeypatch.setattr(check_module, "VOTERS_TOGETHER", 1)
    assert torch.equal(cuda.keep(_to(setting, points), there), kept)
    alone = cuda.keep(_to(setting, points), [])
    assert int(alone.sum()) == len(points) - 2
    sky = torch.zeros(depths[0].depth.shape, dtype=torch.bool)
    sky[:, : sky.shape[1] // 2] = True
    here, there = ([_under(sky, d) for d in posed] for posed in (here, there))
    through = cpu.keep(torch.from_numpy(points), here)
    assert float((expected & ~through).float().mean()) > 0.1
    kept = cuda.keep(_to(setting, points), there)
    assert float((kept.cpu() == through).float().mean()) > 0.995


def _under(sky: torch.Tensor, posed: PosedDepth) -> PosedDepth:
    return replace(posed, depth=posed.depth.under(sky.to(posed.depth.depth.device)))
