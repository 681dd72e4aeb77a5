"""Clusters that are started for one command."""

import subprocess
import sys

import pytest

from geogs_fleet.cluster import ray_cluster

ray = pytest.importorskip("ray", reason="Ray is not installed: pip install 'geogs[fleet]'")
OTHER = """
from geogs_fleet.cluster import ray_cluster
with ray_cluster("auto") as ray:
    print(ray.get_runtime_context().gcs_address)
"""


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
