"""A scene written as the lists of views of other programs, each in its own convention."""

import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from posed_layouts import quaternion_wxyz

WIDTH, HEIGHT = 96, 72
SIDE = max(WIDTH, HEIGHT)
FX, FY = 70.0, 71.5
"""Focal lengths of the lenses, in pixels."""
CX, CY = 45.25, 37.5
"""Principal point of the lenses where the centre of the first pixel is (0.5, 0.5)."""
K1, K2, K3, K4 = -0.21, 0.07, -0.013, 0.004
P1, P2 = 0.0021, -0.0034


@dataclass
class Scene:
    """What the writers put into the files of a program."""

    T_cw: list[np.ndarray]
    names: list[str]


# OpenSfM: https://opensfm.org/docs/geometry.html


def opensfm_camera(kind: str) -> dict:
    middle = {"c_x": (CX - WIDTH / 2) / SIDE, "c_y": (CY - HEIGHT / 2) / SIDE}
    both = {"focal_x": FX / SIDE, "focal_y": FY / SIDE, **middle}
    entry = {
        "perspective": {"focal": FX / SIDE, "k1": K1, "k2": K2},
        "radial": {**both, "k1": K1, "k2": K2},
        "simple_radial": {**both, "k1": K1},
        "brown": {**both, "k1": K1, "k2": K2, "p1": P1, "p2": P2, "k3": K3},
        "fisheye": {"focal": FX / SIDE, "k1": K1, "k2": K2},
        "fisheye_opencv": {**both, "k1": K1, "k2": K2, "k3": K3, "k4": K4},
    }.get(kind, {})
    return {"projection_type": kind, "width": WIDTH, "height": HEIGHT, **entry}


def write_opensfm(scene: Scene, folder: Path, kind: str = "perspective") -> Path:
    shots = {
        name: {
            "camera": "v2 phone",
            "rotation": Rotation.from_matrix(T[:3, :3]).as_rotvec().tolist(),
            "translation": T[:3, 3].tolist(),
            "capture_time": 0.0,
        }
        for name, T in zip(scene.names, scene.T_cw, strict=True)
    }
    cameras = {"v2 phone": opensfm_camera(kind)}
    smaller = {"cameras": cameras, "shots": {"other.png": shots[scene.names[0]]}, "points": {}}
    larger = {"cameras": cameras, "shots": shots, "points": {}}
    (folder / "reconstruction.json").write_text(json.dumps([smaller, larger]))
    return folder


# Metashape: user manual, appendix "Camera models"


def write_metashape(scene: Scene, folder: Path, kind: str = "frame", **terms: float) -> Path:
    numbers = {
        "f": FY,
        "cx": CX - WIDTH / 2,
        "cy": CY - HEIGHT / 2,
        "b1": FX - FY,
        "k1": K1,
        "k2": K2,
        "k3": K3,
        **terms,
    }
    lens = "".join(f"<{name}>{value!r}</{name}>" for name, value in numbers.items())
    size = f'<resolution width="{WIDTH}" height="{HEIGHT}"/>'
    cameras = "".join(
        f'<camera id="{i}" sensor_id="0" component_id="0" label="{Path(name).stem}">'
        f"<transform>{' '.join(map(repr, np.linalg.inv(T).ravel().tolist()))}</transform></camera>"
        for i, (name, T) in enumerate(zip(scene.names, scene.T_cw, strict=True))
    )
    cameras += '<camera id="7" sensor_id="0" label="lost"/>'
    cameras += '<camera id="8" sensor_id="0" label="off" enabled="false"><transform/></camera>'
    (folder / "cameras.xml").write_text(
        '<?xml version="1.0" encoding="UTF-8"?>\n<document version="2.1.0"><chunk label="a">'
        f'<sensors><sensor id="0" type="{kind}">{size}<calibration type="{kind}" class="initial">'
        f'{size}<f>9</f></calibration><calibration type="{kind}" class="adjusted">{size}{lens}'
        f"</calibration></sensor></sensors><cameras><group>{cameras}</group></cameras></chunk>"
        "</document>"
    )
    return folder


# OpenMVG: openMVG/cameras/*.hpp


