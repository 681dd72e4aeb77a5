"""Settings that silently do nothing say so, and no others."""

import pytest

from geogs.cli.reconstruct import parse as reconstruct_options
from geogs.cli.run import parse as run_options
from geogs.config import preset, reconstruct_preset
from geogs.config.idle import idle_settings


def said(command: str, *words: str) -> list[str]:
    parse = run_options if command == "run" else reconstruct_options
    return idle_settings(parse(["source", "--device", "cpu", *words]).config)


@pytest.mark.parametrize("name", ["fast", "default", "accurate", "paper"])
def test_presets_have_nothing_idle(name) -> None:
    assert idle_settings(preset(name)) == []
    assert idle_settings(reconstruct_preset(name)) == []


CASES = {
    "--tracking.weights x.pth": "tracking.weights does nothing",
    "--mapping.no-final-depth --mapping.final-iterations 0": "mapping.no-final-depth does nothing",
    "--mapping.pose-lr 1e-3 --mapping.pose-iterations 0": "mapping.pose-lr does nothing",
    "--mapping.pose-every 1 --mapping.pose-iterations 0": "mapping.pose-every does nothing",
    "--mapping.when after --mapping.final-iterations 0": "mapping.when after does nothing",
    "--loop.matches --loop.no-enabled": "loop.matches does nothing",
    "--mapping.depth.engine classical --mapping.depth.weights x": "the engine classical has none",
    "--mapping.loss.ablation.smoothness-rewards-edges": "rewards-edges does nothing",
    "--mapping.loss.occlusion-ratio 0.1 --mapping.loss.occlusion 1": "mapping.loss.occlusion does",
    "--mapping.loss.colour --mapping.loss.l1-weight 0": "mapping.loss.colour does nothing",
    "--mapping.loss.measured-factor 2": "mapping.loss.measured-factor does nothing",
    "--prior.card omnidata": "prior.card does nothing",
    "--prior.normal-card omnidata": "prior.normal-card does nothing",
}


@pytest.mark.parametrize("words", CASES)
def test_what_does_nothing_says_so(words: str) -> None:
    (sentence,) = said("run", *words.split())
    assert CASES[words] in sentence


def test_what_is_heeded_says_nothing() -> None:
    assert said("run", "--tracking.weights", "x.pth", "--tracking.operator", "droid") == []
    assert said("run", "--mapping.no-final-depth") == []
    assert said("run", "--mapping.final-iterations", "0") == []
    edges = ["--mapping.loss.ablation.smoothness-rewards-edges"]
    assert said("run", "--mapping.loss.smoothness-weight", "1", *edges) == []
    assert "rewards-edges" in said("reconstruct", *edges)[0]
