"""Images, videos and recordings of ROS, without poses."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

import mutations
from bag_samples import BagWriter
from geogs.config import InputConfig
from geogs.io.sources.live.pipe import Pipe
from geogs.io.sources.sniff import open_source
from io_samples import gradient_image, write_image, write_video
from parsers.base import Damage, Parser, tiny_room
from posed_layouts import write_replica, write_seven_scenes, write_tum


def recordings() -> dict[str, Parser]:
    """By the formats that ``geogs run`` reads."""
    folder_with_tables: dict[str, tuple[Callable[..., object], str, Damage]] = {
        "tum-list": (write_tum, "rgb.txt", mutations.text),
        "replica-source": (write_replica, "cam_params.json", mutations.json_text),
        "seven-scenes-source": (write_seven_scenes, "calib.txt", mutations.text),
    }
    return {
        **{f"images-{s}": images(s) for s in ("jpg", "png", "tif", "bmp", "webp", "ppm")},
        "images-exif": exif(),
        "images-times": Parser(timed, ("timestamps.csv",), mutations.text, all_of()),
        "video-mp4": video("v.mp4"),
        "video-turned": video("v.mp4", rotation=90),
        "video-mkv": video("v.mkv"),
        "video-avi": video("v.avi", "mpeg4"),
        "video-gif": Parser(gif, ("v.gif",), mutations.binary, all_of("v.gif")),
        "video-y4m": Parser(yuv, ("v.y4m",), mutations.text, all_of("v.y4m")),
        "pipe-y4m": Parser(yuv, ("v.y4m",), mutations.text, piped),
        "bag-ros1": bag("bag"),
        "bag-sqlite": bag("sqlite"),
        "bag-mcap": bag("mcap"),
        "bag-metadata": bag("mcap", "metadata.yaml", mutations.yaml_text),
        **{
            key: Parser(
                lambda folder, w=write: w(tiny_room(), folder), (name,), damage,
                all_of(auto=key != "tum-list"),
            )
            for key, (write, name, damage) in folder_with_tables.items()
        },
    }  # fmt: skip


def all_of(name: str = "", auto: bool = False) -> Callable[[Path], object]:
    """Reads every frame; with the camera that the source tells of, or one that is given."""
    config = InputConfig() if auto else InputConfig(intrinsics="50,50,31.5,23.5")
    return lambda folder: [f.timestamp for f in open_source(folder / name, config)]


def timed(folder: Path) -> None:
    for i in range(3):
        write_image(folder / f"{i}.png", gradient_image(i))
    rows = (f"{i}.png,{i / 10}\n" for i in range(3))
    (folder / "timestamps.csv").write_text("file,time\n" + "".join(rows))


def images(suffix: str) -> Parser:
    names = [f"{i}.{suffix}" for i in range(3)]

    def write(folder: Path) -> None:
        for i, name in enumerate(names):
            write_image(folder / name, gradient_image(i))

    return Parser(write, (names[0], names[1]), mutations.binary, all_of())


def write_photograph(path: Path, index: int) -> None:
    """A JPEG that says by what it was taken, and lies on its side."""
    path.parent.mkdir(parents=True, exist_ok=True)
    picture = Image.fromarray(gradient_image(index))
    exif = Image.Exif()
    exif[0x010F], exif[0x0110], exif[0x0112] = "maker", "model", 6
    exif.get_ifd(0x8769).update({0x920A: 4.2, 0xA405: 26, 0xA434: "lens"})
    picture.save(path, exif=exif)


def exif() -> Parser:
    names = [f"{i}.jpg" for i in range(2)]

    def write(folder: Path) -> None:
        for i, name in enumerate(names):
            write_photograph(folder / name, i)

    return Parser(write, (names[0],), mutations.binary, all_of(auto=True))


def video(name: str, codec: str = "libx264", rotation: int = 0) -> Parser:
    frames = [gradient_image(i) for i in range(6)]
    return Parser(
        lambda folder: write_video(folder / name, frames, codec=codec, rotation=rotation),
        (name,), mutations.binary, all_of(name),
    )  # fmt: skip


def gif(folder: Path) -> None:
    first, *others = [Image.fromarray(gradient_image(i)) for i in range(3)]
    first.save(folder / "v.gif", save_all=True, append_images=others)


def yuv(folder: Path) -> None:
    """YUV4MPEG2, whose levels are letters, so that its lines can be damaged as text."""
    frame = b"FRAME\n" + b"x" * (64 * 48 * 3 // 2)
    (folder / "v.y4m").write_bytes(b"YUV4MPEG2 W64 H48 F30:1 Ip A1:1 C420\n" + 3 * frame)


def piped(folder: Path) -> list[float]:
    with (folder / "v.y4m").open("rb") as stream:
        return [frame.timestamp for frame in Pipe(stream).frames()]


def bag(kind: str, name: str = "", damage: Damage = mutations.binary) -> Parser:
    """A recording with raw and compressed images and their camera."""
    place = "one.bag" if kind == "bag" else kind
    inside = {"bag": "one.bag", "sqlite": "sqlite/sqlite.db3", "mcap": "mcap/mcap.mcap"}[kind]

    def write(folder: Path) -> None:
        with BagWriter(folder, kind) as bag:
            bag.camera_info("/camera/camera_info", 0, distortion=np.array([0.01, 0, 0, 0, 0]))
            for k in range(3):
                bag.image("/camera/image_raw", k, gradient_image(k), "mono8")
            for k in range(2):
                bag.compressed("/other/image/compressed", k, gradient_image(k), "jpeg")

    files = (f"{kind}/{name}" if name else inside,)
    return Parser(write, files, damage, all_of(place, auto=True))
