"""Who may look on: those who know the address, from no other page; what strangers wrote is text."""

import json
import socket
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator
from types import ModuleType, SimpleNamespace

import pytest

from geogs.application.results.saved_result import load_result
from geogs.application.viewer.browser_window import GuardedServer, Window
from geogs.errors import InputError
from saved_results import make_result


@pytest.fixture
def window() -> Iterator[Window]:
    pytest.importorskip("viser", reason="viser is not installed")
    window = Window("<b>name</b>", "127.0.0.1", 8397)
    yield window
    window.stop()


def status(address: str, **headers: str) -> int:
    try:
        with urllib.request.urlopen(urllib.request.Request(address, headers=headers)) as answer:
            assert answer.headers["X-Frame-Options"] == "DENY"
            assert "viser" in answer.read().decode().lower()
            return answer.status
    except urllib.error.HTTPError as error:
        return error.code


def test_the_page_is_had_by_its_whole_address_alone(window):
    place, _, token = window.address.rstrip("/").rpartition("/")
    assert len(token) > 20
    assert status(window.address) == 200
    for other in (f"{place}/", f"{place}/{token[:-1]}/", f"{place}/x/{token}/", f"{place}//"):
        assert status(other) == 403
    assert status(window.address, Origin="http://evil.example") == 403


def first_line(port: int, request: bytes) -> bytes:
    """First line of the answer to a request; empty where the connection is closed instead."""
    with socket.create_connection(("127.0.0.1", port), timeout=60) as connection:
        connection.sendall(request)
        try:
            return connection.makefile("rb").readline().rstrip()
        except ConnectionError:
            return b""


def test_requests_that_cannot_be_understood_are_refused_without_a_traceback(window, caplog):
    port = window._server.get_port()
    token = window.address.rstrip("/").rpartition("/")[2].encode()
    own = b"GET /" + token
    hosts = b"Host: a\r\nHost: b\r\n"
    for start, headers in (
        (b"GET /\xff\xfe/", b""),
        (b"GET /\xc3\xa9/", b""),
        (b"GET /%ff%fe/", b""),
        (own + b"/\xff", b""),
        (own + b"/" + b"a" * 3000, b""),
        (own + b"/", hosts + b"Origin: http://a\r\n"),
        (b"GET /x/", b"Origin: http://[x\r\n"),
        (b"GET /x/", b"Origin: http://a\r\nOrigin: http://b\r\n"),
    ):
        request = start + b" HTTP/1.1\r\n" + headers + b"\r\n"
        assert first_line(port, request)[:12] in (b"", b"HTTP/1.1 400", b"HTTP/1.1 403")
    assert not [record for record in caplog.records if record.exc_info]
    assert status(window.address) == 200


@pytest.mark.parametrize("path", ["/\udcff\udcfe/", "/secret/\ud800", "", "/é/"])
def test_a_path_of_any_letters_is_no_error_of_the_server(monkeypatch, path):
    """Versions of websockets differ in the letters that they let through."""
    from geogs.application.viewer import browser_window

    kept = []
    server = SimpleNamespace(serve=lambda *_, process_request: kept.append(process_request))
    modules = {"websockets": ModuleType("websockets"), "websockets.asyncio": ModuleType("asyncio")}
    modules["websockets.asyncio"].server = server
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    guarded = object.__new__(browser_window.GuardedServer)
    guarded._token = "secret"
    with guarded._guarded():
        server.serve(process_request=lambda connection, request: request.path.encode())
    connection = SimpleNamespace(respond=lambda status, text: status)
    request = SimpleNamespace(path=path, headers={})
    assert kept[0](connection, request) in (400, 403)


def test_a_socket_of_another_origin_or_without_the_token_is_refused(window):
    import viser
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    place, _, token = window.address.rstrip("/").replace("http:", "ws:").rpartition("/")
    version = [f"viser-v{viser.__version__}"]
    own = place.replace("ws:", "http:")
    for origin in (own, None):
        with connect(f"{place}/{token}", origin=origin, subprotocols=version) as socket:
            assert len(socket.recv(timeout=60)) > 16
    for address, origin in (
        (f"{place}/{token}", "http://evil.example"),
        (f"{place}/{token}", "null"),
        (f"{place}/{token}", own.replace("8397", "8000")),
        (f"{place}/", own),
        (f"{place}/{token}x", own),
    ):
        with pytest.raises(InvalidStatus) as refused:
            connect(address, origin=origin, subprotocols=version)
        assert refused.value.response.status_code == 403


def test_a_viser_that_serves_in_another_way_is_refused(monkeypatch):
    viser = pytest.importorskip("viser", reason="viser is not installed")
    stopped = []

    class Other:
        def __init__(self, **options: object) -> None:
            pass

        def stop(self) -> None:
            stopped.append(self)

    monkeypatch.setattr(viser, "ViserServer", Other)
    with pytest.raises(InputError, match="cannot be guarded"):
        GuardedServer("127.0.0.1", 8396, "title")
    assert stopped


def test_what_a_result_says_is_shown_as_text(tmp_path):
    pytest.importorskip("viser", reason="viser is not installed")
    from geogs.application.viewer.saved import open_window

    folder = make_result(tmp_path / "<img src=x onerror=alert(1)>")
    verdict = {"sentence": "<script>alert(1)</script> [a](http://b) {1 + 1}"}
    (folder / "summary.json").write_text(json.dumps({"verdict": verdict}))
    window = open_window(load_result(folder), "127.0.0.1", 8395)
    try:
        said = window._words.content
        assert "<script" not in said
        assert "<img" not in said
        assert "&lt;script&gt;alert(1)&lt;/script&gt; [a](http://b) {1 + 1}" in said
    finally:
        window.stop()
