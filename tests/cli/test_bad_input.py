"""Everything a user can get wrong ends in one sentence and leaves no debris."""

import errno
import io
import os
from pathlib import Path

import numpy as np
import pytest
import torch

from geogs.config import InputConfig
from geogs.errors import GeogsError, InputError, OutputError
from geogs.guard import atomic
from geogs.guard.atomic import prepare_output_folder, write_text
from geogs.io.pose_files import read_tum_trajectory
from geogs.io.sources.sniff import open_source
from geogs.io.writers.map_file import save_map
from geogs.io.writers.ply_writer import write_mesh, write_splats
from geogs.io.writers.trajectories import write_tum_trajectory
from geogs.types import MapSnapshot, Trajectory
from io_samples import gradient_image, write_image, write_images, write_video

GIVEN = InputConfig(intrinsics="50,50,31.5,23.5")


def read_all(path: Path, config: InputConfig = GIVEN) -> int:
    """Open and read a source to its end."""
    return sum(1 for _ in open_source(path, config))


def sentence(error: pytest.ExceptionInfo[GeogsError]) -> str:
    """The message, which must be one line that ends like a sentence."""
    text = str(error.value)
    assert "\n" not in text
    assert text.endswith((".", "?"))
    return text


# Sources


def test_missing_source(tmp_path):
    with pytest.raises(InputError) as error:
        read_all(tmp_path / "video.mp4")
    assert sentence(error).endswith("does not exist; give a video or a folder of images.")


@pytest.mark.parametrize("names", [[], ["notes.txt", ".hidden.png"]])
def test_folder_without_images(tmp_path, names):
    for name in names:
        (tmp_path / name).write_bytes(b"x")
    with pytest.raises(InputError) as error:
        read_all(tmp_path)
    assert "holds no images" in sentence(error)


def test_empty_file(tmp_path):
    (tmp_path / "video.mp4").touch()
    with pytest.raises(InputError) as error:
        read_all(tmp_path / "video.mp4")
    assert "is empty" in sentence(error)


@pytest.mark.parametrize("name", ["video.mp4", "video.txt", "video"])
def test_text_is_no_video(tmp_path, name):
    (tmp_path / name).write_text("this is no video\n" * 100)
    with pytest.raises(InputError) as error:
        read_all(tmp_path / name)
    assert "video" in sentence(error)


def test_random_bytes_are_no_video(tmp_path):
    data = np.random.default_rng(0).integers(0, 256, 5000).astype(np.uint8).tobytes()
    (tmp_path / "video.mp4").write_bytes(data)
    with pytest.raises(InputError) as error:
        read_all(tmp_path / "video.mp4")
    sentence(error)


def test_sound_is_no_video(tmp_path):
    import wave

    with wave.open(str(tmp_path / "sound.wav"), "wb") as sound:
        sound.setnchannels(1)
        sound.setsampwidth(2)
        sound.setframerate(8000)
        sound.writeframes(bytes(16000))
    with pytest.raises(InputError) as error:
        read_all(tmp_path / "sound.wav")
    assert "no video" in sentence(error)


@pytest.mark.parametrize("name", ["photo.png", "photo_without_suffix"])
def test_single_picture(tmp_path, name):
    write_image(tmp_path / "photo.png", gradient_image(0)).rename(tmp_path / name)
    with pytest.raises(InputError) as error:
        read_all(tmp_path / name)
    assert "single picture" in sentence(error)


def test_truncated_video_without_index(tmp_path):
    path = write_video(tmp_path / "v.mp4", [gradient_image(i) for i in range(5)])
    path.write_bytes(path.read_bytes()[:-500])
    with pytest.raises(InputError) as error:
        read_all(path)
    assert "is it complete" in sentence(error)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_unreadable_file(tmp_path):
    path = write_video(tmp_path / "v.mp4", [gradient_image(i) for i in range(5)])
    path.chmod(0)
    with pytest.raises(InputError) as error:
        read_all(path)
    sentence(error)


def test_images_that_are_all_damaged(tmp_path):
    for name in ("a.png", "b.jpg"):
        (tmp_path / name).write_bytes(b"\x89PNG but not really")
    with pytest.raises(InputError) as error:
        read_all(tmp_path)
    assert "none of its 2 images can be read" in sentence(error)


def test_selected_images_that_are_all_damaged(tmp_path):
    write_images(tmp_path, ["a.png"])
    (tmp_path / "b.png").write_bytes(b"damaged")
    with pytest.raises(InputError) as error:
        read_all(tmp_path, InputConfig(intrinsics=GIVEN.intrinsics, start=1))
    assert "none of its 1 images can be used" in sentence(error)


def test_an_image_of_another_size_is_skipped_and_named(tmp_path, caplog):
    write_images(tmp_path, ["a.png", "b.png"])
    write_image(tmp_path / "c.png", gradient_image(0, 48, 64))
    with caplog.at_level("WARNING", "geogs"):
        assert read_all(tmp_path) == 2
    assert "c.png is 48x64 but the others are 64x48; skipped." in caplog.text


def test_the_size_that_most_images_have_is_that_of_the_recording(tmp_path, caplog):
    write_images(tmp_path, [f"b{i}.png" for i in range(23)])
    write_image(tmp_path / "a.png", gradient_image(0, 48, 64))
    (tmp_path / "c.png").write_bytes(b"damaged")
    with caplog.at_level("WARNING", "geogs"):
        source = open_source(tmp_path, GIVEN)
        frames = list(source)
    assert {frame.image.shape for frame in frames} == {(48, 64, 3)}
    assert (len(frames), source.place.skipped) == (23, 2)
    assert "a.png is 48x64 but the others are 64x48; skipped." in caplog.text


