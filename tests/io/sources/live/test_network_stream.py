"""Streams of a server on this machine: their images, and no waiting where there is no answer."""

import functools
import signal
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import av
import numpy as np
import pytest

from geogs.errors import InputError
from geogs.io.sources.address import live_address
from geogs.io.sources.live import network_stream
from geogs.io.sources.live.network_stream import NetworkStream
from io_samples import gradient_image, write_video


class Handler(SimpleHTTPRequestHandler):
    """Serves a folder, redirects ``/to/ADDRESS``, and notes what was asked for."""

    def log_message(self, *_: object) -> None:
        pass

    def do_GET(self) -> None:
        self.server.asked.append(self.path)
        if self.path.startswith("/to/"):
            self.send_response(302)
            self.send_header("Location", self.path.removeprefix("/to/"))
            self.end_headers()
            return
        super().do_GET()


@contextmanager
def serving(folder: Path) -> Iterator[ThreadingHTTPServer]:
    handler = functools.partial(Handler, directory=str(folder))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        server.asked = []
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server
        server.shutdown()


@pytest.fixture
def served(tmp_path: Path) -> Iterator[tuple[Path, str]]:
    """A folder, and where it is served."""
    with serving(tmp_path) as server:
        yield tmp_path, f"http://127.0.0.1:{server.server_port}"


@pytest.fixture
def elsewhere(tmp_path: Path) -> Iterator[tuple[str, list[str]]]:
    """The same folder on another host, and what is asked for there."""
    with serving(tmp_path) as server:
        yield f"http://localhost:{server.server_port}", server.asked


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


def test_no_connection_is_left_open_before_the_images_come(served):
    folder, place = served
    write_video(folder / "v.mkv", [gradient_image(i) for i in range(12)])
    is_open = []

    @contextmanager
    def noted(stream):
        with NetworkStream._open(stream) as container:
            is_open.append(stream)
            yield container
        is_open.remove(stream)

    class Noted(NetworkStream):
        _open = noted

    stream = Noted(live_address(f"{place}/v.mkv"))
    assert not is_open
    assert len(list(stream.frames())) == 12
    assert not is_open


def test_what_is_no_stream_is_a_sentence_without_its_password(served):
    folder, place = served
    (folder / "words.txt").write_text("no video")
    for name in ("words.txt", "nothing.mp4"):
        with pytest.raises(InputError, match=r"^stream-127.0.0.1-\d+ "):
            opened(f"{place.replace('//', '//user:secret@')}/{name}")


def play_list(*lines: str, segment: bool = True) -> str:
    kind = "#EXTINF:1," if segment else "#EXT-X-STREAM-INF:BANDWIDTH=1280000"
    each = [word for line in lines for word in (kind, line)]
    return "\n".join(["#EXTM3U", "#EXT-X-TARGETDURATION:1", *each, "#EXT-X-ENDLIST", ""])


def test_a_play_list_of_one_host_gives_its_images(served):
    folder, place = served
    for name in "ab":
        write_video(folder / f"{name}.ts", [gradient_image(i) for i in range(12)])
    (folder / "list.m3u8").write_text(play_list("a.ts", f"{place}/b.ts"))
    (folder / "all.m3u8").write_text(play_list("list.m3u8", segment=False))
    for name in ("list", "all"):
        assert len(list(opened(f"{place}/{name}.m3u8").frames())) >= 23


SDP = """v=0
o=- 0 0 IN IP4 127.0.0.1
s=x
c=IN IP4 127.0.0.1
t=0 0
m=video 45678 RTP/AVP 96
a=rtpmap:96 H264/90000
"""


@pytest.mark.parametrize(
    "address",
    [
        "/to/{other}/v.ts", "/to/{other}/own.m3u8", "/other.m3u8", "/other-list.m3u8",
        "/redirected.m3u8", "/file.m3u8", "/list.ts", "/words.sdp", "/list.mkv", "/none.m3u8",
    ],
)  # fmt: skip
def test_a_server_leads_to_no_other_host_and_to_no_file(served, elsewhere, address):
    folder, place = served
    other, asked = elsewhere
    video = write_video(folder / "v.ts", [gradient_image(i) for i in range(12)])
    (folder / "own.m3u8").write_text(play_list("v.ts"))
    (folder / "other.m3u8").write_text(play_list(f"{other}/v.ts"))
    (folder / "other-list.m3u8").write_text(play_list(f"{other}/own.m3u8", segment=False))
    (folder / "redirected.m3u8").write_text(play_list(f"/to/{other}/v.ts"))
    (folder / "file.m3u8").write_text(play_list(f"file://{video}"))
    for name in ("list.ts", "list.mkv"):
        (folder / name).write_text(play_list(f"{other}/v.ts"))
    (folder / "words.sdp").write_text(SDP)
    begin = time.monotonic()
    with pytest.raises(InputError) as refused:
        opened(place + address.format(other=other))
    assert time.monotonic() - begin < network_stream.PATIENCE
    assert not asked
    if not address.startswith(("/list.", "/words", "/none")):
        assert f"leads to {'file:' if 'file' in address else other}" in str(refused.value)


def test_a_server_that_never_answers_is_not_waited_for(monkeypatch):
    monkeypatch.setattr(network_stream, "PATIENCE", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        begin = time.monotonic()
        with pytest.raises(InputError, match="is it reachable"):
            opened(f"http://127.0.0.1:{silent.getsockname()[1]}/v.mp4")
        assert time.monotonic() - begin < 5


def test_an_ffmpeg_that_follows_redirections_is_not_given_any(served, elsewhere, monkeypatch):
    folder, place = served
    other, asked = elsewhere
    write_video(folder / "v.ts", [gradient_image(i) for i in range(12)])
    monkeypatch.setitem(network_stream._OPTIONS, "max_redirects", "8")
    monkeypatch.setitem(av.library_versions, "libavformat", (61, 7, 100))
    with pytest.raises(InputError, match=f"leads to {other}/v.ts"):
        opened(f"{place}/to/{other}/v.ts")
    assert not asked
    assert len(list(opened(f"{place}/v.ts").frames())) == 12


def test_a_signal_is_obeyed_while_a_server_is_waited_for(monkeypatch):
    monkeypatch.setattr(network_stream, "PATIENCE", 60.0)

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGALRM, stop)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        signal.setitimer(signal.ITIMER_REAL, 0.5)
        try:
            with pytest.raises(KeyboardInterrupt):
                opened(f"http://127.0.0.1:{silent.getsockname()[1]}/v.mp4")
        finally:
            signal.signal(signal.SIGALRM, before)


@pytest.mark.parametrize("address", ["http://[x/v.mp4", "http://[x/l.m3u8", "http://:x/l.m3u8"])
def test_an_address_that_is_none_is_a_sentence(address):
    with pytest.raises(InputError, match="cannot be opened"):
        opened(address)


@pytest.mark.parametrize("entry", ["http://[x/v.ts", "ftp://127.0.0.1/v.ts", "//x:y/v.ts", "\\"])
def test_an_address_in_a_play_list_that_is_none_ends_the_stream(served, entry):
    folder, place = served
    write_video(folder / "v.ts", [gradient_image(i) for i in range(12)])
    (folder / "l.m3u8").write_text(play_list("v.ts", "v.ts", entry))
    try:
        frames = list(opened(f"{place}/l.m3u8").frames())
    except InputError:
        frames = []
    assert len(frames) in (0, *range(20, 25))
