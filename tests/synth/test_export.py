"""The written sequence: layout, exact round trip, the command, bad input."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from geogs.errors import InputError, OutputError
from geogs.evaluation.surfaces.surface import read_surface
from geogs.io.pose_files import read_poses
from geogs.io.sources.sniff import open_source
from geogs_synth.camera.flaws import Flaws, camera_flaws
from geogs_synth.cli import main
from geogs_synth.motion.room_motions import room_motion
from geogs_synth.raycast.raycaster import Raycaster
from geogs_synth.scene.textured_scene import Scene
from geogs_synth.sequence.location import centred_camera
from geogs_synth.sequence.replica_files import _encode, write_sequence
from handheld_walk import handheld_trajectory
from lit_rooms import lit_room

FRAMES, WIDTH, HEIGHT, SEED = 4, 96, 72, 3


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("synth") / "room"
    size = ["--width", str(WIDTH), "--height", str(HEIGHT), "--image-format", "png"]
    assert main([str(folder), "--frames", str(FRAMES), "--seed", str(SEED), "--video", *size]) == 0
    return folder


@pytest.fixture(scope="module")
def raycaster() -> Raycaster:
    return lit_room(SEED)


@pytest.fixture(scope="module")
def scene(raycaster: Raycaster) -> Scene:
    return raycaster.scene


def test_layout(sequence: Path) -> None:
    names = {str(path.relative_to(sequence)) for path in sequence.rglob("*") if path.is_file()}
    expected = {"cam_params.json", "traj.txt", "mesh.ply", "points_seen_1cm.ply", "video.mp4"}
    for i in range(FRAMES):
        expected |= {f"results/frame{i:06d}.png", f"results/depth{i:06d}.png"}
    assert names == expected


def test_round_trip(sequence: Path, scene: Scene, raycaster: Raycaster) -> None:
    """What is read back is what the raycaster gives for the poses and intrinsics read back."""
    parameters = json.loads((sequence / "cam_params.json").read_text())["camera"]
    camera = centred_camera(WIDTH, HEIGHT)
    for name, value in (("w", WIDTH), ("h", HEIGHT), ("fx", camera.fx), ("cy", camera.cy)):
        assert parameters[name] == value
    poses = np.loadtxt(sequence / "traj.txt").reshape(-1, 4, 4)
    np.testing.assert_allclose(poses, handheld_trajectory(scene, FRAMES, SEED), atol=1e-9)
    view = raycaster.render(camera, poses[3])
    image = cv2.imread(str(sequence / "results/frame000003.png"))[..., ::-1]
    assert np.abs(image.astype(int) - view.image).mean() < 0.01
    depth = cv2.imread(str(sequence / "results/depth000003.png"), cv2.IMREAD_UNCHANGED)
    assert depth.dtype == np.uint16
    assert np.abs(depth / parameters["scale"] - view.depth).max() < 0.6 / parameters["scale"]


def test_points_are_what_was_seen(sequence: Path, scene: Scene, raycaster: Raycaster) -> None:
    """They project onto themselves in some frame, and lie inside the room."""
    points = read_surface(sequence / "points_seen_1cm.ply").vertices
    assert len(points) > 5000
    assert (points > -1e-4).all()
    assert (points < scene.size + 1e-4).all()
    assert np.quantile(scene.clearance(points), 0.7) < 1e-4
    poses = handheld_trajectory(scene, FRAMES, SEED)
    camera = centred_camera(WIDTH, HEIGHT)
    best = np.full(len(points), np.inf)
    for T_wc in poses:
        depth = raycaster.render(camera, T_wc).depth
        x, y, z = ((points - T_wc[:3, 3]) @ T_wc[:3, :3]).T
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        column, row = np.rint(u).astype(int), np.rint(v).astype(int)
        ok = (z > 0) & (column >= 0) & (column < WIDTH) & (row >= 0) & (row < HEIGHT)
        ok &= (np.abs(u - column) < 1e-2) & (np.abs(v - row) < 1e-2)
        best[ok] = np.minimum(best[ok], np.abs(depth[row[ok], column[ok]] - z[ok]))
    assert (best < 1e-4).all()


def test_mesh_fills_the_room(sequence: Path, scene: Scene) -> None:
    mesh = read_surface(sequence / "mesh.ply")
    points, faces = mesh.vertices, mesh.faces
    np.testing.assert_allclose(points.min(0), 0, atol=1e-5)
    np.testing.assert_allclose(points.max(0), scene.size, atol=1e-5)
    assert faces.min() == 0
    assert faces.max() == len(points) - 1


def test_video_plays(sequence: Path) -> None:
    capture = cv2.VideoCapture(str(sequence / "video.mp4"))
    frames = []
    while (frame := capture.read())[0]:
        frames.append(frame[1])
    assert len(frames) == FRAMES
    image = cv2.imread(str(sequence / "results/frame000002.png"))
    assert np.abs(frames[2].astype(float) - image).mean() < 8


def test_a_video_of_the_same_images_is_the_same(tmp_path: Path, sequence: Path) -> None:
    """What a board or a test sees of a seed may not hang on the encoder."""
    image = np.tile(cv2.imread(str(sequence / "results/frame000000.png")), (2, 2, 1))
    noise = np.random.default_rng(0)
    shots = [
        SimpleNamespace(
            image=cv2.add(np.roll(image, 2 * n, 1), noise.integers(0, 9, image.shape, np.uint8))
        )
        for n in range(40)
    ]
    camera = centred_camera(image.shape[1], image.shape[0])
    videos = []
    for n in range(4):
        for _ in _encode(tmp_path / f"{n}.mp4", camera, 30.0, iter(shots)):
            pass
        capture, frames = cv2.VideoCapture(str(tmp_path / f"{n}.mp4")), []
        while (frame := capture.read())[0]:
            frames.append(frame[1])
        videos.append(np.stack(frames))
    assert len(videos[0]) == len(shots)
    assert all(np.array_equal(video, videos[0]) for video in videos)


def test_jpeg_without_depth(tmp_path: Path, raycaster: Raycaster) -> None:
    seen: list[int] = []
    write_sequence(tmp_path, 2, 32, 24, 1, depth=False, on_frame=seen.append, raycaster=raycaster)
    assert sorted(p.name for p in (tmp_path / "results").iterdir()) == [
        "frame000000.jpg",
        "frame000001.jpg",
    ]
    assert seen == [0, 1]


def test_bad_input(tmp_path: Path, raycaster: Raycaster) -> None:
    with pytest.raises(InputError, match="at least 1 frame"):
        write_sequence(tmp_path, 0)
    with pytest.raises(InputError, match="16 to"):
        write_sequence(tmp_path, 1, 4, 4, raycaster=raycaster)
    with pytest.raises(InputError, match="jpg or png"):
        write_sequence(tmp_path, 1, image_format="bmp")
    assert not list(tmp_path.iterdir())
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutputError):
        write_sequence(tmp_path / "file", 1, 32, 24, raycaster=raycaster)


def test_the_command_says_motion_and_flaws(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Single flaws win over those of the camera."""
    asked = {}
    monkeypatch.setattr(
        "geogs_synth.sequence.replica_files.write_sequence",
        lambda *args, **options: asked.update(options),
    )
    options = ["--motion", "handheld-5hz", "--camera", "action", "--flaws.readout", "0.03"]
    assert main([str(tmp_path), *options, "--moving", "0.2"]) == 0
    assert asked["flaws"] == replace(camera_flaws("action"), readout=0.03)
    assert (asked["motion"], asked["moving"]) == ("handheld-5hz", 0.2)
    assert main([str(tmp_path)]) == 0
    assert (asked["flaws"], asked["motion"], asked["moving"]) == (Flaws(), "handheld", 0)


