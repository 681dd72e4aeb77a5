"""Streams of a server on this machine: their images, and no waiting where there is no answer."""

import functools
import socket
import threading
import time
from collections.abc import Iterator
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest

from geogs.errors import InputError
from geogs.io.sources.address import live_address
from geogs.io.sources.live import network_stream
from geogs.io.sources.live.network_stream import NetworkStream
from io_samples import gradient_image, write_video


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def served(tmp_path: Path) -> Iterator[tuple[Path, str]]:
    """A folder, and where it is served."""
    handler = functools.partial(Quiet, directory=str(tmp_path))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield tmp_path, f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def opened(address: str) -> NetworkStream:
    found = live_address(address)
    assert found is not None
    return NetworkStream(found)


def test_a_stream_gives_its_images_as_they_come(served):
    folder, place = served
    images = [gradient_image(i) for i in range(12)]
    write_video(folder / "v.mkv", images)
    stream = opened(f"{place}/v.mkv")
    assert (stream.info.width, stream.info.height, stream.info.kind) == (64, 48, "stream")
    frames = list(stream.frames())
    assert len(frames) == 12
    for image, frame in zip(images, frames, strict=True):
        assert np.abs(frame.image.astype(int) - image).mean() < 6
    times = [frame.timestamp for frame in frames]
    assert times == sorted(times)


def test_what_is_no_stream_is_a_sentence_without_its_password(served):
    folder, place = served
    (folder / "words.txt").write_text("no video")
    for name in ("words.txt", "nothing.mp4"):
        with pytest.raises(InputError, match=r"^stream-127.0.0.1-\d+ "):
            opened(f"{place.replace('//', '//user:secret@')}/{name}")


def test_a_play_list_of_the_network_leads_to_no_file_of_this_machine(served, tmp_path):
    folder, place = served
    secret = write_video(tmp_path / "secret.ts", [gradient_image(i) for i in range(12)])
    lines = [
        "#EXTM3U",
        "#EXT-X-TARGETDURATION:1",
        "#EXTINF:1,",
        f"file://{secret}",
        "#EXT-X-ENDLIST",
    ]
    (folder / "list.m3u8").write_text("\n".join(lines) + "\n")
    with pytest.raises(InputError):
        opened(f"{place}/list.m3u8")


def test_a_server_that_never_answers_is_not_waited_for(monkeypatch):
    monkeypatch.setattr(network_stream, "PATIENCE", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        begin = time.monotonic()
        with pytest.raises(InputError, match="is it reachable"):
            opened(f"http://127.0.0.1:{silent.getsockname()[1]}/v.mp4")
        assert time.monotonic() - begin < 5
