"""Warm-up that compiles all CPU kernels: a map and a mesh of a tiny wall."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, UInt8

from geogs.bundle.lens import LensBlock
from geogs.bundle.problem import BundleProblem
from geogs.bundle.shared import OPTIONS, solve_shared
from geogs.camera.shutter.angular_motion import AngularMotion, rotated
from geogs.camera.shutter.rates import FlowMeter, angular_velocity
from geogs.camera.shutter.rolling_camera import RollingCamera
from geogs.camera.shutter.rows import RowOffsets
from geogs.camera.shutter.shutter import Shutter
from geogs.config import MeshConfig, ReconstructConfig
from geogs.depth.depth_view import DenseDepth, KeyframeDepth, ViewPose
from geogs.depth.revision.segment_planes import on_planes
from geogs.geometry.camera import Camera
from geogs.loop.orb_features import orb_features
from geogs.loop.verification import FeatureView, TwoViewVerifier
from geogs.mapping.first_look import first_points
from geogs.mapping.known_poses import expect_depths
from geogs.mesh.extract import extract_mesh
from geogs.mesh.texture.textured import texture_mesh
from geogs.mesh.triangle_mesh import DepthMapView, median_edge
from geogs.reconstruction import Reconstruction
from geogs.threads import on_one_torch_thread
from geogs.tracking.flow.classical_flow import ClassicalFlow
from geogs.tracking.frames.row_errors import RowErrors
from geogs.types import Trajectory
from geogs.world.grid import SampleGrid

CAMERA = Camera(80.0, 80.0, 47.5, 35.5, 96, 72)
VIEWS, SHIFT = 6, 8
"""Number of pictures of the wall, and shift between two in pixels."""
BASELINE = 0.3
"""Distance between neighbouring cameras, which look straight at the wall."""
DEPTH = CAMERA.fx * BASELINE / SHIFT


@on_one_torch_thread
def rehearse(part: str) -> None:
    """Use the kernels of a part. ``search`` tracks the wall on a CPU and searches its depths,
    ``train`` trains its map, ``mesh`` extracts its mesh; ``look``, ``planes``, ``turn`` and
    ``lens`` are the steps that never run on a GPU."""
    for step in _STEPS[part]:
        step()


def _look() -> None:
    """Find first points of the wall from known poses."""
    poses = [ViewPose(number, _pose(number)) for number in range(VIEWS)]
    pictures = _pictures()
    first_points(poses, lambda number: (pictures[number], None), CAMERA, lambda done: None)


def _turn() -> None:
    """Estimate the rotation between two pictures, as for the rows of a rolling shutter."""
    meter = FlowMeter(RollingCamera(CAMERA))
    first, second, *_ = map(meter.small, _pictures())
    angular_velocity(meter.measure(first, second), 1.0, 0.1)
    rotated(np.zeros((1, 3)), np.zeros((1, 3)))


def _recognise() -> None:
    """Match two pictures by their features."""
    first, second, *_ = map(orb_features, _pictures())
    TwoViewVerifier(CAMERA).verify(FeatureView(first), FeatureView(second))


def _follow() -> None:
    """Measure flow from a picture to itself."""
    operator = ClassicalFlow(SampleGrid(CAMERA))
    image = operator.encode(_pictures()[0])
    here = operator.grid.pixels[None]
    operator.measure([image], [image], here, here)


def _lens() -> None:
    """Adjust two pictures with an unknown lens, and a rolling shutter."""
    grid = SampleGrid(CAMERA)
    times = np.arange(VIEWS) / 30
    T_cw = torch.stack([torch.from_numpy(_pose(number)) for number in range(VIEWS)])
    depth = torch.full((2, grid.size), 1 / DEPTH)
    free = torch.tensor([False, True])
    pixels = (grid.pixels - torch.tensor([SHIFT, 0.0]))[None]
    problem = BundleProblem(
        T_cw[:2],
        depth,
        torch.tensor([0]),
        torch.tensor([1]),
        free,
        free.new_ones(2),
        pixels=pixels,
        weight=torch.ones_like(pixels),
    )
    solve_shared(problem, LensBlock(CAMERA, grid.pixels), replace(OPTIONS, iterations=1))
    rows = RowOffsets(RollingCamera(CAMERA), CAMERA)
    seen = rows.seen(rows.nodes(AngularMotion(), 0.0), Shutter(0.02))
    way = Trajectory(times, torch.linalg.inv(T_cw).numpy(), np.ones(VIEWS, bool))
    RowErrors(grid, {0: seen}, range(VIEWS), way).of_pixels([0], pixels, depth[:1])


def _search() -> None:
    """Search depths of the wall, and check them against each other."""
    mapper = _scene().mapper
    points = DEPTH * CAMERA.rays(torch.float64).numpy()[::4, ::4].reshape(-1, 3)
    expect_depths(mapper.views.values(), points, mapper.cameras.working)
    mapper.search_depths([*mapper.views])
    mapper.check_depths()


def _train() -> None:
    """Train a map of the wall from known depths."""
    scene = _scene()
    mapper = scene.mapper
    size = mapper.cameras.render.height, mapper.cameras.render.width
    depth = KeyframeDepth(np.full(size, DEPTH, np.float32), np.ones(size, np.float32))
    for view in mapper.views.values():
        view.set_depth(DenseDepth.of(depth))
    mapper.table.mapped = [*mapper.views]
    mapper.grow()
    mapper.train(VIEWS)
    list(scene.renders())


def _scene() -> Reconstruction:
    config = ReconstructConfig()
    mapping = replace(config.mapping, render_long_edge=48)
    scene = Reconstruction(CAMERA, replace(config, mapping=mapping), "cpu")
    for number, picture in enumerate(_pictures()):
        scene.add(picture, _pose(number))
    return scene


def _bare() -> None:
    """Fill a textureless part of the wall by a plane, from the depth at its rim."""
    depth = np.full((CAMERA.height, CAMERA.width), DEPTH, np.float32)
    confidence = np.ones_like(depth)
    labels = np.zeros(depth.shape, np.int32)
    confidence[20:50, 20:70] = 0
    labels[20:50, 20:70] = 1
    on_planes(KeyframeDepth(depth, confidence), labels, None, 0)


def _mesh() -> None:
    views = [_seen(number) for number in range(VIEWS)]
    mesh = extract_mesh(views, MeshConfig(triangle_budget=500))
    texture_mesh(mesh, views, 2 * median_edge(mesh), 256)


_STEPS = {
    "search": (_turn, _recognise, _follow, _lens, _search, _bare),
    "train": (_train,),
    "mesh": (_mesh,),
    "turn": (_turn, _recognise),
    "lens": (_lens,),
    "look": (_look,),
    "planes": (_bare,),
}


def _seen(number: int) -> DepthMapView:
    """The true depth map of the wall."""
    depth = torch.full((CAMERA.height, CAMERA.width), DEPTH)
    pose = torch.from_numpy(_pose(number))
    picture = _pictures()[number]
    return DepthMapView(depth, torch.ones_like(depth), CAMERA, pose, picture)


def _pose(number: int) -> Float[np.ndarray, "4 4"]:
    T_cw = np.eye(4)
    T_cw[0, 3] = -BASELINE * number
    return T_cw


def _pictures() -> list[UInt8[np.ndarray, "h w 3"]]:
    """Pictures of the wall, which is parallel to all images: shifted parts of one texture."""
    import cv2

    random = np.random.default_rng(0)
    wall = random.integers(0, 256, (CAMERA.height, CAMERA.width + VIEWS * SHIFT, 3), np.uint8)
    wall = cv2.GaussianBlur(wall, (5, 5), 0)
    return [wall[:, SHIFT * n : SHIFT * n + CAMERA.width].copy() for n in range(VIEWS)]