def test_image_list_with_missing_files(tmp_path):
    (tmp_path / "rgb.txt").write_text("1.0 rgb/a.png\n")
    with pytest.raises(InputError) as error:
        read_all(tmp_path)
    assert "none of its 1 images can be read" in sentence(error)
    (tmp_path / "rgb.txt").write_text("# only a comment\n")
    with pytest.raises(InputError) as error:
        read_all(tmp_path)
    assert "lists no images" in sentence(error)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (InputConfig(start=4), "start is 4, but the source has only 4 frames"),
        (InputConfig(intrinsics="nan,50,32,24"), "NaN"),
        (InputConfig(intrinsics="50,50,32,inf"), "infinity"),
        (InputConfig(intrinsics="50,50,32,24,nan,0,0,0"), "NaN"),
        (InputConfig(intrinsics="0,50,32,24"), "must be positive"),
        (InputConfig(intrinsics="-50,50,32,24"), "must be positive"),
        (InputConfig(intrinsics="50,50,32"), "hold 3 numbers"),
        (InputConfig(intrinsics="500,500,320,240"), "another resolution"),
        (InputConfig(intrinsics="camera.json"), "neither auto, nor a file"),
    ],
)
def test_options_that_do_not_fit(tmp_path, config, message):
    write_images(tmp_path, [f"{i}.png" for i in range(4)])
    with pytest.raises(InputError) as error:
        read_all(tmp_path, config)
    assert message in sentence(error)


def test_damaged_calibration_of_a_data_set(tmp_path):
    write_images(tmp_path / "results", ["frame000000.jpg"])
    for content in ("", '{"camera": {"fx": NaN, "fy": 1, "cx": 1, "cy": 1}}'):
        (tmp_path / "cam_params.json").write_text(content)
        with pytest.raises(InputError) as error:
            read_all(tmp_path, InputConfig())
        assert "cam_params.json" in sentence(error)


# Poses


def test_poses_with_w_first(tmp_path):
    (tmp_path / "gt.txt").write_text("0 0 0 0 1 0 0 0\n")
    with pytest.raises(InputError) as error:
        read_tum_trajectory(tmp_path / "gt.txt")
    assert "w x y z order" in sentence(error)


def test_poses_that_are_all_invalid(tmp_path):
    (tmp_path / "gt.txt").write_text("0 nan 0 0 0 0 0 1\n1 0 0 0 0 0 0 0\n2 0 0 inf 0 0 0 1\n")
    with pytest.raises(InputError) as error:
        read_tum_trajectory(tmp_path / "gt.txt")
    assert "no valid pose" in sentence(error)


# Results


class FullDisk(io.FileIO):
    """A file on a disk with room for a hundred bytes."""

    def write(self, data) -> int:
        if self.tell() + len(data) > 100:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return super().write(data)


def write_disks(path: Path, write) -> None:
    disks = MapSnapshot(
        position=torch.zeros(99, 3),
        quaternion=torch.tensor([[1.0, 0, 0, 0]]).repeat(99, 1),
        scale=torch.ones(99, 2),
        opacity=torch.full((99,), 0.5),
    )
    write(path, disks)


WRITERS = {
    "text": lambda path: write_text(path, "x" * 1000),
    "trajectory": lambda path: write_tum_trajectory(
        path, Trajectory(np.arange(9.0), np.tile(np.eye(4), (9, 1, 1)), np.ones(9, dtype=bool))
    ),
    "mesh": lambda path: write_mesh(path, np.zeros((99, 3)), np.zeros((99, 3), dtype=int)),
    "splats": lambda path: write_disks(path, lambda p, d: write_splats(p, d, np.zeros((99, 3)))),
    "map": lambda path: write_disks(path, save_map),
}


@pytest.mark.parametrize("kind", WRITERS)
def test_disk_full(tmp_path, monkeypatch, kind):
    path = tmp_path / "result"
    path.write_text("former result")
    real_open = Path.open

    def open_on_full_disk(self, mode="r", *args, **kwargs):
        return FullDisk(self, "w") if "w" in mode else real_open(self, mode, *args, **kwargs)

    monkeypatch.setattr(Path, "open", open_on_full_disk)
    with pytest.raises(OutputError) as error:
        WRITERS[kind](path)
    monkeypatch.undo()
    assert "No space left on device" in sentence(error)
    assert path.read_text() == "former result"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_read_only_output_folder(tmp_path):
    tmp_path.chmod(0o555)
    with pytest.raises(OutputError) as error:
        prepare_output_folder(tmp_path)
    assert "Permission denied" in sentence(error)
    with pytest.raises(OutputError):
        prepare_output_folder(tmp_path / "out")


def test_read_only_output_folder_for_root_too(tmp_path, monkeypatch):
    def refuse(dir):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(dir))

    monkeypatch.setattr(atomic, "TemporaryFile", refuse)
    with pytest.raises(OutputError) as error:
        prepare_output_folder(tmp_path)
    assert "Permission denied" in sentence(error)


def test_output_folder_that_is_a_file(tmp_path):
    (tmp_path / "out").write_text("")
    with pytest.raises(OutputError) as error:
        prepare_output_folder(tmp_path / "out")
    assert "is a file" in sentence(error)
