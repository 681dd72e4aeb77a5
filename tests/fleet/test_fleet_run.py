"""Whole fleets on Ray, with a program in place of a run that ends at once, or as it is told to."""

import json
import sys
import threading
import time
from pathlib import Path

import pytest

from cluster_nodes import add_node, simulated_cluster
from geogs.errors import InputError
from geogs_fleet.fleet_options import FleetOptions
from geogs_fleet.fleet_progress import FleetProgress
from geogs_fleet.fleet_run import run_fleet

ray = pytest.importorskip("ray", reason="Ray is not installed: pip install 'geogs[fleet]'")
pytestmark = [
    pytest.mark.system,
    pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::FutureWarning"),
]
FAKE = (sys.executable, str(Path(__file__).with_name("fake_child.py")))


@pytest.fixture(scope="module")
def cluster():
    """A head with two cores; tests add nodes."""
    with simulated_cluster() as made:
        yield made


def sources(folder: Path, **texts: str) -> Path:
    folder.mkdir()
    for name, text in texts.items():
        (folder / f"{name}.mp4").write_text(text)
    return folder


def fleet(source: Path, output: Path, **more):
    progress = more.pop("progress", None)
    settings = FleetOptions((str(source),), output=str(output), gpus=0.0, **more)
    return run_fleet(settings, progress, FAKE)


def starts(output: Path, name: str) -> int:
    return len((output / name / "starts").read_text().splitlines())


def test_one_that_fails_is_a_row_and_the_second_call_does_what_is_missing(cluster, tmp_path):
    given = sources(tmp_path / "clips", a="ok", b="fail It is empty.", c="ok", d="doubt")
    out = tmp_path / "out"
    result = fleet(given, out)
    assert [row.state for row in result.rows] == ["done", "failed", "done", "done"]
    assert result.rows[1].sentence == "It is empty."
    assert result.rows[0].numbers == {"frames": 12, "keyframes": 3, "lost": 0.25}
    document = json.loads((out / "fleet.json").read_text())
    assert [row["name"] for row in document["sources"]] == ["b", "d", "a", "c"]  # trouble first
    assert (document["done"], document["failed"], document["waiting"]) == (3, 1, 0)
    assert "It is empty." in (out / "index.html").read_text()

    (given / "b.mp4").write_text("ok")
    assert fleet(given, out).computed == 1
    again = fleet(given, out)
    assert again.computed == 0
    assert [starts(out, name) for name in "abcd"] == [1, 2, 1, 1]
    assert [row.state for row in again.rows] == ["done"] * 4
    assert fleet(given, out, keyframe_images=False).computed == 4  # other settings, other results


def test_a_process_that_is_killed_is_tried_again_as_often_as_allowed(cluster, tmp_path):
    given = sources(tmp_path / "clips", once="kill once", always="kill", good="ok")
    result = fleet(given, tmp_path / "out", attempts=2)
    by_name = {row.name: row for row in result.rows}
    assert (by_name["once"].state, by_name["once"].attempts) == ("done", 2)
    assert (by_name["always"].state, by_name["always"].attempts) == ("failed", 2)
    assert "SIGKILL" in by_name["always"].sentence
    assert by_name["good"].attempts == 1


def test_limits_end_what_takes_too_long_or_too_much(cluster, tmp_path):
    given = sources(tmp_path / "clips", long="wait 600", large="eat 400", good="ok")
    result = fleet(given, tmp_path / "out", time_limit=10.0, memory_limit=0.2)
    by_name = {row.name: row for row in result.rows}
    assert "longer than 10 s" in by_name["long"].sentence
    assert "more than 0.2 GiB" in by_name["large"].sentence
    assert [by_name[n].state for n in ("long", "large", "good")] == ["failed", "failed", "done"]


def test_what_a_lost_node_computed_is_gone_on_with_elsewhere(cluster, tmp_path):
    node = add_node(cluster)
    given = sources(tmp_path / "clips", **{f"s{i}": "steps 30" for i in range(4)})
    out = tmp_path / "out"

    def remove_when_under_way() -> None:
        while not all((out / f"s{i}" / "steps").is_file() for i in range(4)):
            time.sleep(0.05)
        cluster.remove_node(node, allow_graceful=False)

    remover = threading.Thread(target=remove_when_under_way, daemon=True)
    remover.start()
    result = fleet(given, out)
    remover.join(600)
    assert [row.state for row in result.rows] == ["done"] * 4
    assert 2 in {row.attempts for row in result.rows}
    for i in range(4):  # no step is lost, and none is done twice
        assert (out / f"s{i}" / "steps").read_text().split() == list(map(str, range(30)))


def test_many_small_ones_cost_little_each(cluster, tmp_path):
    given = sources(tmp_path / "clips", **{f"s{i}": "ok" for i in range(10)})
    heard = []

    class Listener(FleetProgress):
        def ended(self, row, left, seconds_left):
            heard.append((left, seconds_left))

    result = fleet(given, tmp_path / "out", progress=Listener())
    assert all(row.state == "done" for row in result.rows)
    assert [left for left, _ in heard] == list(range(9, -1, -1))
    assert heard[-1][1] == 0


def test_more_than_any_machine_has_is_refused(cluster, tmp_path):
    given = sources(tmp_path / "clips", a="ok")
    with pytest.raises(InputError, match="has 200 cores, 0 GPUs for a source"):
        fleet(given, tmp_path / "out", cpus=200)
