"""Views listed by other programs: a scene in each program's own convention comes back as it was.

Every program's projection is written here from its documentation, from a point in camera axes to
the pixel in the program's own count; pixels here have their centres at integers.
"""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from geogs.config import InputConfig
from geogs.errors import InputError
from geogs.io.sources.formats import realitycapture
from geogs.io.sources.posed.posed_set import PosedSet
from geogs.io.sources.sniff import _posed_set, open_posed_source
from io_samples import write_image
from lenses import distorted_pixels
from posed_layouts import Room, render_room
from view_lists import (
    CX,
    CY,
    FX,
    FY,
    HEIGHT,
    K1,
    K2,
    K3,
    K4,
    P1,
    P2,
    R_VSFM,
    RC_NEW,
    RC_OLD,
    WIDTH,
    Scene,
    opensfm_camera,
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

NATIVE = InputConfig(long_edge=0)
NAMES = [f"view {i}.png" for i in (1, 2, 10)]

Project = Callable[[np.ndarray], np.ndarray]
"""From points in camera axes (n, 3) to pixels (n, 2), the centre of the first being (0.5, 0.5)."""


def brown(x, y, radial=(), first=0.0, second=0.0):
    """Brown's lens; ``first`` is the tangential term with r^2 + 2 x^2."""
    square = x * x + y * y
    factor = 1 + sum(k * square ** (n + 1) for n, k in enumerate(radial))
    return (
        x * factor + first * (square + 2 * x * x) + 2 * second * x * y,
        y * factor + second * (square + 2 * y * y) + 2 * first * x * y,
    )


def fisheye(x, y, radial=()):
    """An equidistant fisheye."""
    r = np.hypot(x, y)
    angle = np.arctan(r)
    bent = angle * (1 + sum(k * angle ** (2 * n + 2) for n, k in enumerate(radial)))
    return x * bent / r, y * bent / r


def projecting(lens, fx=FX, fy=FY, cx=CX, cy=CY) -> Project:
    def project(points):
        x, y = lens(points[:, 0] / points[:, 2], points[:, 1] / points[:, 2])
        return np.stack([fx * x + cx, fy * y + cy], 1)

    return project


@pytest.fixture(scope="module")
def room() -> Room:
    return render_room(3, 5, WIDTH, HEIGHT)


@pytest.fixture
def scene(room: Room, tmp_path: Path) -> Scene:
    for name, image in zip(NAMES, room.images, strict=True):
        write_image(tmp_path / "images" / name, image)
    return Scene(list(room.T_cw), NAMES)


def opensfm_projection(kind: str) -> Project:
    lens = {
        "perspective": lambda x, y: brown(x, y, (K1, K2)),
        "radial": lambda x, y: brown(x, y, (K1, K2)),
        "simple_radial": lambda x, y: brown(x, y, (K1,)),
        "brown": lambda x, y: brown(x, y, (K1, K2, K3), P2, P1),
        "fisheye": lambda x, y: fisheye(x, y, (K1, K2)),
        "fisheye_opencv": lambda x, y: fisheye(x, y, (K1, K2, K3, K4)),
    }[kind]
    if kind in ("perspective", "fisheye"):
        return projecting(lens, FX, FX, WIDTH / 2, HEIGHT / 2)
    return projecting(lens)


def vsfm_lens(x, y):
    """The inverse of x = m (1 + r m^2), by fixed point."""
    u, v = x, y
    for _ in range(60):
        factor = 1 + R_VSFM * (u * u + v * v)
        u, v = x / factor, y / factor
    return u, v


BROWN = projecting(lambda x, y: brown(x, y, (K1, K2, K3, K4), P1, P2), FX, FX)
MIDDLE = WIDTH / 2, HEIGHT / 2
CASES = {
    **{
        f"opensfm {kind}": (
            lambda s, f, kind=kind: write_opensfm(s, f, kind),
            opensfm_projection(kind),
        )
        for kind in (
            *("perspective", "simple_radial", "radial", "brown", "fisheye", "fisheye_opencv"),
        )
    },
    "metashape frame": (
        lambda s, f: write_metashape(s, f, k4=K4, p1=P1, p2=P2),
        projecting(lambda x, y: brown(x, y, (K1, K2, K3, K4), P1, P2)),
    ),
    "metashape fisheye": (
        lambda s, f: write_metashape(s, f, "equidistant_fisheye", k4=K4),
        projecting(lambda x, y: fisheye(x, y, (K1, K2, K3, K4))),
    ),
    **{
        f"openmvg {kind}": (
            lambda s, f, kind=kind: write_openmvg(s, f, kind, "brown" in kind or "fish" in kind),
            projecting(lens, FX, FX),
        )
        for kind, lens in {
            "pinhole": lambda x, y: (x, y),
            "pinhole_radial_k1": lambda x, y: brown(x, y, (K1,)),
            "pinhole_radial_k3": lambda x, y: brown(x, y, (K1, K2, K3)),
            "pinhole_brown_t2": lambda x, y: brown(x, y, (K1, K2, K3), P2, P1),
            "fisheye": lambda x, y: fisheye(x, y, (K1, K2, K3, K4)),
        }.items()
    },
    "realitycapture csv": (write_rc_csv, BROWN),
    "realitycapture csv 2": (lambda s, f: write_rc_csv(s, f, RC_NEW), BROWN),
    "realitycapture xmp": (
        write_rc_xmp,
        projecting(lambda x, y: brown(x, y, (K1, K2, K3, K4), P1, P2)),
    ),
    "mvsnet": (write_mvsnet, projecting(lambda x, y: (x, y))),
    "mvsnet of quarters": (lambda s, f: write_mvsnet(s, f, 0.25), projecting(lambda x, y: (x, y))),
    "kapture": (write_kapture, projecting(lambda x, y: brown(x, y, (K1, K2), P2, P1))),
    "bundler": (write_bundler, projecting(lambda x, y: brown(x, y, (K1, K2)), FX, FX, *MIDDLE)),
    "visualsfm": (write_nvm, projecting(vsfm_lens, FX, FX, *MIDDLE)),
}


def seen(posed: PosedSet, index: int, points: np.ndarray) -> np.ndarray:
    """Pixels of world points in an image, by what was read."""
    file = posed.files[index]
    camera = file.calibration.fit(WIDTH, HEIGHT)
    inside = points @ file.T_cw[:3, :3].T + file.T_cw[:3, 3]
    rays = inside[:, :2] / inside[:, 2:]
    return distorted_pixels(rays, camera.camera(), camera.distortion, camera.lens)


@pytest.mark.parametrize("case", CASES)
def test_points_are_seen_where_the_program_sees_them(case, scene, tmp_path):
    write, project = CASES[case]
    posed = _posed_set(write(scene, tmp_path))
    assert posed.kind == case.split()[0]
    assert len(posed.files) == len(NAMES)
    u, v = np.meshgrid(np.linspace(0, WIDTH, 7), np.linspace(0, HEIGHT, 6))
    rays = np.stack([(u - CX).ravel() / FX, (v - CY).ravel() / FY, np.ones(u.size)], 1)
    depths = np.linspace(1, 4, u.size)[:, None]
    for i, T in enumerate(scene.T_cw):
        T_wc = np.linalg.inv(T)
        world = rays * depths @ T_wc[:3, :3].T + T_wc[:3, 3]
        np.testing.assert_allclose(posed.files[i].T_cw, T, atol=1e-9)
        np.testing.assert_allclose(seen(posed, i, world) + 0.5, project(rays), atol=0.02)


@pytest.mark.parametrize(
    "write",
    [
        write_mvsnet,
        lambda s, f: write_openmvg(s, f),
        lambda s, f: write_metashape(s, f, k1=0.0, k2=0.0, k3=0.0),
    ],
)
def test_images_are_those_of_the_scene_in_order_of_their_names(write, scene, room, tmp_path):
    source = open_posed_source(write(scene, tmp_path), NATIVE)
    assert len(source) == len(NAMES)
    for view, image in zip(source, room.images, strict=True):
        np.testing.assert_array_equal(view.image, image)


def test_angles_of_realitycapture_are_those_that_it_wrote():
    """An image for which a user posted both of its exports; the matrix is that of the XMP."""
    row = {"name": "a", "x": "0", "y": "0", "alt": "0", "f": "30", "heading": "163.736597399311"}
    row |= {"pitch": "83.4154313461628", "roll": "174.386496244756"}
    T_cw = realitycapture._row_view(row, Path("a.csv")).T_cw
    expected = [
        [0.982594073038806, 0.185426733553445, -0.0112166890261935],
        [-0.032113633044729, 0.11008102707942, -0.993403685341366],
        [-0.18296885582437, 0.976472781986697, 0.114],
    ]
    np.testing.assert_allclose(T_cw[:3, :3], expected, atol=2e-4)
    np.testing.assert_allclose(T_cw[:2, :3], expected[:2], atol=1e-9)


def left(posed: PosedSet) -> str:
    return "; ".join(posed.account.left)


def test_what_is_not_used_is_named(scene, room, tmp_path):
    write_opensfm(scene, tmp_path)
    write_image(tmp_path / "images" / "spare.png", room.images[0])
    posed = _posed_set(tmp_path)
    file = tmp_path / "reconstruction.json"
    assert posed.account.used == (f"poses and cameras of {file}",)
    assert f"smaller reconstructions of {file}: one of 1 images" in left(posed)
    assert f"1 pictures beside them that {file} does not list (spare.png)" in left(posed)


@pytest.mark.parametrize("write", [write_metashape, write_openmvg, write_kapture, write_bundler])
def test_images_without_a_pose_are_named(write, scene, tmp_path):
    posed = _posed_set(write(scene, tmp_path))
    assert "1 of 4 images that " in left(posed)
    assert "lists without a pose (lost" in left(posed)
    assert ("1 cameras that are disabled" in left(posed)) == (write is write_metashape)


def test_a_file_is_used_though_others_are_there(scene, tmp_path):
    write_opensfm(scene, tmp_path)
    write_metashape(scene, tmp_path)
    posed = _posed_set(tmp_path)
    assert posed.kind == "opensfm"
    assert f"{tmp_path / 'cameras.xml'} of Metashape, as the other poses are there" in left(posed)
    assert _posed_set(tmp_path / "cameras.xml").kind == "metashape"


def test_names_of_another_machine_are_found(scene, tmp_path):
    write_rc_csv(scene, tmp_path)
    file = tmp_path / "registration.csv"
    file.write_text(file.read_text().replace("view ", "D:\\shots\\VIEW "))
    assert [f.path.name for f in _posed_set(file).files] == NAMES


def test_a_name_that_stands_twice_is_not_guessed(scene, tmp_path):
    write_metashape(scene, tmp_path)
    file = tmp_path / "cameras.xml"
    file.write_text(file.read_text().replace('label="view 2"', 'label="view 1"'))
    posed = _posed_set(file)
    assert [f.path.name for f in posed.files] == ["view 10.png"]
    assert f"1 names that {file} lists more than once (view 1)" in left(posed)


def test_small_terms_of_a_lens_are_named(scene, tmp_path):
    posed = _posed_set(write_metashape(scene, tmp_path, b2=0.3))
    assert "b2 of the lens in" in "; ".join(posed.files[0].calibration.account.left)


@pytest.mark.parametrize("kind", ["spherical", "fisheye62", "dual"])
def test_other_cameras_of_opensfm_are_refused(kind, scene, tmp_path):
    with pytest.raises(InputError, match=rf"a camera of type {kind}, which is not supported"):
        _posed_set(write_opensfm(scene, tmp_path, kind))


def test_one_image_by_another_camera_is_left_out(scene, tmp_path):
    write_opensfm(scene, tmp_path)
    file = tmp_path / "reconstruction.json"
    document = json.loads(file.read_text())
    document[1]["cameras"]["ball"] = opensfm_camera("spherical")
    document[1]["shots"][NAMES[1]]["camera"] = "ball"
    file.write_text(json.dumps(document))
    posed = _posed_set(tmp_path)
    assert [f.path.name for f in posed.files] == [NAMES[0], NAMES[2]]
    assert "1 images by cameras that are not supported" in left(posed)


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (lambda s, f: write_metashape(s, f, "spherical"), "a sensor of type spherical"),
        (lambda s, f: write_metashape(s, f, "equisolid_fisheye"), "type equisolid_fisheye"),
        (lambda s, f: write_metashape(s, f, b2=3.0), r"b2 of a lens, of 1\.5 pixels"),
        (lambda s, f: write_metashape(s, f, "fisheye", p1=0.02), "p1, p2 of a lens"),
        (lambda s, f: write_metashape(s, f, p1=0.02, p3=2.0), "p3, p4 of a lens"),
        (lambda s, f: write_metashape(s, f, fx=70.0), "PhotoScan before 1.2"),
        (lambda s, f: write_openmvg(s, f, "spherical"), "a camera of type spherical"),
        (lambda s, f: write_rc_xmp(s, f, "division"), "a lens of type division"),
        (lambda s, f: write_rc_xmp(s, f, skew=0.1), "skew of a lens"),
        (lambda s, f: write_rc_csv(s, f, RC_OLD.replace(",f,", ",g,")), "has no column f; export"),
    ],
)
def test_what_is_not_supported_is_refused_with_its_reason(write, message, scene, tmp_path):
    with pytest.raises(InputError, match=message):
        _posed_set(write(scene, tmp_path))


