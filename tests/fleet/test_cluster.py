"""Clusters that are started for one command."""

import os
import subprocess
import sys

import pytest

from geogs.errors import InputError
from geogs_fleet.cluster import Allocation, as_task, in_version, ray_cluster

ray = pytest.importorskip("ray", reason="Ray is not installed: pip install 'geogs[fleet]'")
OTHER = """
from geogs_fleet.cluster import ray_cluster
with ray_cluster("auto") as ray:
    print(ray.get_runtime_context().gcs_address)
"""


STRANGER = """
import ray, sys
try:
    ray.init(address=sys.argv[1], logging_level="ERROR")
    print("in")
except Exception as error:
    print("out", type(error).__name__)
"""


def double(number: int) -> int:
    return 2 * number


@pytest.mark.system
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::FutureWarning")
def test_who_has_no_token_and_who_has_another_version_are_refused(tmp_path):
    if ray.is_initialized():
        ray.shutdown()
    with ray_cluster("local"):
        address = ray.get_runtime_context().gcs_address
        environment = {k: v for k, v in os.environ.items() if not k.startswith("RAY_")}
        for mode in ({}, {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": "a" * 64}):
            other = subprocess.run(
                [sys.executable, "-c", STRANGER, address], capture_output=True, text=True,
                env=environment | {"HOME": str(tmp_path)} | mode,
            )  # fmt: skip
            assert not other.stdout.startswith("in"), other.stdout
        task = as_task(ray, double, Allocation(1, 0.0))
        assert ray.get(task(21)) == 42
        other = ray.remote(in_version).remote("0.0.0", double, 21)
        with pytest.raises(ray.exceptions.RayTaskError) as caught:
            ray.get(other)
        assert isinstance(caught.value.cause, InputError)
        assert "install the same everywhere" in str(caught.value.cause)


def test_a_ray_that_asks_for_no_token_starts_no_cluster(monkeypatch):
    monkeypatch.setattr(ray, "__version__", "2.58.1")
    if ray.is_initialized():
        ray.shutdown()
    with pytest.raises(InputError, match="anybody on the network"), ray_cluster("local"):
        pass


@pytest.mark.system
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::FutureWarning")
def test_one_that_ends_with_its_command_is_nobody_elses():
    """Whoever had found it would lose all that is under way when the command ends."""
    if ray.is_initialized():  # of tests before, in the same process
        ray.shutdown()
    with ray_cluster("local"):
        own = ray.get_runtime_context().gcs_address
        other = subprocess.run([sys.executable, "-c", OTHER], capture_output=True, text=True)
        assert other.returncode == 0, other.stderr
        assert other.stdout.split()[-1] not in ("", own)
    assert not ray.is_initialized()
