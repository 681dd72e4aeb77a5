"""Inputs made at random: a right one with one property changed, and whether it is read rightly.

    python benchmarks/inputs.py [--count 300] [--seed 0] [--keep FOLDER] [--kinds x_fov,bars]

A small room is rendered once. Each input writes it in a format of its own with one thing changed
(a key of the lens, an axis, a clock, names, an encoding, bars, …), opens it as a command does, with
the checks that a command makes, and compares camera, times, poses, depth and masks with the truth.
An outcome is right, refused (in a sentence), told (wrong, with a line of the account that a user
can see) or silent (wrong, and nothing says so). Printed is a table by kind; ends with 1 where one
is silent, or a right one is refused.
"""

import argparse
import json
import sys
import tempfile
import unicodedata
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from geogs.application.calibrate import without_overlay
from geogs.application.progress.run_progress import RunProgress
from geogs.cli import main as geogs
from geogs.config import InputConfig
from geogs.errors import InputError
from geogs.io.sources.posed.pose_check import check_poses, with_focal_length
from geogs.io.sources.sniff import open_posed_source, open_source

FRAMES, WIDTH, HEIGHT = 48, 240, 180
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Scene:
    """The rendered room."""

    images: list[np.ndarray]
    """BGR."""
    T_wc: np.ndarray
    focal: float
    centre: tuple[float, float]


@dataclass
class Input:
    """What is handed in, and what it is in truth."""

    path: Path
    is_posed: bool = True
    config: InputConfig = field(default_factory=InputConfig)
    focal: tuple[float, float] | None = None
    """fx, fy of the stored images; none where a run estimates them."""
    count: int = FRAMES
    times: np.ndarray | None = None
    masked: float = 0.0
    """Fraction of the image that shows no scene."""
    depth: float | None = None
    """Metres of the median depth."""
    must_be_right: bool = False
    """Whether it may be neither refused nor doubted."""


Kind = Callable[[Scene, Path, np.random.Generator], Input]


def rendered(folder: Path, seed: int) -> Scene:
    """Render the room."""
    words = f"--frames {FRAMES} --width {WIDTH} --height {HEIGHT} --seed {seed} --image-format png"
    if geogs.main(["synth", str(folder), *words.split(), "--motion", "walking"]) != 0:
        raise RuntimeError("the room cannot be rendered")
    camera = json.loads((folder / "cam_params.json").read_text())["camera"]
    images = [cv2.imread(str(path)) for path in sorted((folder / "results").glob("frame*.png"))]
    T_wc = np.loadtxt(folder / "traj.txt").reshape(-1, 4, 4)
    return Scene(images, T_wc, camera["fx"], (camera["cx"], camera["cy"]))


def transforms(scene: Scene, folder: Path, names: list[str], **keys: object) -> dict[str, object]:
    """A document of nerfstudio without a focal length, with the images beside it."""
    frames = []
    for name, image, T in zip(names, scene.images, scene.T_wc, strict=True):
        write(folder / name.replace("\\", "/"), image)
        frames.append({"file_path": name, "transform_matrix": (T @ OPENGL).tolist()})
    cx, cy = (c + 0.5 for c in scene.centre)
    return {"w": WIDTH, "h": HEIGHT, "cx": cx, "cy": cy, **keys, "frames": frames}


def save(folder: Path, document: dict[str, object]) -> Path:
    """Write ``transforms.json``; returns the folder."""
    (folder / "transforms.json").write_text(json.dumps(document))
    return folder


