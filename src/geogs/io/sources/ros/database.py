"""SQLite files of ROS 2 bags, of which only plain tables are read, in a bounded number of steps.

SQLite evaluates the views, virtual tables and generated columns that a file defines, and these
may take any time and memory. ``rosbags`` reads them, and opens a name that is not quoted as a URI.
"""

import re
import sqlite3
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
)
from rosbags.rosbag2.metadata import ReaderMetadata, parse_qos
from rosbags.rosbag2.reader import DirectoryReader, Reader

_PLAIN = re.compile(r"CREATE (TABLE|(UNIQUE )?INDEX) ")
"""Beginning of the definitions that SQLite stores of tables and indices."""
_STEPS = 100_000
"""Instructions of SQLite's virtual machine between two looks at their number."""
_FORMATS = {"ros2msg": MessageDefinitionFormat.MSG, "ros2idl": MessageDefinitionFormat.IDL}


class Database:
    """Storage reader for ``rosbags``: the topics of a file, and their messages in order of time."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.connections: list[Connection] = []
        """The topics."""
        self.metadata = ReaderMetadata(0, 2**63 - 1, 0, 0, None, None, None, None)

    def open(self) -> None:
        """Open the file and read its topics.

        Raises:
            ValueError: it defines more than tables and indices.
            sqlite3.Error: it is damaged, or reading takes far more steps than its size explains.
        """
        size = self.path.stat().st_size
        # A scan takes about one instruction for each byte of the smallest rows, a sort ten.
        self._most = 100 + size * 20 // _STEPS
        uri = f"{self.path.absolute().as_uri()}?mode=ro&immutable=1"
        self._file = sqlite3.connect(uri, uri=True, check_same_thread=False)
        self._file.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, min(size, 1 << 30))
        self._file.set_progress_handler(self._is_too_long, _STEPS)
        try:
            self._read_topics()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def messages(
        self, connections: Collection[Connection], start: int | None = None, stop: int | None = None
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Messages of some topics with their times, from ``start`` to before ``stop`` (ns)."""
        topics = {connection.id: connection for connection in connections}
        span = (-(2**63) if start is None else start, 2**63 - 1 if stop is None else stop - 1)
        # Sorted are numbers alone: no message gets into the temporary files of a sort.
        rows = self._rows(
            "SELECT rowid, topic_id, timestamp FROM messages WHERE timestamp BETWEEN ? AND ? "
            f"AND topic_id IN ({','.join('?' * len(topics))}) ORDER BY timestamp",
            *span,
            *topics,
        )
        for row, topic, time in rows:
            for (data,) in self._rows("SELECT data FROM messages WHERE rowid = ?", row):
                yield topics[topic], time, data

    def _read_topics(self) -> None:
        defined = self._rows("SELECT sql FROM sqlite_master WHERE sql IS NOT NULL")
        if not all(_PLAIN.match(sql) for (sql,) in defined):
            raise ValueError("the file defines more than tables and indices")
        self._columns("messages")
        counts = {
            id: span
            for id, *span in self._rows(
                "SELECT topic_id, count(*), min(timestamp), max(timestamp) "
                "FROM messages NOT INDEXED GROUP BY topic_id"
            )
        }
        definitions = self._definitions()
        known = self._columns("topics")
        optional = ("offered_qos_profiles", "type_description_hash")
        more = ", ".join(name if name in known else "''" for name in optional)
        topics = self._rows(f"SELECT id, name, type, serialization_format, {more} FROM topics")
        for id, name, kind, form, qos, digest in sorted(topics):
            extension = ConnectionExtRosbag2(form, parse_qos(qos))
            definition = definitions.get(kind, MessageDefinition(MessageDefinitionFormat.NONE, ""))
            count = counts.get(id, (0,))[0]
            self.connections.append(
                Connection(id, name, kind, definition, digest, count, extension, self)
            )
        if counts:
            numbers, first, last = zip(*counts.values(), strict=True)
            start = min(first)
            end = max(last) + 1
            self.metadata = ReaderMetadata(
                end - start, start, end, sum(numbers), None, None, None, None
            )

    def _definitions(self) -> dict[str, MessageDefinition]:
        """Definitions of types by name; none in bags from before ROS 2 Iron."""
        if not self._columns("message_definitions"):
            return {}
        rows = self._rows(
            "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        )
        return {kind: MessageDefinition(_FORMATS[form], text) for kind, form, text in rows}

    def _columns(self, table: str) -> set[str]:
        """Names of a table's columns; empty where there is none. Raises ValueError for others."""
        columns = list(self._rows(f"PRAGMA table_xinfo({table})"))
        if any(hidden for *_, hidden in columns):
            raise ValueError(f"the table {table} has columns that are generated")
        return {name for _, name, *_ in columns}

    def _rows(self, query: str, *values: Any) -> Iterator[Any]:
        """Rows of a query.

        Raises:
            KeyboardInterrupt: a signal came during the query, whose errors SQLite swallows.
            sqlite3.Error: the file is damaged, or the next row takes too many steps.
        """
        self._left = self._most
        try:
            yield from iter(self._file.execute(query, values).fetchone, None)
        except sqlite3.OperationalError as error:
            if error.sqlite_errorcode == sqlite3.SQLITE_INTERRUPT and self._left >= 0:
                raise KeyboardInterrupt from None
            raise

    def _is_too_long(self) -> bool:
        self._left -= 1
        return self._left < 0


class _Folder(DirectoryReader):
    STORAGE_PLUGINS: Mapping[str, Any] = {**DirectoryReader.STORAGE_PLUGINS, "sqlite3": Database}


class Recording(Reader):
    """Reader of ``rosbags`` for ROS 2 that reads SQLite by :class:`Database`."""

    STORAGE_PLUGINS: Mapping[str, Any] = {
        **Reader.STORAGE_PLUGINS,
        "dir": _Folder,
        ".db3": Database,
    }