def test_flawed_sequence_is_read_back(tmp_path: Path, scene: Scene, raycaster: Raycaster) -> None:
    """Distortion, times and truth; other sequences say nothing of them."""
    flaws = replace(camera_flaws("action"), readout=0.03)
    write_sequence(
        tmp_path, 3, 48, 36, SEED, motion="handheld-5hz", flaws=flaws, moving=0.2,
        raycaster=raycaster,
    )  # fmt: skip
    source = open_source(tmp_path)
    assert source.calibration.distortion == (-0.25, 0.06, 0.0, 0.0)
    assert source.fps == pytest.approx(5)
    assert [frame.timestamp for frame in source] == [0.0, 0.2, 0.4]
    poses = read_poses(tmp_path)
    path = room_motion("handheld-5hz", scene, SEED).path
    np.testing.assert_allclose(poses.T_wc, path(np.array([0.0, 0.2, 0.4])), atol=1e-9)
    np.testing.assert_allclose(poses.timestamps, [0.0, 0.2, 0.4])
    truth = json.loads((tmp_path / "cam_params.json").read_text())
    assert truth["readout"] == truth["flaws"]["readout"] == 0.03
    assert truth["flaws"]["exposure"] == 0.005
    assert truth["fps"] == 5.0
    assert truth["motion"] == "handheld-5hz"
    assert truth["moving"] == 0.2
    masks = [cv2.imread(str(tmp_path / f"results/moving{k:06d}.png"), 0) for k in range(3)]
    assert set(np.unique(masks)) <= {0, 255}
    assert np.mean(masks) > 0


