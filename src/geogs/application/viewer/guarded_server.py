"""A viser server that answers only requests with a secret token in the address.

viser itself serves every client that reaches the port, and any page that is open in a browser can
connect to it, whatever its origin.
"""

import hmac
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from io import StringIO
from typing import Any
from unittest import mock
from urllib.parse import urlsplit

from geogs.errors import InputError


class GuardedServer:
    """A server at ``http://host:port/token/``; all other requests are refused."""

    def __init__(self, host: str, port: int, title: str) -> None:
        """Begin to serve.

        Raises:
            InputError: viser is not installed, or is one that cannot be guarded.
        """
        try:
            import viser
        except ImportError:
            raise InputError("The viewer needs viser: pip install 'geogs[viewer]'.") from None
        self._token = secrets.token_urlsafe(16)
        self._is_guarded = False
        with redirect_stdout(StringIO()), self._guarded():  # it prints a box with the address
            self.viser = viser.ViserServer(host=host, port=port, label=title, verbose=False)
        if not self._is_guarded:
            self.viser.stop()
            raise InputError(
                f"The viewer cannot be guarded with viser {viser.__version__}; take another "
                "version: pip install 'viser==1.1.*'."
            )
        self.address = f"http://{host}:{self.viser.get_port()}/{self._token}/"

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        """Guard servers of the library below viser in the block; viser has no option for it."""
        from websockets.asyncio import server

        serve = server.serve

        def guarded(*args: Any, process_request: Any = None, **more: Any) -> Any:
            self._is_guarded = process_request is not None

            def check(connection: Any, request: Any) -> Any:
                return self._checked(connection, request, process_request)

            return serve(*args, process_request=check, **more)

        with mock.patch.object(server, "serve", guarded):
            yield

    def _checked(self, connection: Any, request: Any, process_request: Any) -> Any:
        """Answer a request: by viser if the token and the origin are right, else by refusal."""
        path, question, query = request.path.partition("?")
        token, _, rest = path.removeprefix("/").partition("/")
        origin = request.headers.get("Origin")
        is_own = origin is None or urlsplit(origin).netloc == request.headers.get("Host")
        if not is_own or not hmac.compare_digest(token.encode(), self._token.encode()):
            return connection.respond(403, "The address stands on the terminal of geogs.\n")
        request.path = f"/{rest}{question}{query}"
        answer = process_request(connection, request)
        if answer is not None:
            answer.headers["X-Frame-Options"] = "DENY"
            answer.headers["Referrer-Policy"] = "no-referrer"
        return answer