def write(path: Path, image: np.ndarray) -> None:
    """Write a picture."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(path), image):
        raise RuntimeError(f"{path} cannot be written")


def usual_names(suffix: str = ".png") -> list[str]:
    return [f"images/{k:04d}{suffix}" for k in range(FRAMES)]


def lens_key(scene: Scene, folder: Path, rng: np.random.Generator) -> Input:
    """The focal length by one of the keys that programs write, or by none."""
    f = scene.focal
    across, down = (2 * np.arctan(n / 2 / f) for n in (WIDTH, HEIGHT))
    ways: list[dict[str, object]] = [
        {"fl_x": f, "fl_y": f},
        {"fl_x": f},
        {"x_fov": float(np.degrees(across))},
        {"y_fov": float(np.degrees(down))},
        {"camera_angle_x": float(across)},
        {"camera_angle_y": float(down)},
        {"camera_angle_x": float(across), "camera_angle_y": float(down)},
        {},
    ]
    way = ways[rng.integers(len(ways))]
    document = transforms(scene, folder, usual_names(), **way)
    if rng.random() < 0.3:  # by frame
        for frame in document["frames"]:  # type: ignore[attr-defined]
            frame.update(way)
        document = {k: v for k, v in document.items() if k not in way}
    return Input(save(folder, document), focal=(f, f), must_be_right=True)


def harmless_key(scene: Scene, folder: Path, rng: np.random.Generator) -> Input:
    """A key that changes nothing."""
    keys = [{"aabb_scale": 16}, {"ply_file_path": "a.ply"}, {"scale": 0.33}, {"offset": [0, 0, 0]},
            {"camera_model": "OPENCV"}, {"camera_model": "PINHOLE"}, {"is_fisheye": False},
            {"k1": 0.0, "k2": 0.0}, {"note": "mine"}]  # fmt: skip
    f = scene.focal
    document = transforms(scene, folder, usual_names(), fl_x=f, fl_y=f, **keys[rng.integers(9)])
    return Input(save(folder, document), focal=(f, f), must_be_right=True)


def other_lens(scene: Scene, folder: Path, rng: np.random.Generator) -> Input:
    """A statement that the lens is another one than that of the images."""
    keys = [{"is_fisheye": True, "k1": 0.1}, {"latlong": True}, {"camera_model": "EQUIRECTANGULAR"},
            {"camera_model": "FISHEYE", "k1": 0.2}, {"k1": -0.3}, {"k1": 0.25, "k2": 0.1},
            {"ftheta_p1": 0.5}, {"camera_model": "ORTHOPHOTO"}]  # fmt: skip
    f = scene.focal
    document = transforms(scene, folder, usual_names(), fl_x=f, fl_y=f, **keys[rng.integers(8)])
    return Input(save(folder, document), focal=(-1.0, -1.0))


def wrong_focal(scene: Scene, folder: Path, rng: np.random.Generator) -> Input:
    """A focal length or an aspect that is wrong by a fifth or more."""
    fx, fy = scene.focal, scene.focal
    factor = np.exp(rng.choice([-1, 1]) * rng.uniform(0.2, 0.6))
    keys = {"fl_x": fx * factor, "fl_y": fy * (factor if rng.random() < 0.6 else 1)}
    document = transforms(scene, folder, usual_names(), **keys)
    return Input(save(folder, document), focal=(fx, fy))


def axes(scene: Scene, folder: Path, rng: np.random.Generator) -> Input:
    """Poses in another convention, or of other images."""
    swap = np.eye(4)
    swap[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    mirror = np.diag([-1.0, 1, 1, 1])
    ways: list[Callable[[np.ndarray], np.ndarray]] = [
        lambda T: T @ OPENGL,
        np.linalg.inv,
        lambda T: OPENGL @ np.linalg.inv(T),
        lambda T: T @ swap,
        lambda T: T @ swap.T,
        lambda T: mirror @ T @ mirror,
        lambda T: np.roll(T, 3, axis=0),
        lambda T: T[::-1],
    ]
    wrong = Scene(scene.images, ways[rng.integers(8)](scene.T_wc), scene.focal, scene.centre)
    document = transforms(wrong, folder, usual_names(), fl_x=scene.focal, fl_y=scene.focal)
    return Input(save(folder, document), focal=(-1.0, -1.0))


def world(scene: Scene, folder: Path, rng: np.random.Generator) -> Input:
    """Another frame and unit of the world, which changes nothing."""
    change = np.eye(4)
    change[:3, :3] = Rotation.random(random_state=int(rng.integers(1000))).as_matrix()
    T_wc = change @ scene.T_wc
    T_wc[:, :3, 3] = T_wc[:, :3, 3] * rng.uniform(0.01, 100) + rng.normal(0, 5, 3)
    moved = Scene(scene.images, T_wc, scene.focal, scene.centre)
    document = transforms(moved, folder, usual_names(), fl_x=scene.focal)
    return Input(save(folder, document), focal=(scene.focal,) * 2, must_be_right=True)


def names(scene: Scene, folder: Path, rng: np.random.Generator) -> Input:
    """Names as other systems write them."""
    way = int(rng.integers(7))
    plain = usual_names()
    if way == 4:
        plain = [f"images/schönes bild {k}.png" for k in range(FRAMES)]
    document = transforms(scene, folder, plain, fl_x=scene.focal)
    for frame in document["frames"]:  # type: ignore[attr-defined]
        name = frame["file_path"]
        written = [
            name.replace("/", "\\"),
            "C:\\Users\\me\\capture\\" + name.replace("/", "\\"),
            "/home/me/capture/" + name,
            name.removesuffix(".png"),
            unicodedata.normalize("NFD", name),
            "./" + name,
            name.replace(".png", ".PNG"),
        ]
        frame["file_path"] = written[way]
    return Input(save(folder, document), focal=(scene.focal,) * 2, must_be_right=True)


def order(scene: Scene, folder: Path, rng: np.random.Generator) -> Input:
    """Frames in another order, or some of them missing."""
    document = transforms(scene, folder, usual_names(), fl_x=scene.focal)
    missing = 0
    if rng.random() < 0.5:
        rng.shuffle(document["frames"])  # type: ignore[arg-type]
    else:
        missing = int(rng.integers(1, 5))
        for name in rng.choice(usual_names(), missing, replace=False):
            (folder / name).unlink()
    return Input(save(folder, document), focal=(scene.focal,) * 2, count=FRAMES - missing)


def encoding(scene: Scene, folder: Path, rng: np.random.Generator) -> Input:
    """Pictures in another encoding."""
    way = int(rng.integers(7))
    bits = (10, 12, 14, 16)[rng.integers(4)]
    for k, image in enumerate(scene.images):
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        deep = (grey.astype(np.float64) / 255 * (2**bits - 1)).astype(np.uint16)
        opaque = np.dstack([image, np.full(image.shape[:2], 255, np.uint8)])
        found = [(".png", deep), (".tiff", deep), (".png", opaque), (".jpg", image),
                 (".webp", image), (".bmp", image), (".png", grey)][way]  # fmt: skip
        write(folder / f"{k:05d}{found[0]}", found[1])
    words = f"{scene.focal},{scene.focal},{scene.centre[0]},{scene.centre[1]}"
    config = InputConfig(intrinsics=words)
    return Input(folder, False, config, (scene.focal,) * 2, must_be_right=True)


def strays(scene: Scene, folder: Path, rng: np.random.Generator) -> Input:
    """Images named by their times, with other pictures among them."""
    start = rng.uniform(1.6e9, 1.7e9)
    times = start + np.arange(FRAMES) / 10
    for time, image in zip(times, scene.images, strict=True):
        write(folder / f"{time:.6f}.png", image)
    stray = cv2.resize(scene.images[0], None, fx=0.5, fy=0.5)
    for name in ("preview.jpg", "cover.png", "thumb_01.jpg")[: rng.integers(1, 4)]:
        write(folder / name, stray)
    config = InputConfig(intrinsics=f"{scene.focal},{scene.focal},119.5,89.5")
    return Input(folder, False, config, (scene.focal,) * 2, times=np.round(times, 6))


def companions(scene: Scene, folder: Path, rng: np.random.Generator) -> Input:
    """Depth or masks beside the colour images in one folder."""
    pairs = [
        ("{:05d}-color.png", "{:05d}-depth.png"),
        ("rgb_{:04d}.png", "depth_{:04d}.png"),
        ("{:04d}.png", "{:04d}_mask.png"),
    ]
    colour, other = pairs[rng.integers(3)]
    for k, image in enumerate(scene.images):
        write(folder / colour.format(k), image)
        is_depth = "depth" in other
        deep = np.full((HEIGHT, WIDTH), 1500, np.uint16)
        write(folder / other.format(k), deep if is_depth else np.full_like(image[..., 0], 255))
    config = InputConfig(intrinsics=f"{scene.focal},{scene.focal},119.5,89.5")
    return Input(folder, False, config, (scene.focal,) * 2)


def unread(scene: Scene, folder: Path, rng: np.random.Generator) -> Input:
    """Pictures of a kind that is not read among others."""
    suffix = rng.choice([".heic", ".HEIF", ".dng", ".cr2", ".jxl"])
    for k, image in enumerate(scene.images):
        write(folder / f"{k:04d}.png", image)
        if k % 2:
            (folder / f"{k:04d}.png").rename(folder / f"{k:04d}{suffix}")
    config = InputConfig(intrinsics=f"{scene.focal},{scene.focal},119.5,89.5")
    return Input(folder, False, config, (scene.focal,) * 2)


def clock(scene: Scene, folder: Path, rng: np.random.Generator) -> Input:
    """Poses on another clock, in another unit, or of another video."""
    for k, image in enumerate(scene.images):
        write(folder / "video" / f"{k:04d}.png", image)
    way = int(rng.integers(4))
    times = np.arange(FRAMES) / 30
    T_wc = scene.T_wc
    offset = [rng.uniform(1e9, 2e9), 0.0, rng.uniform(-50, 50), rng.uniform(1e9, 2e9)][way]
    unit = [1.0, rng.choice([1e3, 1e6, 1e9]), 1.0, 1.0][way]
    if way == 3:
        T_wc = np.tile(np.eye(4), (FRAMES, 1, 1))
        T_wc[:, :3, :3] = Rotation.random(FRAMES, random_state=3).as_matrix()
    rows = np.c_[(times + offset) * unit, T_wc[:, :3, 3],
                 Rotation.from_matrix(T_wc[:, :3, :3]).as_quat()]  # fmt: skip
    np.savetxt(folder / "poses.tum", rows, fmt="%.9f")
    config = InputConfig(
        intrinsics=f"{scene.focal},{scene.focal},119.5,89.5", poses=str(folder / "poses.tum")
    )
    expected = (-1.0, -1.0) if way == 3 else (scene.focal,) * 2
    return Input(folder / "video", False, config, expected)


def bars(scene: Scene, folder: Path, rng: np.random.Generator) -> Input:
    """Bars around the images, or none at all."""
    way = int(rng.integers(6))
    thick = int(rng.integers(20, 60))
    grey = int(rng.integers(30, 220))
    colour = [(0, 0, 0), (grey,) * 3, tuple(rng.integers(0, 255, 3).tolist())][rng.integers(3)]
    top, side = [(thick, 0), (0, thick), (thick, thick), (0, 0), (thick, 0), (0, 0)][way]
    for k, image in enumerate(scene.images):
        bordered = cv2.copyMakeBorder(
            image, top, top, side, side, cv2.BORDER_CONSTANT, value=colour
        )
        if way == 4:  # the picture itself as fill
            size = (bordered.shape[1], bordered.shape[0])
            fill = cv2.GaussianBlur(cv2.resize(image, size), (0, 0), 12)
            fill[top : top + HEIGHT] = image
            bordered = fill
        write(folder / f"{k:04d}.png", bordered)
    masked = 1 - HEIGHT * WIDTH / ((HEIGHT + 2 * top) * (WIDTH + 2 * side))
    f = scene.focal
    words = f"{f},{f},{scene.centre[0] + side},{scene.centre[1] + top}"
    is_plain = masked == 0
    return Input(folder, False, InputConfig(intrinsics=words), (f, f), masked=masked,
                 must_be_right=is_plain)  # fmt: skip


def models(scene: Scene, folder: Path, rng: np.random.Generator) -> Input:
    """COLMAP's text as programs and editors leave it."""
    names = usual_names()
    if rng.random() < 0.3:
        names = [name.replace("images/", "images/my view ") for name in names]
    for name, image in zip(names, scene.images, strict=True):
        write(folder / name, image)
    end = "\r\n" if rng.random() < 0.4 else "\n"
    keypoints = ["", "1 2 -1 3 4 -1", None][rng.integers(3)]
    split = int(rng.integers(3, 8)) if rng.random() < 0.4 else 0
    for number, part in ((0, range(split)), (1 if split else 0, range(split, FRAMES))):
        if len(part) == 0:
            continue
        rows = ["# images"]
        for k in part:
            T = np.linalg.inv(scene.T_wc[k])
            x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
            numbers = " ".join(f"{v:.12g}" for v in (w, x, y, z, *T[:3, 3]))
            rows.append(f"{k + 1} {numbers} 1 {names[k].removeprefix('images/')}")
            rows += [] if keypoints is None else [keypoints]
        model = folder / "sparse" / str(number)
        model.mkdir(parents=True)
        (model / "images.txt").write_bytes((end.join(rows) + end).encode())
        cx, cy = (c + 0.5 for c in scene.centre)
        camera = f"1 PINHOLE {WIDTH} {HEIGHT} {scene.focal} {scene.focal} {cx} {cy}"
        (model / "cameras.txt").write_bytes(f"# cameras{end}{camera}{end}".encode())
        (model / "points3D.txt").write_bytes(b"")
    return Input(folder, focal=(scene.focal,) * 2, count=FRAMES - split, must_be_right=True)


