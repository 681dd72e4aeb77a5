"""Renderings of many keyframes: few in memory, the same as all at once."""

from collections.abc import Callable, Sequence
from weakref import WeakSet

import numpy as np
import pytest
import torch

from depth_scene import make_scene
from geogs.application.progress.run_progress import RunProgress
from geogs.application.results.result_page import write_page, write_pictures
from geogs.application.results.surfaces import fusion_views, splat_colours, write_surface
from geogs.config import MeshConfig
from geogs.geometry.camera import Camera
from geogs.mapping.rendered import SurfaceRules, rendered_keyframe, stored_render
from geogs.mesh.extract import extract_mesh
from geogs.on_demand import OnDemand
from geogs.reconstruction import Reconstruction
from geogs.types import MapSnapshot, RenderedKeyframe, Trajectory
from geogs.world.archive import Archive
from geogs.world.disks import DiskParameters
from posed_scene import ball_and_wall

CAMERA = Camera(120.0, 120.0, 79.5, 59.5, 160, 120)


def plane(number: int, distance: float = 2.0) -> RenderedKeyframe:
    """A wall in front of a camera that moves sideways, under random weights of it."""
    random = torch.Generator().manual_seed(number)
    depth = torch.full((120, 160), distance)
    depth[:4] = 0.0
    normal = torch.nn.functional.normalize(torch.randn(120, 160, 3, generator=random), dim=-1)
    T_cw = torch.eye(4, dtype=torch.float64)
    T_cw[0, 3] = -0.02 * number
    image = np.full((12, 16, 3), number % 256, np.uint8)
    weight = torch.rand(120, 160, generator=random)
    return RenderedKeyframe(number, CAMERA, T_cw, depth, normal, weight, image, float(number))


def stored(
    renders: Sequence[RenderedKeyframe], counts: list[int] | None = None
) -> Sequence[RenderedKeyframe]:
    """As read from a file; ``counts`` receives how many depth maps are in memory after each."""
    archive = Archive()
    held: WeakSet[torch.Tensor] = WeakSet()

    def loaded(load: Callable[[], RenderedKeyframe]) -> RenderedKeyframe:
        render = load()
        held.add(render.depth)
        if counts is not None:
            counts.append(len(held))
        return render

    return OnDemand([stored_render(r, archive.put(r.image).load, archive) for r in renders], loaded)


def test_elements_are_made_when_they_are_asked_for():
    made = []

    def square(n: int) -> int:
        made.append(n)
        return n * n

    sequence = OnDemand(range(6), square)
    assert len(sequence) == 6
    part = sequence[1::2]
    assert len(part) == 3
    assert made == []
    assert sequence[-1] == 25
    assert part[-1] == 25
    assert made == [5, 5]
    assert list(part) == [1, 9, 25]
    assert list(sequence[::-1]) == [25, 16, 9, 4, 1, 0]
    with pytest.raises(IndexError):
        sequence[6]
    nothing: Sequence[int] = OnDemand([], square)
    assert not nothing
    assert list(nothing) == list(nothing[2:]) == []


def test_what_is_stored_comes_back():
    renders = [plane(n) for n in range(5)]
    kept = stored(renders)
    for n, (own, back) in enumerate(zip(renders, kept, strict=True)):
        assert back.keyframe_id == n
        assert back.camera == CAMERA
        assert torch.equal(back.T_cw, own.T_cw)
        assert torch.equal(back.depth, own.depth)
        assert torch.equal(back.weight, own.weight)
        assert np.array_equal(back.image, own.image)
        error = (back.normal - own.normal).abs().max()
        assert 0 < error < 5e-4
        assert back.normal.dtype == torch.float32


def test_the_mesh_is_the_same_to_the_last_bit():
    """Of views that come from the file, few of which are in memory at a time."""
    renders = [plane(n) for n in range(20)]
    config = MeshConfig(min_component_faces=10, voxel=0.04, detail=0)
    expected = extract_mesh(fusion_views(renders), config)
    counts: list[int] = []
    mesh = extract_mesh(fusion_views(stored(renders, counts)), config)
    assert len(mesh.faces) > 1000
    for name in ("vertices", "faces", "normals", "colours"):
        assert np.array_equal(getattr(mesh, name), getattr(expected, name))
    assert max(counts) <= 3
    assert 3 * 20 <= len(counts) < 10 * 20


def test_results_hold_few_maps(tmp_path):
    """The surface as a file, the colours of disks and the report."""
    renders = [plane(n) for n in range(20)]
    counts: list[int] = []
    kept = stored(renders, counts)
    config = MeshConfig(min_component_faces=10, voxel=0.04)
    mesh = write_surface(tmp_path / "mesh.ply", kept, config, RunProgress())
    points = torch.rand(50, 3) + torch.tensor([0.0, 0.0, 1.5])
    disks = MapSnapshot(
        points, torch.eye(4)[:1].expand(50, 4), torch.full((50, 2), 0.05), torch.ones(50)
    )
    splat_colours(disks, fusion_views(kept))
    assert max(counts) <= 3
    T_wc = np.stack([torch.linalg.inv(r.T_cw).numpy() for r in renders])
    trajectory = Trajectory(np.arange(20.0), T_wc, np.ones(20, bool))
    write_pictures(tmp_path / "report", kept)
    write_page(tmp_path / "report", trajectory, kept, mesh, {"source": "wall"})
    assert max(counts) <= 8  # five that are shown


@pytest.fixture(scope="module")
def scene() -> Reconstruction:
    made = ball_and_wall(scale=3.0)
    made.finish()
    return made


def test_the_maps_of_a_scene_are_those_of_its_disks(scene):
    """Rendered at once, most in the file, in the world's units; later changes do not count."""
    mapper = scene.mapper
    renders = scene.renders()
    with torch.no_grad():
        rules = SurfaceRules.of(mapper.config)
        disks = DiskParameters.of(mapper.table.disks.snapshot())
        eager = [rendered_keyframe(mapper.views[i], disks, rules) for i in mapper.table.mapped]
        mapper.table.disks.position.add_(0.1)
    assert len(renders) == len(eager) == len(make_scene().views)
    for now, then in zip(renders, eager, strict=True):
        assert now.keyframe_id == then.keyframe_id
        ratio = now.depth[then.depth > 0] / then.depth[then.depth > 0]
        assert (ratio / ratio.median() - 1).abs().max() < 1e-6
        assert torch.equal(now.weight, then.weight)
        assert np.array_equal(now.image, then.image)
    assert isinstance(renders[-2:], Sequence)
    assert [r.keyframe_id for r in renders[-2:]] == mapper.table.mapped[-2:]


def test_depths_are_read_when_they_are_asked_for(scene):
    maps = scene.depth_maps()
    view = scene.mapper.views[scene.mapper.table.mapped[0]]
    first = maps[0].depth
    assert torch.equal(first, maps[0].depth)
    view.keyframe.rescale(2.0)
    assert torch.equal(2 * first, maps[0].depth)
    assert [m.keyframe_id for m in maps[-2:]] == scene.mapper.table.mapped[-2:]


def test_no_keyframes_give_no_maps():
    scene = Reconstruction(CAMERA)
    for maps in (scene.renders(), scene.depth_maps()):
        assert len(maps) == 0
        assert list(fusion_views(maps)) == []