def openmvg_lens(kind: str) -> dict:
    return {
        "pinhole": {},
        "pinhole_radial_k1": {"disto_k1": [K1]},
        "pinhole_radial_k3": {"disto_k3": [K1, K2, K3]},
        "pinhole_brown_t2": {"disto_t2": [K1, K2, K3, P1, P2]},
        "fisheye": {"fisheye": [K1, K2, K3, K4]},
    }.get(kind, {})


def write_openmvg(
    scene: Scene, folder: Path, kind: str = "pinhole", is_later: bool = False
) -> Path:
    # The centres of OpenMVG's pixels are integers.
    shared = {
        "width": WIDTH,
        "height": HEIGHT,
        "focal_length": FX,
        "principal_point": [CX - 0.5, CY - 0.5],
    }
    lens = openmvg_lens(kind)
    data = {"value0": shared, **lens} if is_later else {**shared, **lens}
    # The second camera is of the same type, whose name stands only once.
    intrinsics = [
        {"polymorphic_id": 1 | 1 << 31, "polymorphic_name": kind, "ptr_wrapper": {"data": data}},
        {"polymorphic_id": 1, "ptr_wrapper": {"data": data}},
    ]
    views = [
        {"local_path": "/", "filename": name, "id_view": i, "id_intrinsic": i % 2, "id_pose": i}
        for i, name in enumerate([*scene.names, "lost.png"])
    ]
    document = {
        "sfm_data_version": "0.3",
        "root_path": "C:/another/machine/images",
        "views": [{"key": i, "value": {"ptr_wrapper": {"data": v}}} for i, v in enumerate(views)],
        "intrinsics": [{"key": i, "value": entry} for i, entry in enumerate(intrinsics)],
        "extrinsics": [
            {
                "key": i,
                "value": {
                    "rotation": T[:3, :3].tolist(),
                    "center": np.linalg.inv(T)[:3, 3].tolist(),
                },
            }
            for i, T in enumerate(scene.T_cw)
        ],
        "structure": [],
    }
    place = folder / "reconstruction"
    place.mkdir()
    (place / "sfm_data.json").write_text(json.dumps(document))
    (folder / "matches").mkdir()
    empty = json.dumps({**document, "extrinsics": []})
    (folder / "matches" / "sfm_data.json").write_text(empty)
    return folder


# RealityCapture: "RealityCapture XMP Camera Math" and its template for OpenCV


def heading_pitch_roll(T_cw: np.ndarray) -> tuple[float, float, float]:
    """Degrees of Rz(-heading) Rx(pitch) Ry(roll), camera to world in OpenGL axes."""
    R = T_cw[:3, :3].T @ np.diag([1.0, -1.0, -1.0])
    angles = (math.atan2(R[0, 1], R[1, 1]), math.asin(R[2, 1]), math.atan2(-R[2, 0], R[2, 2]))
    heading, pitch, roll = map(math.degrees, angles)
    return heading, pitch, roll


RC_OLD = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"
RC_NEW = "#name,x,y,alt,yaw,pitch,roll,f_35mm,px_norm,py_norm,k1,k2,k3,k4,t1,t2"
RC_LENS = (
    FX / SIDE * 36,
    (CX - WIDTH / 2) / SIDE,
    (CY - HEIGHT / 2) / SIDE,
    *(K1, K2, K3, K4, P1, P2),
)


def write_rc_csv(scene: Scene, folder: Path, header: str = RC_OLD, lens=RC_LENS) -> Path:
    rows = [
        f"{name},"
        + ",".join(
            repr(float(x)) for x in (*np.linalg.inv(T)[:3, 3], *heading_pitch_roll(T), *lens)
        )
        for name, T in zip(scene.names, scene.T_cw, strict=True)
    ]
    count = f"#cameras {len(rows)}\n" if header == RC_OLD else ""
    (folder / "registration.csv").write_text(count + "\r\n".join([header, *rows]) + "\r\n")
    return folder


