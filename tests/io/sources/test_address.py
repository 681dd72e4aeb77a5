"""What is no file."""

from pathlib import Path

import pytest

from geogs.io.sources.address import LiveAddress, live_address


@pytest.mark.parametrize(
    ("words", "kind", "target", "name"),
    [
        ("camera:0", "camera", "0", "camera-0"),
        ("-", "pipe", "", "pipe"),
        ("play:a/b.mp4", "play", "a/b.mp4", "b.mp4 (played)"),
        ("rtsp://u:p@h:554/x?t=p", "stream", "rtsp://u:p@h:554/x?t=p", "stream-h-554"),
        ("http://10.0.0.2/video", "stream", "http://10.0.0.2/video", "stream-10.0.0.2"),
    ],
)
def test_addresses(words, kind, target, name):
    address = live_address(words)
    assert address == LiveAddress(kind, target)
    assert address.name == name
    # As the path that a command line makes of it.
    assert live_address(Path(words)) == address


@pytest.mark.parametrize(
    "words", ["video.mp4", "camera", "camera:x", "out/camera:0", "c:/v.mp4", "./-"]
)
def test_paths_are_none(words):
    assert live_address(words) is None


@pytest.mark.parametrize("name", ["play:x.mp4", "camera:0"])
def test_a_file_of_such_a_name_is_a_file(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    assert live_address(Path(f"./{name}")) is not None
    (tmp_path / name).write_bytes(b"a video")
    assert live_address(Path(f"./{name}")) is None