def test_a_lens_that_may_be_of_another_kind_is_said(scene, tmp_path):
    lens = (26.0, 0.0, 0.0, -0.1, 0.0, 0.0, 0.0, 0.0, 0.0)
    posed = _posed_set(write_rc_csv(scene, tmp_path, lens=lens))
    assert "as that of a Brown lens" in posed.files[0].calibration.account.used[0]


def test_positions_that_may_be_degrees_are_said(scene, tmp_path):
    write_rc_csv(scene, tmp_path)
    file = tmp_path / "registration.csv"
    assert len(_posed_set(file).account.used) == 1
    rows = [row.split(",") for row in file.read_text().splitlines()[2:]]
    turned = [[n, f"{14 + float(x) / 1e5}", f"{50 + float(y) / 1e5}", *r] for n, x, y, *r in rows]
    file.write_text("\n".join([RC_OLD, *(",".join(row) for row in turned)]))
    assert "if they are degrees, export in a local" in "; ".join(_posed_set(file).account.used)


def test_bundler_without_its_list_is_refused(scene, tmp_path):
    write_bundler(scene, tmp_path)
    (tmp_path / "list.txt").unlink()
    with pytest.raises(InputError, match=r"names no images; put the list of them beside it"):
        _posed_set(tmp_path)


def test_xml_that_defines_entities_is_refused(scene, tmp_path):
    write_metashape(scene, tmp_path)
    file = tmp_path / "cameras.xml"
    text = file.read_text().replace("<document", "<!DOCTYPE a [<!ENTITY b 'c'>]><document", 1)
    file.write_text(text)
    with pytest.raises(InputError, match="no plain XML"):
        _posed_set(file)


