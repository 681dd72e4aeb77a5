"""Every parser of files from outside: a small good example of each, and what reads it."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from hypothesis import strategies as st
from safetensors.torch import save_file

import mutations
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_exp
from io_samples import gradient_image, write_image, write_video
from posed_layouts import (
    Room,
    write_colmap_binary,
    write_colmap_text,
    write_dtu,
    write_nerfstudio,
    write_replica,
    write_room_images,
    write_scannet,
    write_seven_scenes,
    write_tum,
)

Damage = Callable[[bytes], st.SearchStrategy[bytes]]


@dataclass(frozen=True)
class Parser:
    """What reads a kind of file."""

    write: Callable[[Path], object]
    """Puts a good example into an empty folder."""
    files: tuple[str, ...]
    """Those of the example that are damaged, by their names in the folder."""
    damage: Damage
    read: Callable[[Path], object]
    """Reads the example in a folder."""


def tiny_room() -> Room:
    """Three images of a camera that moves to the right."""
    camera = Camera(50.0, 51.0, 31.0, 24.0, 64, 48)
    tangents = [[-0.1 * i, 0.0, 0.0, 0.0, 0.02 * i, 0.0] for i in range(3)]
    T_cw = se3_exp(torch.tensor(tangents, dtype=torch.float64)).numpy()
    points = np.array([[0.0, 0.1, 2.0], [0.1, 0.0, 3.0]])
    return Room(camera, [gradient_image(i) for i in range(3)], T_cw, points, [[0, 1], [1, 2]])


def write_depth(path: Path) -> None:
    """A picture of depth in 16 bits."""
    path.parent.mkdir(parents=True, exist_ok=True)
    ramp = np.linspace(1000, 3000, 64 * 48).reshape(48, 64).astype(np.uint16)
    assert cv2.imwrite(str(path), ramp)


def parsers() -> dict[str, Parser]:
    """All of them by name."""
    return {**_calibrations(), **_sources(), **_posed(), **_results(), **_networks()}


def _written(name: str, content: str) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_text(content)


def _calibrations() -> dict[str, Parser]:
    from geogs.io.sources.calibration_files import read_calibration
    from geogs.io.sources.undistort import Rectifier
    from geogs.io.writers.intrinsics import read_camera

    own = {
        "width": 64, "height": 48, "fx": 50.0, "fy": 50.0, "cx": 31.5, "cy": 23.5,
        "source": {"width": 64, "height": 48, "fx": 50.0, "fy": 50.0, "cx": 31.5, "cy": 23.5,
                   "distortion": [0.01, 0.0, 0.0, 0.0], "is_guess": False},
    }  # fmt: skip
    nerf = {"camera_model": "OPENCV", "fl_x": 50.0, "fl_y": 50.0, "cx": 32, "cy": 24, "w": 64,
            "h": 48, "k1": 0.01}  # fmt: skip
    kalibr = (
        "resolution: [64, 48]\nintrinsics: [50.0, 50.0, 31.5, 23.5]\n"
        "distortion_model: radtan\ndistortion_coefficients: [0.01, 0.0, 0.0, 0.0]\n"
    )
    ros = (
        "image_width: 64\nimage_height: 48\ncamera_matrix:\n  rows: 3\n  cols: 3\n"
        "  data: [50.0, 0.0, 31.5, 0.0, 50.0, 23.5, 0.0, 0.0, 1.0]\n"
        "distortion_model: plumb_bob\n"
        "distortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [0.01, 0.0, 0.0, 0.0, 0.0]\n"
    )
    texts: dict[str, tuple[str, str, Damage]] = {
        "calibration-json": ("c.json", json.dumps(own), mutations.json_text),
        "calibration-nerfstudio": ("c.json", json.dumps(nerf), mutations.json_text),
        "calibration-kalibr": ("c.yaml", kalibr, mutations.yaml_text),
        "calibration-ros": ("c.yml", ros, mutations.yaml_text),
        "calibration-colmap": (
            "cameras.txt", "# one\n1 OPENCV 64 48 50 50 32 24 0.01 0 0 0\n", mutations.text
        ),
        "calibration-numbers": ("calib.txt", "50 50 31.5 23.5 0.01 0 0 0\n", mutations.text),
        "calibration-matrix": ("k.txt", "50 0 31.5\n0 50 23.5\n0 0 1\n", mutations.text),
    }  # fmt: skip

    def use(name: str) -> Callable[[Path], object]:
        return lambda folder: Rectifier(read_calibration(folder / name).fit(64, 48), 32).camera

    found = {
        key: Parser(_written(name, content), (name,), damage, use(name))
        for key, (name, content, damage) in texts.items()
    }
    found["camera-of-a-result"] = Parser(
        _written("intrinsics.json", json.dumps(own)), ("intrinsics.json",), mutations.json_text,
        lambda folder: read_camera(folder / "intrinsics.json").rays(),
    )  # fmt: skip
    return found


def _sources() -> dict[str, Parser]:
    from geogs.config import InputConfig
    from geogs.io.sources.sniff import open_source

    def all_of(name: str = "") -> Callable[[Path], object]:
        config = InputConfig(intrinsics="50,50,31.5,23.5")
        return lambda folder: [f.timestamp for f in open_source(folder / name, config)]

    def images(suffix: str) -> Parser:
        names = [f"{i}.{suffix}" for i in range(3)]

        def write(folder: Path) -> None:
            for i, name in enumerate(names):
                write_image(folder / name, gradient_image(i))

        return Parser(write, (names[0], names[1]), mutations.binary, all_of())

    def video(name: str, codec: str = "libx264") -> Parser:
        frames = [gradient_image(i) for i in range(6)]
        return Parser(
            lambda folder: write_video(folder / name, frames, codec=codec),
            (name,), mutations.binary, all_of(name),
        )  # fmt: skip

    def depths(folder: Path) -> object:
        config = InputConfig(intrinsics="50,50,31.5,23.5", depth="auto")
        found = [f.depth for f in open_source(folder, config)]
        return [None if d is None else d.metres() for d in found]

    def replica(folder: Path) -> None:
        write_image(folder / "results/frame000000.jpg", gradient_image(0))
        write_depth(folder / "results/depth000000.png")
        camera = {"w": 64, "h": 48, "fx": 50, "fy": 50, "cx": 31.5, "cy": 23.5, "scale": 2000}
        (folder / "cam_params.json").write_text(json.dumps({"camera": camera}))

    def tum(folder: Path) -> None:
        write_tum(tiny_room(), folder)
        write_depth(folder / "depth/0.png")
        (folder / "depth.txt").write_text("# time file\n0.0 depth/0.png\n0.04 depth/0.png\n")

    def stray(folder: Path) -> None:
        write_video(folder / "rgb.mp4", [gradient_image(i) for i in range(3)])
        write_depth(folder / "depth/000000.png")
        (folder / "camera_matrix.csv").write_text("50,0,31.5\n0,50,23.5\n0,0,1\n")

    return {
        "depth-picture": Parser(replica, ("results/depth000000.png",), mutations.binary, depths),
        "depth-scale": Parser(replica, ("cam_params.json",), mutations.json_text, depths),
        "depth-list": Parser(tum, ("depth.txt",), mutations.text, depths),
        "stray-camera": Parser(stray, ("camera_matrix.csv",), mutations.text, depths),
        **{f"images-{s}": images(s) for s in ("jpg", "png", "tif", "bmp", "webp", "ppm")},
        "video-mp4": video("v.mp4"),
        "video-mkv": video("v.mkv"),
        "video-avi": video("v.avi", "mpeg4"),
        "tum-list": Parser(
            lambda folder: write_tum(tiny_room(), folder), ("rgb.txt",), mutations.text, all_of()
        ),
    }


def _posed() -> dict[str, Parser]:
    from geogs.io.poses import read_poses
    from geogs.io.sources.posed.sniff import open_posed_source

    def use(folder: Path) -> object:
        source = open_posed_source(folder)
        return [image.image for image in source], source.points

    room = tiny_room()

    def with_images(write: Callable[..., object]) -> Callable[[Path], object]:
        def both(folder: Path) -> None:
            names = write_room_images(room, folder / "images", "{:d}.png")
            write(room, folder / "sparse" / "0", names)

        return both

    model = tuple(f"sparse/0/{name}" for name in ("cameras", "images", "points3D"))
    layouts: dict[str, tuple[Callable[[Path], object], tuple[str, ...], Damage]] = {
        "colmap-text": (with_images(write_colmap_text),
                        tuple(f"{name}.txt" for name in model), mutations.text),
        "colmap-binary": (with_images(write_colmap_binary),
                          tuple(f"{name}.bin" for name in model), mutations.binary),
        "nerfstudio": (lambda f: write_nerfstudio(room, f), ("transforms.json",),
                       mutations.json_text),
        "dtu": (lambda f: write_dtu(room, f), ("cameras.npz",), mutations.archive),
        "dtu-masks": (lambda f: write_dtu(room, f), ("mask/000.png", "image/000000.png"),
                      mutations.binary),
        "replica-poses": (lambda f: write_replica(room, f), ("traj.txt",), mutations.text),
        "replica-camera": (lambda f: write_replica(room, f), ("cam_params.json",),
                           mutations.json_text),
        "tum-poses": (lambda f: write_tum(room, f), ("groundtruth.txt",), mutations.text),
        "seven-scenes": (lambda f: write_seven_scenes(room, f), ("frame-000001.pose.txt",),
                         mutations.text),
        "scannet": (lambda f: write_scannet(room, f),
                    ("pose/0.txt", "intrinsic/intrinsic_color.txt"), mutations.text),
    }  # fmt: skip
    found = {k: Parser(write, files, damage, use) for k, (write, files, damage) in layouts.items()}
    found["true-poses"] = Parser(
        lambda f: write_tum(room, f), ("groundtruth.txt",), mutations.text,
        lambda f: read_poses(f / "groundtruth.txt"),
    )  # fmt: skip
    return found


def _results() -> dict[str, Parser]:
    from geogs.application.remesh import mesh_settings
    from geogs.application.saved_result import load_result
    from geogs.evaluation.surface import read_surface
    from geogs.io.writers.keyframe_images import image_path, mask_path, read_image, read_mask
    from geogs.io.writers.ply import write_mesh
    from geogs.mesh.files import read_mesh
    from saved_results import make_result

    vertices = np.random.default_rng(0).random((5, 3)).astype(np.float32)
    faces = np.array([[0, 1, 2], [2, 3, 4]])
    colours = np.full((5, 3), 128, np.uint8)
    ascii_ply = (
        "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\n"
        "property float z\nelement face 2\nproperty list uchar int vertex_indices\nend_header\n"
        "0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2\n3 0 2 3\n"
    )

    def meshes(folder: Path) -> object:
        surface = read_surface(folder / "m.ply")
        return surface.areas, surface.face_normals, read_mesh(folder / "m.ply")

    def result(folder: Path) -> object:
        found = load_result(folder)
        return found.trajectory, found.camera, len(found.keyframes), mesh_settings(folder)

    def pictures(folder: Path) -> object:
        return read_image(image_path(folder, 3)), read_mask(mask_path(folder, 3))

    return {
        "ply-binary": Parser(
            lambda f: write_mesh(f / "m.ply", vertices, faces, colours, vertices), ("m.ply",),
            mutations.binary, meshes,
        ),
        "ply-text": Parser(_written("m.ply", ascii_ply), ("m.ply",), mutations.text, meshes),
        "map": Parser(make_result, ("map.safetensors",), mutations.safetensors, result),
        "config-of-a-result": Parser(make_result, ("config.yaml",), mutations.yaml_text, result),
        "trajectory-of-a-result": Parser(
            make_result, ("trajectory.tum",), mutations.text, result
        ),
        "keyframe-images": Parser(
            make_result, ("keyframes/000003.jpg", "keyframes/000003.mask.png"), mutations.binary,
            pictures,
        ),
    }  # fmt: skip


def _networks() -> dict[str, Parser]:
    import onnx

    from geogs.networks.weights import read_tensors
    from geogs.priors.card import load_card
    from geogs.priors.onnx import OnnxPrior

    card = (
        "name: test\nsource: nowhere\nlicence: none\nresize: stretch\nheight: 8\nwidth: 8\n"
        "mean: [0.5, 0.5, 0.5]\nstd: [0.2, 0.2, 0.2]\ndepth_kind: metric\ndepth_range: [0.1, 10]\n"
        "normal_axes: +x-y-z\nnormal_scale: 2\n"
    )
    one = onnx.helper.make_tensor_value_info("x", onnx.TensorProto.FLOAT, [1, 3, 8, 8])
    two = onnx.helper.make_tensor_value_info("y", onnx.TensorProto.FLOAT, [1, 3, 8, 8])
    graph = onnx.helper.make_graph([onnx.helper.make_node("Relu", ["x"], ["y"])], "g", [one], [two])
    opset = [onnx.helper.make_opsetid("", 17)]
    model = onnx.helper.make_model(graph, opset_imports=opset, ir_version=8)

    def network(folder: Path) -> None:
        (folder / "card.yaml").write_text(card.replace("depth_kind: metric\n", ""))
        (folder / "n.onnx").write_bytes(model.SerializeToString())

    def predict(folder: Path) -> object:
        camera = Camera(50.0, 50.0, 31.5, 23.5, 64, 48)
        prior = OnnxPrior(folder / "n.onnx", load_card(str(folder / "card.yaml")), camera)
        return prior.predict(gradient_image(0))

    tensors = {"a": torch.arange(6.0), "b": torch.ones(2, 2)}
    return {
        "card": Parser(
            _written("card.yaml", card), ("card.yaml",), mutations.yaml_text,
            lambda f: load_card(str(f / "card.yaml")),
        ),
        "network": Parser(network, ("n.onnx",), mutations.binary, predict),
        "weights": Parser(
            lambda f: save_file(tensors, f / "w.safetensors"), ("w.safetensors",),
            mutations.safetensors, lambda f: read_tensors(f / "w.safetensors"),
        ),
        "checkpoint-of-torch": Parser(
            lambda f: torch.save(tensors, f / "w.pth"), ("w.pth",), mutations.binary,
            lambda f: read_tensors(f / "w.pth"),
        ),
    }  # fmt: skip
