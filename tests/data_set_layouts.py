"""Tiny copies of public data sets as they lie on disk, of one walk, for what is found in them."""

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from io_samples import write_images
from pose_samples import write_depth

COUNT = 10
WIDTH, HEIGHT = 64, 48
NED_FROM_OPENCV = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
BODY_FROM_CAMERA = np.eye(4)
BODY_FROM_CAMERA[:3, :3] = Rotation.from_euler("xyz", [0.3, -1.2, 0.9]).as_matrix()
BODY_FROM_CAMERA[:3, 3] = 0.06, -0.02, 0.11


def walk() -> np.ndarray:
    """Camera to world in OpenCV axes, metres: a bent path with turns about all axes."""
    k = np.arange(COUNT)
    T_wc = np.tile(np.eye(4), (COUNT, 1, 1))
    angles = np.stack([0.05 * k, 0.1 * np.sin(k), 0.3 - 0.04 * k], 1)
    T_wc[:, :3, :3] = Rotation.from_euler("xyz", angles).as_matrix()
    T_wc[:, :3, 3] = np.stack([0.3 * k, np.sin(0.7 * k), 0.1 * k * np.cos(k)], 1)
    return T_wc


@dataclass
class Sample:
    """What was written, and what has to be found."""

    kind: str
    given: list[Path]
    """Folders, each of which has to do."""
    times: np.ndarray
    camera: tuple[float, float, float, float]
    """fx, fy, cx, cy, pixel centres at integers."""
    truths: list[Path]
    """What ``geogs eval`` has to accept, of the camera that is read."""
    distortion: tuple[float, ...] = ()
    lens: str = "polynomial"
    calibrations: list[Path] = field(default_factory=list)
    """Files for ``--intrinsics``."""
    has_depth: bool = False


def xyzw(T: np.ndarray) -> np.ndarray:
    return Rotation.from_matrix(T[:, :3, :3]).as_quat()


def rows(table: np.ndarray, separator: str = " ") -> str:
    return "".join(separator.join(repr(float(x)) for x in row) + "\n" for row in table)


def tum_rows(times: np.ndarray, T_wc: np.ndarray) -> str:
    return rows(np.column_stack([times, T_wc[:, :3, 3], xyzw(T_wc)]))


def projection(K: tuple[float, float, float, float], x: float) -> str:
    fx, fy, cx, cy = K
    return rows(np.array([[fx, 0, cx, fx * x, 0, fy, cy, 0, 0, 0, 1, 0]])).strip()


def kitti_odometry(root: Path) -> Sample:
    """Read is image_2, the left colour camera, 6 cm to the left of camera 0, whose poses these
    are."""
    folder, K, T_wc = root / "dataset" / "sequences" / "07", (50.0, 50.0, 31.0, 23.0), walk()
    for name in ("image_0", "image_1", "image_2", "image_3"):
        write_images(folder / name, [f"{k:06d}.png" for k in range(COUNT)], WIDTH, HEIGHT)
    times = np.arange(COUNT) * 0.1037
    (folder / "times.txt").write_text("".join(f"{t:e}\n" for t in times))
    shifts = (0.0, -0.54, 0.06, -0.48)
    lines = [f"P{n}: {projection(K, shift)}" for n, shift in enumerate(shifts)]
    lines += ["Tr: " + rows(np.eye(4)[:3].reshape(1, 12)).strip()]
    (folder / "calib.txt").write_text("\n".join(lines) + "\n")
    shift = np.eye(4)
    shift[0, 3] = 0.06
    poses = root / "dataset" / "poses" / "07.txt"
    poses.parent.mkdir()
    poses.write_text(rows((T_wc @ shift)[:, :3].reshape(-1, 12)))
    return Sample(
        "kitti", [folder, folder / "image_2", folder.parent, root / "dataset"], times, K,
        [folder, folder / "image_2"], calibrations=[folder / "calib.txt"],
    )  # fmt: skip


