"""Data sets as they lie on disk: images, times, cameras and true poses."""

import numpy as np
import pytest

from data_set_layouts import LAYOUTS, Sample, kitti_odometry, tum_rows, walk
from geogs.config import InputConfig
from geogs.errors import InputError
from geogs.evaluation.trajectory_errors import evaluate_trajectory
from geogs.evaluation.true_scene import read_true_scene
from geogs.io.pose_files import read_tum_trajectory
from geogs.io.sources.calibration_files import read_calibration
from geogs.io.sources.sniff import open_posed_source, open_source
from io_samples import write_images
from pose_samples import walked, write_polycam, write_record3d, write_stray

WHOLE = InputConfig(long_edge=0)


@pytest.fixture(params=LAYOUTS)
def sample(request, tmp_path) -> Sample:
    return LAYOUTS[request.param](tmp_path)


def test_images_times_and_camera_are_found_from_each_folder(sample):
    for folder in sample.given:
        source = open_source(folder, WHOLE)
        assert source.kind == sample.kind, folder
        times = [frame.timestamp for frame in source]
        np.testing.assert_allclose(times, sample.times, rtol=0, atol=2e-6)
        camera = source.calibration
        found = (camera.fx, camera.fy, camera.cx, camera.cy)
        np.testing.assert_allclose(found, sample.camera, atol=1e-6)
        np.testing.assert_allclose(camera.distortion, sample.distortion)
        assert camera.lens == sample.lens
        assert not camera.is_guess
    assert open_source(sample.given[0], InputConfig(depth="auto")).uses_depth == sample.has_depth


def test_the_true_poses_are_those_of_the_camera_that_is_read(sample, tmp_path):
    """A trajectory of the images, turned, moved and halved, lies on the truth again."""
    moved = np.diag([0.5, 0.5, 0.5, 1.0])
    moved[:3, :3] @= walk()[7, :3, :3]
    moved[:3, 3] = 1.0, -2.0, 3.0
    T_wc = walk()
    placed = np.tile(np.eye(4), (len(T_wc), 1, 1))
    placed[:, :3, :3] = moved[:3, :3] / 0.5 @ T_wc[:, :3, :3]
    placed[:, :3, 3] = T_wc[:, :3, 3] @ moved[:3, :3].T + moved[:3, 3]
    file = tmp_path / "trajectory.tum"
    file.write_text(tum_rows(sample.times[-len(T_wc) :], placed))
    for truth in sample.truths:
        scene = read_true_scene(truth)
        errors = evaluate_trajectory(read_tum_trajectory(file), scene.trajectory)
        assert errors.pairs == len(T_wc), truth
        assert errors.scale == pytest.approx(2, abs=1e-5)
        assert errors.ate_max_cm < 0.01
        assert errors.rotation_rmse_deg < 1e-3


def test_images_are_read_with_their_poses(sample):
    for folder in {sample.given[0], *(t for t in sample.truths if t.is_dir())}:
        source = open_posed_source(folder, WHOLE)
        assert len(source) == len(walk())
        assert source.scene_scale == "metres"


def test_its_calibration_can_be_given(sample):
    for file in sample.calibrations:
        camera = read_calibration(file)
        found = (camera.fx, camera.fy, camera.cx, camera.cy)
        np.testing.assert_allclose(found, sample.camera, atol=1e-6)
        np.testing.assert_allclose(camera.distortion, sample.distortion)
        assert camera.lens == sample.lens


def test_the_poses_of_kitti_are_those_of_camera_0(tmp_path):
    """The file alone says nothing of image_2, which is 6 cm beside; its times it has."""
    sample = kitti_odometry(tmp_path)
    folder = sample.given[0]
    scene = read_true_scene(folder.parent.parent / "poses" / "07.txt")
    np.testing.assert_allclose(scene.trajectory.timestamps, sample.times, atol=1e-6)
    beside = scene.trajectory.T_wc[:, :3, 3] - walk()[:, :3, 3]
    np.testing.assert_allclose(np.linalg.norm(beside, axis=1), 0.06, atol=1e-9)
    grey = read_true_scene(folder / "image_0").trajectory.T_wc
    np.testing.assert_allclose(grey, scene.trajectory.T_wc, atol=1e-9)


