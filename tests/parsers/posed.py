"""Images with known poses."""

from collections.abc import Callable
from pathlib import Path

import mutations
from geogs.io.pose_files import read_poses
from geogs.io.sources.sniff import open_posed_source
from parsers.base import Damage, Parser, tiny_room
from posed_layouts import (
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
from view_lists import (
    Scene,
    write_bundler,
    write_kapture,
    write_metashape,
    write_mvsnet,
    write_nvm,
    write_openmvg,
    write_opensfm,
    write_rc_csv,
    write_rc_xmp,
)


def posed() -> dict[str, Parser]:
    """By the formats that ``geogs reconstruct`` reads."""

    def use(folder: Path) -> object:
        source = open_posed_source(folder)
        return [image.image for image in source], source.points

    room = tiny_room()

    def with_images(write: Callable[..., object]) -> Callable[[Path], object]:
        def both(folder: Path) -> None:
            names = write_room_images(room, folder / "images", "{:d}.png")
            write(room, folder / "sparse" / "0", names)

        return both

    def with_scene(write: Callable[..., object]) -> Callable[[Path], object]:
        def both(folder: Path) -> None:
            names = write_room_images(room, folder / "images", "{:d}.png")
            write(Scene(list(room.T_cw), names), folder)

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
    lists = {
        "opensfm": (write_opensfm, "reconstruction.json", mutations.json_text),
        "metashape": (write_metashape, "cameras.xml", mutations.text),
        "openmvg": (write_openmvg, "reconstruction/sfm_data.json", mutations.json_text),
        "realitycapture-csv": (write_rc_csv, "registration.csv", mutations.text),
        "realitycapture-xmp": (write_rc_xmp, "images/0.xmp", mutations.text),
        "mvsnet": (write_mvsnet, "cams/00000000_cam.txt", mutations.text),
        "kapture": (write_kapture, "sensors/sensors.txt", mutations.text),
        "bundler": (write_bundler, "bundle.out", mutations.text),
        "visualsfm": (write_nvm, "model.nvm", mutations.text),
    }
    for name, (writes, file, damage) in lists.items():
        layouts[name] = with_scene(writes), (file,), damage
    found = {k: Parser(write, files, damage, use) for k, (write, files, damage) in layouts.items()}
    found["true-poses"] = Parser(
        lambda f: write_tum(room, f), ("groundtruth.txt",), mutations.text,
        lambda f: read_poses(f / "groundtruth.txt"),
    )  # fmt: skip
    return found