def oxts_rows(T_wi: np.ndarray) -> list[str]:
    """Rows of the inertial unit at poses whose world is x east, y north, z up, in metres."""
    start, radius = np.radians([49.015, 8.434]), 6378137.0
    scale = radius * np.cos(start[0])
    north = scale * np.log(np.tan(np.pi / 4 + start[0] / 2)) + T_wi[:, 1, 3] - T_wi[0, 1, 3]
    latitude = 2 * np.arctan(np.exp(north / scale)) - np.pi / 2
    longitude = start[1] + (T_wi[:, 0, 3] - T_wi[0, 0, 3]) / scale
    turns = Rotation.from_matrix(T_wi[:, :3, :3]).as_euler("ZYX")[:, ::-1]
    table = np.column_stack([
        np.degrees(latitude), np.degrees(longitude), T_wi[:, 2, 3], turns, np.zeros((len(T_wi), 24))
    ])  # fmt: skip
    return [rows(row[None]) for row in table]


def kitti_truth(day: Path, drive: Path, stamps: str) -> None:
    """What the inertial unit says where the rectified camera 2 goes along the walk."""
    velo_imu, cam_velo, rect, shift = (np.eye(4) for _ in range(4))
    velo_imu[:3, :3] = Rotation.from_euler("xyz", [0.01, -0.02, 0.03]).as_matrix()
    velo_imu[:3, 3] = -0.81, 0.32, -0.80
    cam_velo[:3, :3] = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
    cam_velo[:3, 3] = -0.004, -0.076, -0.27
    rect[:3, :3] = Rotation.from_euler("xyz", [-0.01, 0.005, 0.002]).as_matrix()
    shift[0, 3] = 0.06
    camera_imu = shift @ rect @ cam_velo @ velo_imu
    upright = np.eye(4)
    upright[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]  # z forward, y down to x forward, z up
    (drive / "oxts" / "data").mkdir(parents=True)
    for k, row in enumerate(oxts_rows(upright @ walk() @ camera_imu)):
        (drive / "oxts" / "data" / f"{k:010d}.txt").write_text(row)
    (drive / "oxts" / "timestamps.txt").write_text(stamps)
    for name, T in (("imu_to_velo", velo_imu), ("velo_to_cam", cam_velo)):
        R, t = rows(T[:3, :3].reshape(1, 9)), rows(T[None, :3, 3])
        (day / f"calib_{name}.txt").write_text(f"calib_time: 25-May-2012 16:47:16\nR: {R}T: {t}")
    with (day / "calib_cam_to_cam.txt").open("a") as file:
        file.write("R_rect_00: " + rows(rect[:3, :3].reshape(1, 9)))


def kitti_raw(root: Path) -> Sample:
    day, K = root / "2011_09_26", (50.0, 51.0, 31.0, 23.0)
    folder = day / "2011_09_26_drive_0001_sync"
    seconds = 25.964389445 + 0.1037 * np.arange(COUNT)
    stamps = "".join(f"2011-09-26 13:02:{s:.9f}\n" for s in seconds)
    lines = ["calib_time: 09-Jan-2012 13:57:47"]
    for n, shift in enumerate((0.0, -0.54, 0.06, -0.48)):
        camera = folder / f"image_{n:02d}"
        write_images(camera / "data", [f"{k:010d}.png" for k in range(COUNT)], WIDTH, HEIGHT)
        (camera / "timestamps.txt").write_text(stamps)
        lines += [
            f"S_{n:02d}: 7.0e+01 5.0e+01", f"K_{n:02d}: 70 0 35 0 70 25 0 0 1",
            f"D_{n:02d}: -0.3 0.1 0.0 0.0 0.0", f"S_rect_{n:02d}: 6.4e+01 4.8e+01",
            f"P_rect_{n:02d}: {projection(K, shift)}",
        ]  # fmt: skip
    calib = day / "calib_cam_to_cam.txt"
    calib.write_text("\n".join(lines) + "\n")
    kitti_truth(day, folder, stamps)
    return Sample(
        "kitti-raw", [folder, folder / "image_02", folder / "image_02/data", day],
        1317042120 + seconds, K, [folder, folder / "image_02"], calibrations=[calib],
    )  # fmt: skip


def sensor_yaml(
    model: str,
    numbers: str,
    size: tuple[int, int] = (WIDTH, HEIGHT),
    K: tuple[float, ...] = (50.0, 51.0, 31.0, 23.0),
) -> str:
    data = ", ".join(repr(float(x)) for x in BODY_FROM_CAMERA.ravel())
    return (
        "# General sensor definitions.\nsensor_type: camera\ncomment: VI-Sensor cam0\n"
        f"T_BS:\n  cols: 4\n  rows: 4\n  data: [{data}]\nrate_hz: 20\nresolution: {list(size)}\n"
        f"camera_model: pinhole\nintrinsics: {list(K)}\n"
        f"distortion_model: {model}\ndistortion_coefficients: [{numbers}]\n"
    )


