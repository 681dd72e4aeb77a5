"""The depth network that comes with the package, on a scene of another making than its rooms."""

import hashlib

import pytest

from geogs.depth.network.model import load_depth_network
from geogs.networks.weights_files import PACKAGED, find_weights

WEIGHTS = PACKAGED / "depth.safetensors"


def test_the_checksum_is_that_of_the_file():
    lines = (PACKAGED / "SHA256SUMS").read_text().splitlines()
    assert f"{hashlib.sha256(WEIGHTS.read_bytes()).hexdigest()}  depth.safetensors" in lines
    assert WEIGHTS.stat().st_size < 12e6


def test_it_is_found_and_its_calibration_is_a_small_correction(monkeypatch, tmp_path):
    monkeypatch.delenv("GEOGS_WEIGHTS", raising=False)
    monkeypatch.setenv("GEOGS_CACHE", str(tmp_path))
    assert find_weights("depth") == WEIGHTS
    trained = load_depth_network(WEIGHTS)
    assert sum(p.numel() for p in trained.parameters()) < 6e6
    assert trained.calibration.scale == pytest.approx(1.0, abs=0.2)
    assert trained.calibration.gain == pytest.approx(1.0, abs=0.3)
