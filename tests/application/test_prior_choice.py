"""Priors as the command line opens them."""

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from geogs.application.prior_choice import open_prior
from geogs.config import PriorConfig
from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.priors.monocular_prior import CombinedPrior, DepthKind, PriorMaps

CAMERA = Camera(60.0, 61.0, 31.0, 23.5, 64, 48)
CPU = torch.device("cpu")


def test_a_run_without_its_card_ends_with_a_sentence(tmp_path: Path):
    for n in range(3):
        cv2.imwrite(str(tmp_path / f"{n}.png"), np.full((64, 96, 3), 40 * n, np.uint8))
    command = [sys.executable, "-m", "geogs.cli.main", "run", tmp_path, "--device", "cpu"]
    command += ["-o", tmp_path / "out", "--intrinsics", "80,80,47.5,31.5"]
    command += ["--prior.model", tmp_path / "depth.onnx"]
    done = subprocess.run([str(c) for c in command], capture_output=True, text=True, timeout=1800)
    assert done.returncode == 2
    assert "--prior.card must say what" in done.stderr
    assert "Traceback" not in done.stderr


def test_without_a_model_there_is_no_prior():
    assert open_prior(PriorConfig(), CAMERA, CPU) is None


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (PriorConfig(model="a.onnx"), "--prior.card must say.*metric3d-v2-small"),
        (PriorConfig(normal_model="a.onnx"), "--prior.normal-card must say"),
        (PriorConfig(model="a.onnx", card="none.yaml"), "There is no card none.yaml"),
        (PriorConfig(model="a.onnx", card="metric3d-v2-small"), "There is no file a.onnx"),
        (PriorConfig(model="a.ckpt", card="omnidata-depth"), "There is no file a.ckpt"),
    ],
)
def test_what_is_missing_is_told_in_a_sentence(
    config: PriorConfig, message: str, monkeypatch, tmp_path: Path
):
    pytest.importorskip("onnxruntime", reason="onnxruntime is not installed")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=message):
        open_prior(config, CAMERA, CPU)


class _Fixed:
    def __init__(self, maps: PriorMaps) -> None:
        self.maps = maps

    def predict(self, image: np.ndarray) -> PriorMaps:
        return self.maps


def test_depth_of_one_goes_with_normals_of_another():
    depth = PriorMaps(DepthKind.METRIC, torch.ones(48, 64), torch.zeros(48, 64, 3))
    normal = PriorMaps(normal=torch.ones(48, 64, 3))
    both = CombinedPrior(_Fixed(depth), _Fixed(normal)).predict(np.zeros((48, 64, 3), np.uint8))
    assert both.kind is DepthKind.METRIC
    assert both.depth is depth.depth
    assert both.normal is normal.normal