def asl_images(folder: Path) -> np.ndarray:
    """The images of two cameras; returns nanoseconds."""
    stamps = 1403636579763555584 + 50_000_000 * np.arange(COUNT)
    for name in ("cam0", "cam1"):
        camera = folder / "mav0" / name
        write_images(camera / "data", [f"{t}.png" for t in stamps], WIDTH, HEIGHT)
        lines = "".join(f"{t},{t}.png\r\n" for t in stamps)
        (camera / "data.csv").write_text("#timestamp [ns],filename\r\n" + lines)
    return stamps


def asl_truth(file: Path, stamps: np.ndarray, columns: int, T_wc: np.ndarray) -> None:
    """Poses of the body at the images."""
    T = T_wc @ np.linalg.inv(BODY_FROM_CAMERA)
    file.parent.mkdir()
    table = np.column_stack([T[:, :3, 3], xyzw(T)[:, [3, 0, 1, 2]], np.zeros((len(T), columns))])
    lines = [
        f"{t}," + ",".join(repr(float(x)) for x in r) for t, r in zip(stamps, table, strict=True)
    ]
    file.write_text("#timestamp, p_RS_R_x [m], q_RS_w []\n" + "\n".join(lines) + "\n")


def euroc(root: Path) -> Sample:
    folder = root / "MH_01_easy"
    stamps = asl_images(folder)
    for name in ("cam0", "cam1"):
        text = sensor_yaml("radial-tangential", "-0.28, 0.07, 0.0002, 0.00002")
        (folder / "mav0" / name / "sensor.yaml").write_text(text)
    truth = folder / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    asl_truth(truth, stamps, 9, walk())
    cam0 = folder / "mav0" / "cam0"
    return Sample(
        "asl", [folder, folder / "mav0", cam0, cam0 / "data", root], 1e-9 * stamps,
        (50.0, 51.0, 31.0, 23.0), [folder, cam0, truth],
        (-0.28, 0.07, 0.0002, 0.00002), calibrations=[cam0 / "sensor.yaml"],
    )  # fmt: skip


def tum_vi(root: Path) -> Sample:
    folder = root / "dataset-room1_512_16"
    stamps = asl_images(folder)
    truth = folder / "mav0" / "mocap0" / "data.csv"
    asl_truth(truth, stamps, 0, walk())
    matrix = [[float(x) for x in row] for row in np.linalg.inv(BODY_FROM_CAMERA)]
    camera = (
        f"  T_cam_imu: {json.dumps(matrix)}\n  camera_model: pinhole\n"
        "  distortion_coeffs: [0.003, 0.0007, -0.002, 0.0002]\n"
        "  distortion_model: equidistant\n  intrinsics: [30.0, 30.5, 31.0, 23.0]\n"
        "  resolution: [64, 48]\n"
    )
    chain = folder / "dso" / "camchain.yaml"
    chain.parent.mkdir()
    chain.write_text(f"cam0:\n{camera}cam1:\n{camera}".replace("cam1:\n", "cam1:\n", 1))
    return Sample(
        "asl", [folder, folder / "mav0/cam0/data"], 1e-9 * stamps, (30.0, 30.5, 31.0, 23.0),
        [folder, truth], (0.003, 0.0007, -0.002, 0.0002), "fisheye", [chain],
    )  # fmt: skip


def tum_files(folder: Path, T_wc: np.ndarray | None, depth: bool) -> np.ndarray:
    """``rgb.txt`` and what belongs to it; returns the times."""
    times = 1548266469.88 + 0.04 * np.arange(COUNT)
    write_images(folder / "rgb", [f"{t:.5f}.png" for t in times], WIDTH, HEIGHT)
    lines = [f"{t:.5f} rgb/{t:.5f}.png\n" for t in times]
    (folder / "rgb.txt").write_text("# color images\n" + "".join(lines))
    if depth:
        for t in times:
            write_depth(folder / f"depth/{t:.5f}.png", np.full((HEIGHT, WIDTH), 5000, np.uint16))
        (folder / "depth.txt").write_text("".join(lines).replace("rgb/", "depth/"))
    if T_wc is not None:
        (folder / "groundtruth.txt").write_text(tum_rows(times, T_wc))
    return np.array([float(f"{t:.5f}") for t in times])


