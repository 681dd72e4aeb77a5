"""SQLite files of bags: healthy ones are read by any name, and what others compute is not run."""

import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

import geogs
from geogs.config import InputConfig
from geogs.errors import InputError
from io_samples import gradient_image
from parsers.reading import in_time

pytest.importorskip("rosbags", reason="bags need rosbags (pip install 'geogs[ros]')")
from bag_samples import BagWriter
from geogs.io.sources.ros import database
from geogs.io.sources.ros.database import Database

NATIVE = InputConfig(long_edge=0)
ENDLESS = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n)"
HUGE = "printf('%.*c', 999999999, 'x')"
LYING = "PRAGMA writable_schema = ON; {} PRAGMA writable_schema = RESET;"


@pytest.fixture
def folder(tmp_path) -> Path:
    """A healthy bag of five images."""
    with BagWriter(tmp_path, "sqlite") as bag:
        bag.camera_info("/camera/camera_info", 0)
        for k in range(5):
            bag.image("/camera/image_raw", k, gradient_image(k))
    return bag.path


def changed(folder: Path, script: str) -> Path:
    """The file of a bag, after some SQL."""
    path = folder / "sqlite.db3"
    with closing(sqlite3.connect(path)) as file:
        file.executescript(script)
    return path


def times(path: Path) -> list[float]:
    frames = list(geogs.open_source(path, NATIVE))
    for k, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.image, gradient_image(k))
    return [round(frame.timestamp - 1000, 3) for frame in frames]


IN_ORDER = [0.0, 0.05, 0.1, 0.15, 0.2]


@pytest.mark.parametrize("name", ["take #1", "what?", "100%20", "%2e%2e", "a&mode=rw", "é:x", "~"])
def test_a_bag_is_read_whatever_its_name(folder, tmp_path, name):
    (tmp_path / name).mkdir()
    moved = Path(shutil.move(folder, tmp_path / name / name))
    assert times(moved) == IN_ORDER
    file = (moved / "sqlite.db3").rename(moved / f"{name}.db3")
    assert times(file) == IN_ORDER


@pytest.mark.parametrize(
    "script",
    [
        "DROP INDEX timestamp_idx",
        "DROP INDEX timestamp_idx; UPDATE messages SET id = 100 - id",
        "CREATE UNIQUE INDEX other ON messages (topic_id, timestamp)",
        "DROP TABLE message_definitions; ALTER TABLE topics DROP COLUMN type_description_hash",
        "DROP TABLE message_definitions; ALTER TABLE topics DROP COLUMN offered_qos_profiles;"
        "ALTER TABLE topics DROP COLUMN type_description_hash; DROP TABLE schema",
        "DELETE FROM topics WHERE name = '/camera/camera_info'",
    ],
)
def test_messages_of_any_version_come_in_order_of_time(folder, script):
    assert times(changed(folder, script)) == IN_ORDER


def replaced(table: str, view: str) -> str:
    """Replace a table by a view."""
    return f"DROP TABLE {table}; CREATE VIEW {table} AS {view};"


MESSAGES = "SELECT i AS id, 1 AS topic_id, i AS timestamp, 'x' AS data FROM n"


@pytest.mark.parametrize(
    "script",
    [
        replaced("messages", f"{ENDLESS} {MESSAGES}"),
        replaced("messages", f"SELECT 1 AS id, 1 AS topic_id, 1 AS timestamp, {HUGE} AS data"),
        replaced("topics", f"{ENDLESS} SELECT i AS id, 'x' AS name, 'x' AS type FROM n"),
        replaced("message_definitions", f"{ENDLESS} SELECT i AS id FROM n"),
        f"ALTER TABLE messages ADD COLUMN more AS ({HUGE})",
        f"ALTER TABLE messages RENAME data TO old; ALTER TABLE messages ADD data AS ({HUGE})",
        f"ALTER TABLE topics DROP COLUMN type_description_hash;"
        f"ALTER TABLE topics ADD COLUMN type_description_hash AS ({HUGE})",
        f"ALTER TABLE message_definitions ADD COLUMN more AS ({HUGE})",
        "CREATE VIRTUAL TABLE other USING fts5(words)",
        "CREATE TRIGGER other AFTER INSERT ON messages BEGIN DELETE FROM topics; END",
        # A view whose entry says that it is a table, and a table of another name for it
        replaced("messages", f"{ENDLESS} {MESSAGES}")
        + LYING.format("UPDATE sqlite_master SET type = 'table' WHERE name = 'messages';"),
        "CREATE TABLE other (x);"
        + replaced("messages", f"{ENDLESS} {MESSAGES}")
        + LYING.format(
            "UPDATE sqlite_master SET name = 'x' WHERE name = 'messages';"
            "UPDATE sqlite_master SET name = 'messages' WHERE name = 'other';"
        ),
    ],
)
def test_what_a_file_would_compute_is_not_run(folder, script):
    path = changed(folder, script)
    for bag in (path, folder):
        with in_time(), pytest.raises(InputError, match="cannot be opened as a recording of ROS"):
            geogs.open_source(bag, NATIVE)


@pytest.mark.parametrize("name", ["%2e%2e%2fother.db3", "../other.db3", "/etc/passwd", "a/b.db3"])
def test_metadata_lead_to_no_file_outside_of_the_folder(folder, tmp_path, name):
    shutil.copy(folder / "sqlite.db3", tmp_path / "other.db3")
    metadata = folder / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("- sqlite.db3", f'- "{name}"'))
    with pytest.raises(InputError, match=r"does not exist|files of other folders"):
        geogs.open_source(folder, NATIVE)


def test_a_query_ends_after_many_steps_or_a_signal(folder, monkeypatch):
    monkeypatch.setattr(database, "_STEPS", 1)
    path = folder / "sqlite.db3"

    class Stopped(Database):
        def _is_too_long(self) -> bool:
            raise KeyboardInterrupt  # as a handler of a signal does while SQLite runs

    with pytest.raises(KeyboardInterrupt):
        Stopped(path).open()

    class Short(Database):
        def _is_too_long(self) -> bool:
            self._left = min(self._left, 20)
            return super()._is_too_long()

    with pytest.raises(sqlite3.OperationalError, match="interrupted"):
        Short(path).open()


def test_messages_are_those_of_their_topics_between_two_times(folder):
    file = Database(folder / "sqlite.db3")
    file.open()
    images = [c for c in file.connections if c.topic == "/camera/image_raw"]
    stamps = [time for _, time, _ in file.messages(images)]
    assert stamps == sorted(stamps)
    assert [c.msgcount for c in images] == [len(stamps)] == [5]
    assert (file.metadata.start_time, file.metadata.end_time) == (stamps[0], stamps[-1] + 1)
    assert [time for _, time, _ in file.messages(images, stamps[1], stamps[3])] == stamps[1:3]
    file.close()
