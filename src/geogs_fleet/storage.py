"""Files and folders by their address: a path of this machine, or any address of fsspec."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath
from typing import Any

from geogs.errors import GeogsError, InputError, OutputError
from geogs.extras import install_command
from geogs.guard.atomic import write_text
from geogs.guard.documents import expanded, read_text

PATIENCE = 60.0
"""Seconds that a server may be silent; the whole transfer may take longer."""


class StoragePath:
    """A file or a folder, here or elsewhere."""

    def __init__(self, address: str) -> None:
        self.address = address

    def __truediv__(self, name: str) -> "StoragePath":
        return StoragePath(f"{self.address.rstrip('/')}/{name}")

    @property
    def path(self) -> Path | None:
        """Its path on this machine; none if it is elsewhere."""
        address = self.address.removeprefix("file://")
        return None if "://" in address else expanded(address)

    def absolute(self) -> "StoragePath":
        """The same address as an absolute path, if it is on this machine."""
        return self if self.path is None else StoragePath(str(self.path.absolute()))

    @property
    def name(self) -> str:
        """The last part of the address."""
        return PurePosixPath(self.address.split("?")[0]).name

    def read(self) -> str | None:
        """The text of a file in UTF-8; none if there is no such file.

        Raises:
            InputError: it cannot be read.
        """
        with self._failing(InputError, "read"), suppress(FileNotFoundError, NotADirectoryError):
            if self.path is not None:
                return read_text(self.path) if self.path.is_file() else None
            with self._reached() as (system, path):
                return str(system.cat_file(path).decode("utf-8-sig"))
        return None

    def write(self, text: str) -> None:
        """Write a text file in UTF-8, completely or not at all.

        Raises:
            OutputError: it cannot be written.
        """
        if self.path is not None:
            write_text(self.path, text)
            return
        with self._failing(OutputError, "written"), self._reached() as (system, path):
            system.pipe_file(path, text.encode("utf-8", "backslashreplace"))

    def delete(self) -> None:
        """Remove a file, if it is there. Raises OutputError if it cannot be removed."""
        with self._failing(OutputError, "deleted"), suppress(FileNotFoundError):
            if self.path is not None:
                self.path.unlink(missing_ok=True)
                return
            with self._reached() as (system, path):
                system.rm_file(path)

    def listed(self) -> dict[str, bool]:
        """Names in a folder, and whether each is a folder; empty if this is no folder.

        Raises:
            InputError: it cannot be read.
        """
        with self._failing(InputError, "read"), suppress(FileNotFoundError, NotADirectoryError):
            if self.path is not None:
                return {p.name: p.is_dir() for p in self.path.iterdir()}
            with self._reached() as (system, path):
                found = system.ls(path, detail=True)
            return {
                PurePosixPath(entry["name"]).name: entry["type"] == "directory"
                for entry in found
                if entry["name"].strip("/") != path.strip("/")
            }
        return {}

    def matching(self) -> list[str]:
        """Sorted addresses that match a pattern; the address is the pattern."""
        import glob

        if self.path is not None:
            return sorted(glob.glob(str(self.path), recursive=True))
        with self._reached() as (system, path):
            return sorted(system.unstrip_protocol(found) for found in system.glob(path))

    def download(self, target: Path) -> None:
        """Copy the file, or the folder's content, to a path of this machine.

        Raises:
            InputError: it does not exist, or cannot be read.
        """
        with self._failing(InputError, "read"), self._reached() as (system, path):
            if system.isfile(path):
                target.parent.mkdir(parents=True, exist_ok=True)
                system.get_file(path, str(target))
                return
            files = system.find(path)
            if not files:
                raise InputError(f"{self.address} does not exist; give a source that does.")
            for file in files:
                relative = PurePosixPath(file).relative_to(path.rstrip("/"))
                if ".." in relative.parts:
                    raise InputError(f"{self.address} names files outside of itself.")
                inner = target / relative
                inner.parent.mkdir(parents=True, exist_ok=True)
                system.get_file(file, str(inner))

    def upload(self, file: Path) -> None:
        """Copy a file of this machine here. Raises OutputError if it cannot be written."""
        with self._failing(OutputError, "written"), self._reached() as (system, path):
            system.makedirs(str(PurePosixPath(path).parent), exist_ok=True)
            system.put_file(str(file), path)

    @contextmanager
    def _failing(self, kind: type[GeogsError], done: str) -> Iterator[None]:
        """Turn a failure inside into the error that this cannot be read, written or deleted."""
        try:
            yield
        except (OSError, UnicodeDecodeError) as error:
            raise kind(f"{self.address} cannot be {done} ({_reason(error)}).") from error

    @contextmanager
    def _reached(self) -> Iterator[tuple[Any, str]]:
        """The file system and the path in it. Raises InputError if there is none of that kind.

        Errors of the file system's own types become an OSError.
        """
        try:
            from fsspec.core import url_to_fs
        except ImportError:
            command = install_command("fleet")
            raise InputError(f"{self.address} needs fsspec: {command}") from None
        try:
            reached = url_to_fs(self.address, **_limits(self.address))
        except (ImportError, ValueError) as error:
            raise InputError(f"{self.address} cannot be reached ({_reason(error)}).") from error
        try:
            yield reached
        except (GeogsError, OSError):
            raise
        except Exception as error:
            raise OSError(_reason(error)) from error


def _limits(address: str) -> dict[str, Any]:
    """Options with which a file system waits at most ``PATIENCE`` for a silent server."""
    protocol = address.partition("://")[0]
    if protocol in ("http", "https"):
        from aiohttp import ClientTimeout

        timeout = ClientTimeout(total=None, sock_connect=PATIENCE, sock_read=PATIENCE)
        return {"client_kwargs": {"timeout": timeout}}
    if protocol in ("s3", "s3a"):
        return {"config_kwargs": {"connect_timeout": PATIENCE, "read_timeout": PATIENCE}}
    return {"requests_timeout": PATIENCE} if protocol in ("gs", "gcs") else {}


def _reason(error: Exception) -> str:
    said = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return said.splitlines()[0].rstrip(".")
