"""Requests of HTTP that a server leads to no other host."""

from collections.abc import Callable
from http.client import HTTPException, HTTPResponse
from typing import NoReturn
from urllib.error import HTTPError
from urllib.parse import urlsplit
from urllib.request import HTTPRedirectHandler, build_opener

from geogs.errors import InputError
from geogs.guard.documents import in_short


class SameHost:
    """Opens addresses on the host of a stream, as PyAV asks for what a play list names."""

    def __init__(self, target: str, name: str, patience: float) -> None:
        """``target`` is the address that the user named, ``name`` stands for it in messages, and
        ``patience`` is the wait for an answer in seconds."""
        self._target = target
        self._name = name
        self._patience = patience
        self._opener = build_opener(_Redirections(self._refuse))

    def __call__(self, url: str, flags: int = 0, options: object = None) -> HTTPResponse:
        """Open an address for reading.

        Raises:
            InputError: it is one of another host, or the answer is a redirection.
            OSError, ValueError, HTTPException: it cannot be opened.
        """
        place = urlsplit(url)
        is_own = place.hostname == urlsplit(self._target).hostname
        if place.scheme not in ("http", "https") or not is_own:
            self._refuse(url)
        try:
            answer: HTTPResponse = self._opener.open(url, timeout=self._patience)
        except HTTPError as error:
            error.close()
            raise
        return answer

    def refuse_redirection(self) -> None:
        """Raise InputError with the address where the target is redirected to, if it is."""
        try:
            self(self._target).close()
        except (OSError, ValueError, HTTPException):
            return

    def _refuse(self, url: str) -> NoReturn:
        raise InputError(
            f"{self._name} leads to {in_short(url)}; give that address if you trust it."
        )


class _Redirections(HTTPRedirectHandler):
    def __init__(self, refuse: Callable[[str], NoReturn]) -> None:
        self._refuse = refuse

    def redirect_request(self, req, fp, code, msg, headers, newurl):  # type: ignore[no-untyped-def]
        fp.close()
        self._refuse(newurl)
