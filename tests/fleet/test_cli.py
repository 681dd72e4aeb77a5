"""The command: options and their defaults."""

from contextlib import nullcontext

import pytest

from geogs.config import preset
from geogs_fleet import fleet_run
from geogs_fleet.cli import main
from geogs_fleet.cluster import Allocation
from geogs_fleet.table import Row


@pytest.mark.parametrize("gpus", [0.0, 0.5])
@pytest.mark.parametrize("name", ["default", "fast"])
def test_default_sizes_are_those_of_the_device_that_computes(tmp_path, monkeypatch, gpus, name):
    (tmp_path / "clip.mp4").touch()
    computed = []

    def rows_of(ray, jobs, allocation, attempts):
        for job in jobs:
            computed.append(job.settings)
            yield Row(job.source.name, job.source.address, "done", "Good.", job.digest)

    monkeypatch.setattr(fleet_run, "ray_cluster", lambda address: nullcontext())
    monkeypatch.setattr(fleet_run, "allocation_for", lambda *_: Allocation(1, gpus))
    monkeypatch.setattr(fleet_run, "rows_of", rows_of)
    words = ["run", str(tmp_path / "clip.mp4"), "-o", str(tmp_path / "out"), "--preset", name, "-q"]
    assert main([*words, "--mesh.voxel", "0.05"]) == 0
    (settings,) = computed
    usual = preset(name, on_gpu=gpus > 0)
    assert settings.device == ("cuda" if gpus else "cpu")
    assert settings.config.input.long_edge == usual.input.long_edge
    assert settings.config.mapping == usual.mapping
    assert settings.config.mesh.voxel == 0.05