def test_points_leave_out_what_moves(tmp_path: Path, scene: Scene, raycaster: Raycaster) -> None:
    take = {"seed": SEED, "motion": "handheld-5hz", "depth": False, "raycaster": raycaster}
    write_sequence(tmp_path, 9, 48, 36, moving=0.3, **take)
    points = read_surface(tmp_path / "points_seen_1cm.ply").vertices
    assert np.quantile(scene.clearance(points), 0.7) < 1e-4
    masks = [cv2.imread(str(tmp_path / f"results/moving{k:06d}.png"), 0) for k in range(9)]
    assert np.mean(masks) > 0.1 * 255
    seen = len(points)
    write_sequence(tmp_path, 9, 48, 36, **take)
    still = read_surface(tmp_path / "points_seen_1cm.ply").vertices
    assert seen < 0.95 * len(still)
    known = {tuple(np.rint(p * 1e4).astype(int)) for p in still}
    assert np.mean([tuple(np.rint(p * 1e4).astype(int)) in known for p in points]) > 0.9


def test_times_of_an_earlier_sequence_are_not_believed(
    tmp_path: Path, raycaster: Raycaster
) -> None:
    """A folder that was written at 5 Hz and is written again at 30 Hz is at 30 Hz."""
    for motion in ("handheld-5hz", "handheld"):
        write_sequence(tmp_path, 2, 32, 24, SEED, motion=motion, raycaster=raycaster)
    assert [frame.timestamp for frame in open_source(tmp_path)] == pytest.approx(
        [0, 1 / 30], abs=1e-6
    )
    assert read_poses(tmp_path).timestamps == pytest.approx([0, 1 / 30], abs=1e-6)


def test_png_goes_through_jpeg_where_asked(tmp_path: Path, raycaster: Raycaster) -> None:
    for name, flaws in (("a", Flaws()), ("b", Flaws(jpeg=10))):
        write_sequence(
            tmp_path / name, 1, 48, 36, SEED, image_format="png", flaws=flaws, raycaster=raycaster
        )
    images = [cv2.imread(str(tmp_path / k / "results/frame000000.png")).astype(int) for k in "ab"]
    assert 2 < np.abs(images[0] - images[1]).mean() < 30


def test_bad_flaws(tmp_path: Path, raycaster: Raycaster) -> None:
    with pytest.raises(InputError, match=r"flaws\.readout is 0.5, but must be"):
        main([str(tmp_path), "--flaws.readout", "0.5"])
    with pytest.raises(InputError, match="fold"):
        write_sequence(tmp_path, 1, flaws=Flaws(k1=-0.5), raycaster=raycaster)
    with pytest.raises(InputError, match="motion is 'flying', but must be handheld or"):
        main([str(tmp_path), "--motion", "flying"])
    assert not list(tmp_path.iterdir())