def test_unrectified_images_of_kitti_have_the_unrectified_camera(tmp_path):
    folder = LAYOUTS["kitti-raw"](tmp_path).given[0]
    for image in (folder / "image_02/data").iterdir():
        image.unlink()
    write_images(folder / "image_02/data", ["0000000000.png"], 70, 50)
    camera = open_source(folder, WHOLE).calibration
    assert (camera.fx, camera.cx, camera.distortion) == (70, 35, (-0.3, 0.1, 0, 0, 0))
    with pytest.raises(InputError, match="are those of rectified images"):
        open_posed_source(folder)


def test_what_apps_export_is_found_in_the_folder_above(tmp_path):
    poses = walked(3)
    (tmp_path / "stray" / "71de12f9").mkdir(parents=True)
    write_stray(tmp_path / "stray" / "71de12f9", poses)
    write_polycam(tmp_path / "polycam" / "export", poses)
    write_record3d(tmp_path / "record3d" / "2024-01-01--12-00-00", poses)
    for name in ("stray", "polycam", "record3d"):
        assert open_source(tmp_path / name, WHOLE).kind == name
    matrix = read_calibration(tmp_path / "stray" / "71de12f9" / "camera_matrix.csv")
    assert (matrix.fx, matrix.cx) == (50, 31.5)
    metadata = tmp_path / "record3d" / "2024-01-01--12-00-00" / "metadata"
    camera = read_calibration(metadata)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (50, 51, 31, 23)


def test_several_sequences_are_named(tmp_path):
    for name in ("P000", "P001"):
        write_images(tmp_path / name / "image_left", ["000000_left.png"])
    with pytest.raises(InputError, match=r"holds several sequences; give one of P000, P001\."):
        open_source(tmp_path)


@pytest.mark.parametrize(
    ("present", "sentence"),
    [
        ("times.txt", "looks like KITTI odometry, for it holds times.txt, but image_2"),
        ("mav0/imu0/data.csv", "looks like EuRoC or TUM-VI, for it holds mav0, but mav0/cam0/data"),
        ("groundtruth.txt", "looks like TUM RGB-D, for it holds groundtruth.txt, but rgb.txt"),
        ("livingRoom1.gt.freiburg", "looks like ICL-NUIM"),
        ("lowres_wide.traj", "looks like ARKitScenes"),
        ("pose_left.txt", "looks like TartanAir"),
        ("dslr_calibration_undistorted/cameras.txt", "looks like ETH3D"),
        ("iphone/rgb.mkv", r"looks like ScanNet\+\+, .*extract them"),
        ("odometry.csv", "looks like Stray Scanner, .* but rgb.mp4 is missing"),
        ("keyframes/cameras/1.json", "looks like Polycam, .* but keyframes/images is missing"),
    ],
)
def test_near_misses_say_what_is_missing(tmp_path, present, sentence):
    (tmp_path / present).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / present).write_text("")
    with pytest.raises(InputError, match=sentence):
        open_source(tmp_path)


def test_missing_truth_is_named(tmp_path):
    folder = kitti_odometry(tmp_path).given[0]
    (tmp_path / "dataset" / "poses" / "07.txt").unlink()
    with pytest.raises(InputError, match=r"without true poses: 07\.txt is in none of"):
        read_true_scene(folder)
    drive = LAYOUTS["kitti-raw"](tmp_path).given[0]
    (drive.parent / "calib_imu_to_velo.txt").unlink()
    with pytest.raises(InputError, match=r"calib_imu_to_velo\.txt is missing"):
        read_true_scene(drive)


def test_times_of_images_that_colmap_left_out_are_no_others(tmp_path):
    """The place of an image is compared at the time that run gives it."""
    sample = LAYOUTS["scannetpp-phone"](tmp_path)
    project = tmp_path / "project"
    (project / "sparse").mkdir(parents=True)
    (sample.given[1] / "rgb").rename(project / "images")
    (sample.given[1] / "colmap").rename(project / "sparse" / "0")
    times = open_posed_source(project).timestamps
    np.testing.assert_allclose(times, np.arange(1, 11) / 30)