def eth3d_slam(root: Path) -> Sample:
    folder = root / "cables_1"
    times = tum_files(folder, walk(), depth=True)
    (folder / "calibration.txt").write_text("55.5 55.25 31.0 23.5\n")
    (folder / "associated.txt").write_text("")
    return Sample(
        "tum", [folder, folder / "rgb", root], times, (55.5, 55.25, 31.0, 23.5),
        [folder, folder / "groundtruth.txt"], calibrations=[folder / "calibration.txt"],
        has_depth=True,
    )  # fmt: skip


def bonn(root: Path) -> Sample:
    """Its camera is known by the name."""
    folder = root / "rgbd_bonn_balloon"
    times = tum_files(folder, walk(), depth=True)
    camera = tuple((n + 0.5 * c) / 10 - 0.5 * c for n, c in zip(
        (542.822841, 542.576870, 315.593520, 237.756098), (0, 0, 1, 1), strict=True
    ))  # fmt: skip
    return Sample(
        "tum", [folder, folder / "rgb"], times, camera, [folder],
        (0.039903, -0.099343, -0.000730, -0.000144, 0.0), has_depth=True,
    )  # fmt: skip


def icl_nuim(root: Path) -> Sample:
    """Left-handed poses, of frames that are counted from 1; image 0 has none."""
    folder, T_wc = root / "living_room_traj0_frei_png", walk()
    write_images(folder / "rgb", [f"{k}.png" for k in range(1, COUNT + 1)], WIDTH, HEIGHT)
    numbers = range(1, COUNT + 1)
    for k in numbers:
        write_depth(folder / f"depth/{k}.png", np.full((HEIGHT, WIDTH), 5000, np.uint16))
    lines = "".join(f"{k} depth/{k}.png {k} rgb/{k}.png\n" for k in numbers)
    (folder / "associations.txt").write_text(lines)
    y_up = np.diag([1.0, -1.0, 1.0, 1.0])
    truth = folder / "livingRoom0.gt.freiburg"
    truth.write_text(tum_rows(np.array(numbers, float), y_up @ T_wc @ y_up))
    camera = (48.12, 48.0, 31.5, 23.5)
    return Sample(
        "icl-nuim", [folder, folder / "rgb", root], np.arange(1, COUNT + 1) / 30, camera,
        [folder, truth], has_depth=True,
    )  # fmt: skip


def tartanair(root: Path) -> Sample:
    folder = root / "abandonedfactory" / "Easy" / "P001"
    for side in ("left", "right"):
        names = [f"{k:06d}_{side}.png" for k in range(COUNT)]
        write_images(folder / f"image_{side}", names, WIDTH, HEIGHT)
        T = NED_FROM_OPENCV @ walk() @ NED_FROM_OPENCV.T
        table = np.column_stack([T[:, :3, 3], xyzw(T)])
        (folder / f"pose_{side}.txt").write_text(rows(table))
    return Sample(
        "tartanair", [folder, folder / "image_left", root / "abandonedfactory"],
        np.arange(COUNT) / 30, (32.0, 32.0, 31.5, 23.5), [folder, folder / "pose_left.txt"],
    )  # fmt: skip


def arkitscenes(root: Path) -> Sample:
    folder = root / "Training" / "41069021"
    times = np.round(305.377 + np.arange(COUNT) / 10, 3)
    names = [f"41069021_{t:.3f}" for t in times]
    write_images(folder / "lowres_wide", [f"{name}.png" for name in names], WIDTH, HEIGHT)
    intrinsics = folder / "lowres_wide_intrinsics"
    intrinsics.mkdir()
    for name in names:
        (intrinsics / f"{name}.pincam").write_text("64 48 53.25 53.5 31.0 23.0")
        write_depth(folder / f"lowres_depth/{name}.png", np.full((48, 64), 1000, np.uint16))
    T_cw = np.linalg.inv(walk())
    turns = Rotation.from_matrix(T_cw[:, :3, :3]).as_rotvec()
    truth = folder / "lowres_wide.traj"
    truth.write_text(rows(np.column_stack([times, turns, T_cw[:, :3, 3]])))
    return Sample(
        "arkitscenes", [folder, folder / "lowres_wide", root / "Training", root], times,
        (53.25, 53.5, 31.0, 23.0), [folder, truth],
        calibrations=[intrinsics / f"{names[0]}.pincam"], has_depth=True,
    )  # fmt: skip