def write_rc_xmp(scene: Scene, folder: Path, model: str = "brown4t2", skew: float = 0.0) -> Path:
    f, px, py, *lens = RC_LENS
    for name, T in zip(scene.names, scene.T_cw, strict=True):
        R = " ".join(map(repr, T[:3, :3].ravel().tolist()))
        C = " ".join(map(repr, np.linalg.inv(T)[:3, 3].tolist()))
        (folder / "images" / name).with_suffix(".xmp").write_text(
            '<x:xmpmeta xmlns:x="adobe:ns:meta/">'
            '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
            f'<rdf:Description xcr:Version="3" xcr:DistortionModel="{model}" '
            f'xcr:FocalLength35mm="{f!r}" xcr:Skew="{skew}" xcr:AspectRatio="{FY / FX!r}" '
            f'xcr:PrincipalPointU="{px!r}" xcr:PrincipalPointV="{py!r}" '
            'xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#">'
            f"<xcr:Rotation>{R}</xcr:Rotation><xcr:Position>{C}</xcr:Position>"
            f"<xcr:DistortionCoeficients>{' '.join(map(repr, lens))}</xcr:DistortionCoeficients>"
            "</rdf:Description></rdf:RDF></x:xmpmeta>"
        )
    return folder


# MVSNet, Kapture, Bundler, VisualSFM: the descriptions of their formats


def write_mvsnet(scene: Scene, folder: Path, scale: float = 1.0) -> Path:
    (folder / "cams").mkdir()
    K = np.diag([scale, scale, 1.0]) @ [[FX, 0, CX], [0, FY, CY], [0, 0, 1]]
    for i, T in enumerate(scene.T_cw):
        lines = ["extrinsic", *(" ".join(map(repr, row)) for row in T.tolist()), ""]
        lines += ["intrinsic", *(" ".join(map(repr, row)) for row in K.tolist()), ""]
        text = "\n".join([*lines, "425.0 2.5", ""])
        (folder / "cams" / f"{i:08d}_cam.txt").write_text(text)
        (folder / "images" / scene.names[i]).rename(folder / "images" / f"{i:08d}.png")
    return folder


def write_kapture(scene: Scene, folder: Path) -> Path:
    place = folder / "sensors"
    place.mkdir()
    (folder / "images").rename(place / "records_data")
    lens = (FX, FY, CX, CY, K1, K2, P1, P2)
    numbers = ", ".join(map(repr, lens))
    head = "# kapture format: 1.1\n"
    (place / "sensors.txt").write_text(
        f"{head}# sensor_device_id, name, sensor_type, [sensor_params]+\n"
        f"cam0, phone, camera, OPENCV, {WIDTH}, {HEIGHT}, {numbers}\ngps, , gnss, EPSG:4326\n"
    )
    rows = [
        ", ".join(map(str, (i, "cam0", *quaternion_wxyz(T[:3, :3]).tolist(), *T[:3, 3].tolist())))
        for i, T in enumerate(scene.T_cw)
    ]
    (place / "trajectories.txt").write_text(head + "\n".join(rows))
    names = [*scene.names, "lost.png"]
    rows = [f"{i}, cam0, {name}" for i, name in enumerate(names)]
    (place / "records_camera.txt").write_text(head + "\n".join(rows))
    return folder


def write_bundler(scene: Scene, folder: Path) -> Path:
    lines = ["# Bundle file v0.3", f"{len(scene.names) + 1} 0"]
    for T in scene.T_cw:
        # Axes x right, y up, z backward.
        turned = np.diag([1.0, -1.0, -1.0, 1.0]) @ T
        lines += [f"{FX} {K1} {K2}", *(" ".join(map(repr, r)) for r in turned[:3, :3].tolist())]
        lines.append(" ".join(map(repr, turned[:3, 3].tolist())))
    lines += ["0 0 0"] * 5
    (folder / "bundle.out").write_text("\n".join(lines) + "\n")
    (folder / "list.txt").write_text("\n".join(f"{n} 0 532.5" for n in [*scene.names, "lost.png"]))
    return folder


R_VSFM = 0.02


def write_nvm(scene: Scene, folder: Path) -> Path:
    rows = []
    for name, T in zip(scene.names, scene.T_cw, strict=True):
        numbers = (FX, *quaternion_wxyz(T[:3, :3]), *np.linalg.inv(T)[:3, 3], R_VSFM, 0)
        rows.append(f"images/{name.replace(' ', chr(34))}\t" + " ".join(map(str, numbers)))
    text = "\n".join(["NVM_V3 ", "", str(len(rows)), *rows, "", "0", ""])
    (folder / "model.nvm").write_text(text)
    return folder
