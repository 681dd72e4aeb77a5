"""Commands one after the other, interrupted, failed or killed: no result is lost unasked."""

import json
import random
from contextlib import nullcontext, suppress
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from disk_faults import contents, full_disk
from geogs.application import driver
from geogs.application.driver import Driver, Outcome, Work
from geogs.application.interrupt import Stop
from geogs.application.progress.run_progress import RunProgress
from geogs.application.results.output_folder import chosen_folder, claimed, is_complete
from geogs.application.results.result import Result
from geogs.application.results.write import write_results
from geogs.application.run_settings import RunSettings
from geogs.errors import GeogsError, OutputError, TrackingLost
from geogs.io.sources.frame_source import Source
from geogs.stopwatch import Stopwatch

ENDS = (
    Outcome.FINISHED, Outcome.FINISHED, Outcome.STOPPED, Outcome.MEMORY_FULL,
    TrackingLost("nothing was tracked"), KeyboardInterrupt(), "full disk", "no mesh",
)  # fmt: skip


class Ending(Work):
    """Work that ends in some way, at once."""

    source = Source.__new__(Source)  # nothing is read from it

    def __init__(self, number: int, source: str, end: object) -> None:
        summary = {"source": source, "number": number}
        mesh = None if end == "no mesh" else "a mesh"
        self.scene = SimpleNamespace(frames=9, stopwatch=Stopwatch(), summary=summary, mesh=mesh)
        self._end = end

    def complete(self, driver: Driver, checkpoint: object, new: Path) -> Outcome:
        if isinstance(self._end, BaseException):
            raise self._end
        return self._end if isinstance(self._end, Outcome) else Outcome.FINISHED


def run(number: int, source: str, given: str, overwrite: bool, end: object) -> None:
    """A run as the command does it."""
    settings = RunSettings(checkpoint_every=0.0, depth_mesh=False)
    disk = full_disk(Path.cwd(), 5) if end == "full disk" else nullcontext()
    with suppress(GeogsError, KeyboardInterrupt):
        place = Path(given) if given else None
        folder = chosen_folder(place, source, overwrite, fingerprint=lambda: source)
        with claimed(folder) as output, disk:
            made = Driver(settings, output, torch.device("cpu"), RunProgress(), Stop())
            made.complete(Ending(number, source, end))


def numbers() -> dict[int, bool]:
    """Which results are there, and whether they are complete."""
    paths = Path().glob("**/summary.json")
    return {json.loads(p.read_text())["number"]: is_complete(p.parent) for p in paths}


@pytest.mark.parametrize("seed", range(40))
def test_a_complete_result_goes_only_where_that_was_asked_for(tmp_path, monkeypatch, seed):
    def write(new: Path, result: object, *_: object) -> None:
        known = {
            "interrupted": result.is_interrupted,
            "fingerprint": result.scene.summary["source"],
        }
        summary = result.scene.summary | known
        (new / "trajectory.tum").write_text("0 0 0 0 0 0 0 1\n")
        if result.scene.mesh is not None:
            (new / "mesh.ply").write_bytes(bytes(4000))
        (new / "summary.json").write_text(json.dumps(summary))

    monkeypatch.setattr(driver, "write_files", write)
    monkeypatch.chdir(tmp_path)
    rng = random.Random(seed)
    sources: dict[int, str] = {}
    for number in range(8):
        before = numbers()
        source, given = rng.choice(["a", "b"]), rng.choice(["", "", "kept", "out/a"])
        overwrite, end = rng.random() < 0.3, rng.choice(ENDS)
        sources[number] = source
        run(number, source, given, overwrite, end)
        after = numbers()
        lost = {known for known in before if known not in after}
        may_replace = overwrite or given
        assert len(lost) <= bool(may_replace), (number, source, given)
        if not overwrite:
            assert all(sources[known] == source for known in lost), (number, source, given)
        if any(before[known] for known in lost):
            assert after.get(number) is True, (number, end)
        if end is Outcome.FINISHED and (overwrite or not given):
            assert after[number]
        assert not list(tmp_path.glob("**/.geogs.*.new"))


class Named(Source):
    """A source that is known by its name."""

    def __init__(self, name: str) -> None:
        self._named = name

    def fingerprint(self) -> str:
        return self._named


def test_a_result_written_by_a_program_goes_only_where_that_was_asked_for(tmp_path, monkeypatch):
    def write(new: Path, result: Result, **_: object) -> None:
        known = {"interrupted": result.is_interrupted, "fingerprint": result.source.fingerprint()}
        (new / "summary.json").write_text(json.dumps(known))
        if result.scene.mesh:
            (new / "mesh.ply").write_bytes(bytes(40))

    monkeypatch.setattr("geogs.application.results.write.write_files", write)

    def put(source: str, interrupted: bool = False, mesh: bool = True, **given: bool) -> None:
        result = Result(SimpleNamespace(mesh=mesh), Named(source), interrupted)
        write_results(tmp_path / "kept", result, **given)

    put("a", interrupted=True)
    put("a")
    before = contents(tmp_path)
    for overwrite in (False, True):
        for bad in ({"interrupted": True}, {"mesh": False}):
            with pytest.raises(OutputError, match="this one is incomplete; give another folder"):
                put("a", **bad, overwrite=overwrite)
            assert contents(tmp_path) == before
    with pytest.raises(OutputError, match="--overwrite to replace it"):
        put("b")
    assert contents(tmp_path) == before
    put("a")
    put("b", overwrite=True)
    assert '"fingerprint": "b"' in (tmp_path / "kept" / "summary.json").read_text()