def colmap_text(folder: Path, model: str, numbers: str, names: list[str], T_wc: np.ndarray) -> None:
    folder.mkdir(parents=True)
    T_cw = np.linalg.inv(T_wc)
    (folder / "cameras.txt").write_text(f"# cameras\n1 {model} {WIDTH} {HEIGHT} {numbers}\n")
    table = np.column_stack([xyzw(T_cw)[:, [3, 0, 1, 2]], T_cw[:, :3, 3]])
    lines = [
        f"{k + 1} {rows(row[None]).strip()} 1 {name}\n\n"
        for k, (row, name) in enumerate(zip(table, names, strict=True))
    ]
    (folder / "images.txt").write_text("# images\n" + "".join(lines))
    (folder / "points3D.txt").write_text("# points\n")


def scannetpp_phone(root: Path) -> Sample:
    """Every tenth frame of 60 a second; COLMAP has placed but the first."""
    folder = root / "0a5c013435" / "iphone"
    names = [f"frame_{10 * k:06d}.jpg" for k in range(COUNT + 1)]
    write_images(folder / "rgb", names, WIDTH, HEIGHT)
    placed = [f"video/{name}" for name in names[1:]]
    colmap_text(folder / "colmap", "OPENCV", "50 51 32 24 0.01 0 0 0", placed, walk())
    frame = {"intrinsic": [[50.0, 0, 31.5], [0, 51.0, 23.5], [0, 0, 1]]}
    phone = folder / "pose_intrinsic_imu.json"
    phone.write_text(json.dumps({name[:-4]: frame for name in names}))
    (folder / "exif.json").write_text("{}")
    return Sample(
        "scannetpp", [folder.parent, folder, folder / "rgb", root], np.arange(COUNT + 1) / 6,
        (50.0, 51.0, 31.5, 23.5), [folder.parent, folder, folder / "colmap/images.txt"],
        (0.01, 0.0, 0.0, 0.0), calibrations=[folder / "colmap/cameras.txt"],
    )  # fmt: skip


def scannetpp_dslr(root: Path) -> Sample:
    folder = root / "0a5c013435" / "dslr"
    names = [f"DSC{k:05d}.JPG" for k in range(1752, 1752 + COUNT)]
    write_images(folder / "resized_images", names, WIDTH, HEIGHT)
    colmap_text(folder / "colmap", "OPENCV_FISHEYE", "30 30.5 32 24 0.01 0.02 0 0", names, walk())
    return Sample(
        "scannetpp", [folder.parent, folder, folder / "resized_images"], np.arange(COUNT) / 30,
        (30.0, 30.5, 31.5, 23.5), [folder.parent, folder / "colmap/images.txt"],
        (0.01, 0.02, 0.0, 0.0), "fisheye", [folder / "colmap/cameras.txt"],
    )  # fmt: skip


def eth3d_photographs(root: Path) -> Sample:
    folder = root / "courtyard"
    names = [f"dslr_images_undistorted/DSC_{k:04d}.JPG" for k in range(286, 286 + COUNT)]
    write_images(folder / "images", names, WIDTH, HEIGHT)
    model = folder / "dslr_calibration_undistorted"
    colmap_text(model, "PINHOLE", "50 51 32 24", names, walk())
    return Sample(
        "eth3d", [folder, folder / "images", folder / "images/dslr_images_undistorted", root],
        np.arange(COUNT) / 30, (50.0, 51.0, 31.5, 23.5), [folder, model / "images.txt"],
        calibrations=[model / "cameras.txt"],
    )  # fmt: skip


LAYOUTS: dict[str, Callable[[Path], Sample]] = {
    "kitti-odometry": kitti_odometry,
    "kitti-raw": kitti_raw,
    "euroc": euroc,
    "tum-vi": tum_vi,
    "eth3d-slam": eth3d_slam,
    "bonn": bonn,
    "icl-nuim": icl_nuim,
    "tartanair": tartanair,
    "arkitscenes": arkitscenes,
    "scannetpp-phone": scannetpp_phone,
    "scannetpp-dslr": scannetpp_dslr,
    "eth3d-photographs": eth3d_photographs,
}
