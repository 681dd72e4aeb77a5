"""The preset ``paper`` has the values that docs/paper.md tells, and the page tells all of them."""

import re
from pathlib import Path

import pytest

from geogs.config import preset, reconstruct_preset
from geogs.config.leaves import default_text, leaves
from geogs.config.setting import Settings
from geogs.mapping.training.map_trainer import HISTORY

PAGE = (Path(__file__).parents[2] / "docs" / "paper.md").read_text()


def rows_of(command: str) -> dict[str, tuple[str, str]]:
    """Default and paper's value of every setting in a command's table."""
    text = PAGE.split(f"### `geogs {command}`")[1].split("\n##")[0]
    cells = re.findall(r"^\| `([\w.-]+)` \| `([^`]+)` \| `([^`]+)` \|", text, re.MULTILINE)
    return {name: (usual, paper) for name, usual, paper in cells}


def values(settings: Settings) -> dict[str, str]:
    return {leaf.name: default_text(leaf) for leaf in leaves(settings)}


@pytest.mark.parametrize(
    ("command", "usual", "paper"),
    [
        ("run", preset("default"), preset("paper")),
        ("reconstruct", reconstruct_preset("accurate"), reconstruct_preset("paper")),
    ],
    ids=["run", "reconstruct"],
)
def test_the_page_tells_every_value_of_the_preset(
    command: str, usual: Settings, paper: Settings
) -> None:
    ours, theirs, told = values(usual), values(paper), rows_of(command)
    for name, (default, value) in told.items():
        assert (name, ours[name], theirs[name]) == (name, default, value)
    assert set(told) == {name for name in ours if ours[name] != theirs[name]}


def test_the_papers_printed_numbers() -> None:
    config = preset("paper")
    mapping, loss = config.mapping, config.mapping.loss
    assert (mapping.iterations, HISTORY, mapping.views_per_step) == (7, 2, 0)
    assert config.tracking.init_keyframes == 12
    assert mapping.disk.planarity_shrink == 0.1
    assert 2e-4 <= mapping.pose_lr <= 6e-4
    assert mapping.pose_iterations > 0
    assert mapping.pose_every == 1
    assert mapping.final_iterations == 0
    assert (mapping.depth.engine, mapping.ablation.map_update) == ("tracker", "coherent")
    weights = (
        loss.normal_consistency_weight, loss.smoothness_weight, loss.distortion_weight,
        loss.depth_weight, loss.normal_weight, loss.l1_weight, loss.ssim_weight, loss.ncc_weight,
    )  # fmt: skip
    assert min(weights) > 0
    assert loss.opacity_weight == loss.silhouette_weight == 0


def test_from_known_poses_there_is_no_front_end() -> None:
    mapping = reconstruct_preset("paper").mapping
    assert mapping.loss.depth_weight == mapping.loss.normal_weight == 0
    assert mapping.depth.engine == "classical"
