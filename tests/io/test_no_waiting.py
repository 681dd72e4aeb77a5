"""Pipes and devices in place of files: refused at once, whatever reads them."""

import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from geogs.errors import InputError
from geogs.guard.documents import open_file, require_file
from geogs.io.sources.sniff import open_posed_source, open_source
from geogs.io.writers.map_file import load_map
from geogs.networks.tensor_files import load_trained, read_tensors
from geogs.networks.weights_files import checksum

SOURCES = ("v.mp4", "v.bag", "v.db3", "v.mcap", "v.r3d", "v.mkv", "v.m3u8", "v.png", "v")
WEIGHTS = ("w.pth", "w.safetensors", "w.onnx", "w")
PLAY_LISTS = {
    "hls": "#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\n{0}\n#EXT-X-ENDLIST\n",
    "concat": "ffconcat version 1.0\nfile {0}\n",
    "dash": (
        '<MPD xmlns="urn:mpeg:dash:schema:mpd:2011" type="static" minBufferTime="PT1S" '
        'mediaPresentationDuration="PT1S"><Period><AdaptationSet mimeType="video/mp4">'
        '<Representation id="0" bandwidth="1"><BaseURL>{0}</BaseURL></Representation>'
        "</AdaptationSet></Period></MPD>"
    ),
    "sdp": "v=0\no=- 0 0 IN IP4 127.0.0.1\nc=IN IP4 127.0.0.1\nm=video 5004 RTP/AVP 96\n",
}


@pytest.fixture(autouse=True)
def at_once() -> Iterator[None]:
    """Whoever waits for a pipe is interrupted."""

    def late(*_: object) -> None:
        raise AssertionError("it was waited for")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(20)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def pipe(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    os.mkfifo(path)
    return path


def refused(use: Callable[[], object]) -> str:
    with pytest.raises(InputError) as caught:
        use()
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("name", SOURCES)
def test_a_pipe_is_no_source(tmp_path, name):
    path = pipe(tmp_path / name)
    refused(lambda: open_source(path))
    refused(lambda: open_source(f"play:{path}"))


@pytest.mark.parametrize("device", ["/dev/zero", "/dev/tty", "/dev/stdin"])
def test_a_device_is_no_source(device):
    refused(lambda: open_source(device))


@pytest.mark.parametrize("name", [*PLAY_LISTS, "m3u8"])
@pytest.mark.parametrize("ending", [".mp4", ".m3u8", ".mpd", ".txt", ".sdp"])
def test_what_a_play_list_names_is_not_opened(tmp_path, name, ending):
    inner = pipe(tmp_path / "inner.ts")
    path = tmp_path / f"list{ending}"
    path.write_text(PLAY_LISTS.get(name, PLAY_LISTS["hls"]).format(inner.name))
    refused(lambda: open_source(path))


@pytest.mark.parametrize("name", ["inner.db3", "/dev/zero", "../inner.db3"])
def test_what_a_bag_names_is_looked_at_first(tmp_path, name):
    bag = tmp_path / "bag"
    pipe(bag / "inner.db3")
    pipe(tmp_path / "inner.db3")
    text = f"rosbag2_bagfile_information:\n  version: 5\n  relative_file_paths: [{name}]\n"
    (bag / "metadata.yaml").write_text(text)
    said = refused(lambda: open_source(bag))
    assert "no plain file" in said or "files of other folders" in said


@pytest.mark.parametrize("name", ["000.png", "000.jpg"])
def test_a_pipe_among_images_is_no_image(tmp_path, name):
    pipe(tmp_path / name)
    refused(lambda: open_source(tmp_path))


@pytest.mark.parametrize("name", ["cameras.npz", "transforms.json"])
def test_a_pipe_holds_no_poses(tmp_path, name):
    pipe(tmp_path / name)
    (tmp_path / "image").mkdir()
    refused(lambda: open_posed_source(tmp_path))
    refused(lambda: open_posed_source(tmp_path / name))


@pytest.mark.parametrize("name", WEIGHTS)
def test_a_pipe_holds_no_weights(tmp_path, name):
    path = pipe(tmp_path / name)
    for use in (checksum, read_tensors, load_map, lambda p: load_trained(p, "flow", dict)):
        refused(lambda use=use: use(path))


def test_one_function_opens_files(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(b"abc")
    with open_file(path) as file:
        assert file.read() == b"abc"
    assert require_file(path) == path
    assert "does not exist" in refused(lambda: require_file(tmp_path / "b"))
    assert "is a folder" in refused(lambda: require_file(tmp_path))
    assert "zero byte" in refused(lambda: require_file("a\0b"))
    assert "no plain file" in refused(lambda: require_file("/dev/null"))