@pytest.mark.parametrize(
    ("images", "place"),
    [("images", "images"), ("DCIM", "."), ("images", "export/cameras"), ("photos", "opensfm")],
)
def test_images_are_found_around_the_file(images, place, scene, tmp_path):
    folder = tmp_path / "scene"
    folder.mkdir()
    (tmp_path / "images").rename(folder / images)
    (folder / place).mkdir(parents=True, exist_ok=True)
    # A picture that is none of the scene lies beside the file.
    write_image(folder / place / "logo.png", np.zeros((8, 8, 3), np.uint8))
    posed = _posed_set(write_metashape(scene, folder / place))
    assert [f.path for f in posed.files] == [(folder / images / name).resolve() for name in NAMES]
    assert posed.name == "scene"


def test_a_compensated_rolling_shutter_is_named(scene, tmp_path):
    write_metashape(scene, tmp_path)
    file = tmp_path / "cameras.xml"
    text = file.read_text()
    assert "rolling shutter" not in left(_posed_set(file))
    for mode in ("disabled", "full"):
        tag = f"<rolling_shutter_mode>{mode}</rolling_shutter_mode></sensor>"
        file.write_text(text.replace("</sensor>", tag))
        assert ("the rolling shutter in" in left(_posed_set(file))) == (mode == "full")


def test_the_component_with_most_images_is_used(scene, tmp_path):
    write_metashape(scene, tmp_path)
    file = tmp_path / "cameras.xml"
    text = file.read_text().replace(
        'component_id="0" label="view 1"', 'component_id="1" label="view 1"'
    )
    file.write_text(text)
    posed = _posed_set(file)
    assert [f.path.name for f in posed.files] == NAMES[1:]
    assert f"smaller parts of {file}: 1 images of a component" in left(posed)


def test_a_sensor_that_states_no_size_is_refused(scene, tmp_path):
    write_metashape(scene, tmp_path)
    file = tmp_path / "cameras.xml"
    file.write_text(file.read_text().replace("<resolution", "<other"))
    with pytest.raises(InputError, match="cannot be understood"):
        _posed_set(file)