def sizes(scene: Scene, folder: Path, rng: np.random.Generator) -> Input:
    """Some images at half the size, each with its own intrinsics."""
    document = transforms(scene, folder, usual_names())
    f = scene.focal
    half = rng.choice(FRAMES, int(rng.integers(1, FRAMES // 3)), replace=False)
    for k, frame in enumerate(document["frames"]):  # type: ignore[arg-type]
        scale = 0.5 if k in half else 1.0
        width, height = int(WIDTH * scale), int(HEIGHT * scale)
        frame |= {"fl_x": f * scale, "fl_y": f * scale, "w": width, "h": height}
        frame |= {"cx": width / 2, "cy": height / 2}
        if scale != 1:
            image = cv2.resize(scene.images[k], None, fx=scale, fy=scale,
                               interpolation=cv2.INTER_AREA)  # fmt: skip
            write(folder / usual_names()[k], image)
    return Input(save(folder, document), focal=(f, f))


def depth_unit(scene: Scene, folder: Path, rng: np.random.Generator) -> Input:
    """TUM's layout with depth in its unit, or in millimetres."""
    unit = [5000, 1000][rng.integers(2)]
    rows = []
    for k, image in enumerate(scene.images):
        write(folder / f"rgb/{k / 30:.6f}.png", image)
        deep = np.full((HEIGHT, WIDTH), 2.0 * unit) * np.linspace(0.6, 1.6, WIDTH)
        write(folder / f"depth/{k / 30:.6f}.png", deep.astype(np.uint16))
        rows.append(f"{k / 30:.6f}")
    for name in ("rgb", "depth"):
        lines = (f"{time} {name}/{time}.png" for time in rows)
        (folder / f"{name}.txt").write_text("\n".join(lines))
    config = InputConfig(intrinsics=f"{scene.focal},{scene.focal},119.5,89.5", depth="sensor")
    return Input(folder, False, config, (scene.focal,) * 2, depth=2.2, must_be_right=unit == 5000)


KINDS: dict[str, Kind] = {
    kind.__name__: kind
    for kind in (lens_key, harmless_key, other_lens, wrong_focal, axes, world, names, order,
                 encoding, strays, companions, unread, clock, bars, models, sizes, depth_unit)
}  # fmt: skip


class Heard(RunProgress):
    """Sentences that a command would print."""

    def __init__(self) -> None:
        super().__init__()
        self.sentences: list[str] = []

    def write(self, text: str) -> None:
        self.sentences.append(text)


def outcome(given: Input) -> tuple[str, str]:
    """Whether an input is right, refused, told or silent, and why."""
    try:
        wrong, told = _posed(given) if given.is_posed else _run(given)
    except InputError as error:
        return "refused", str(error)
    if not wrong:
        return "right", "; ".join(told)
    return ("told" if told else "silent"), f"{wrong}: {'; '.join(told)}"


def _posed(given: Input) -> tuple[str, list[str]]:
    source = with_focal_length(open_posed_source(given.path, given.config))
    check = check_poses(source)
    told = list(source.account.left) + ([check.warning] if check.warning else [])
    for k in range(0, len(source), 16):
        source[k]  # can be read
    scale = source.camera.width / WIDTH
    return _faults(given, len(source), source.camera.fx / scale, source.camera.fy / scale), told


def _run(given: Input) -> tuple[str, list[str]]:
    heard = Heard()
    source = without_overlay(open_source(given.path, given.config), heard)
    told = list(source.account.left) + heard.sentences
    frames = list(source)
    fx, fy = source.calibration.fx, source.calibration.fy
    wrong = _faults(given, len(frames), fx, fy)
    times = np.array([frame.timestamp for frame in frames])
    if given.times is not None and (
        len(times) != len(given.times)
        or np.abs((times - times[0]) - (given.times - given.times[0])).max() > 1e-3
    ):
        wrong = wrong or "times"
    scale = source.camera.fx / fx
    seen = source.camera.width * source.camera.height if source.mask is None else source.mask.sum()
    share = 1 - float(seen) / scale**2 / (source.calibration.width * source.calibration.height)
    if abs(share - given.masked) > 0.02 + 0.2 * given.masked:
        wrong = wrong or f"masked {share:.2f} of {given.masked:.2f}"
    if given.depth is not None:
        depths = [float(np.median(f.depth.metres())) for f in frames[:3] if f.depth is not None]
        if not depths or abs(np.log(np.median(depths) / given.depth)) > 0.1:
            wrong = wrong or f"depth {depths[:1]}"
    contrast = np.mean([frame.image.std() for frame in frames[::8]])
    if contrast < 15:
        wrong = wrong or f"contrast {contrast:.0f}"
    return wrong, told


def _faults(given: Input, count: int, fx: float, fy: float) -> str:
    if given.focal is not None:
        if given.focal[0] < 0:
            return "taken as right"
        off = max(abs(np.log(fx / given.focal[0])), abs(np.log(fy / given.focal[1])))
        if off > 0.03:
            return f"fx {fx:.1f}, fy {fy:.1f}"
    return "" if count == given.count else f"{count} of {given.count} images"


def made(
    scene: Scene, kinds: list[str], count: int, seed: int, root: Path
) -> Iterator[tuple[str, int, Input]]:
    """The inputs, each kind in turn."""
    for number in range(count):
        kind = kinds[number % len(kinds)]
        rng = np.random.default_rng((seed, number))
        folder = root / f"{number:04d}-{kind}"
        folder.mkdir()
        yield kind, number, KINDS[kind](scene, folder, rng)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--verbose", action="store_true")
    options = parser.parse_args()
    tally: dict[str, Counter[str]] = defaultdict(Counter)
    failures = 0
    with tempfile.TemporaryDirectory() as scratch:
        root = options.keep or Path(scratch)
        root.mkdir(parents=True, exist_ok=True)
        scene = rendered(root / "scene", options.seed + 71)
        for kind, number, given in made(scene, options.kinds.split(","), options.count,
                                        options.seed, root):  # fmt: skip
            result, why = outcome(given)
            is_bad = result == "silent" or (given.must_be_right and result != "right")
            if given.must_be_right and result == "refused":
                result = "wrongly refused"
            tally[kind][result] += 1
            failures += is_bad
            if is_bad or options.verbose:
                print(f"{number} {kind}: {result}: {why}", file=sys.stderr, flush=True)
    columns = ("right", "refused", "told", "silent", "wrongly refused")
    print(f"| kind | {' | '.join(columns)} |\n|---|{'---|' * len(columns)}")
    for kind, counts in tally.items():
        print(f"| {kind} | {' | '.join(str(counts[c]) for c in columns)} |")
    print(f"{failures} of {options.count} silently wrong, or right and refused or misread")
    return int(failures > 0)


if __name__ == "__main__":
    sys.exit(main())
