"""Settings that silently do nothing say so, and no others."""

import pytest

from geogs.cli.reconstruct import parse as reconstruct_options
from geogs.cli.run import parse as run_options
from geogs.config import preset, reconstruct_preset
from geogs.config.idle import idle_settings


def said(command: str, *words: str, maps_at_end: bool = False) -> list[str]:
    parse = run_options if command == "run" else reconstruct_options
    return idle_settings(parse(["source", "--device", "cpu", *words]).config, maps_at_end)


@pytest.mark.parametrize("name", ["fast", "default", "accurate", "paper"])
def test_presets_have_nothing_idle(name) -> None:
    for config in (preset(name), preset(name, on_gpu=True)):
        assert idle_settings(config, config.mapping.may_follow) == []
    assert idle_settings(reconstruct_preset(name)) == []


CASES = {
    "--tracking.weights x.pth": "tracking.weights does nothing",
    "--mapping.no-final-depth --mapping.final-iterations 0": "mapping.no-final-depth does nothing",
    "--mapping.pose-lr 1e-3 --mapping.pose-iterations 0": "mapping.pose-lr does nothing",
    "--mapping.pose-every 1 --mapping.pose-iterations 0": "mapping.pose-every does nothing",
    "--mapping.when after --mapping.final-iterations 0": "mapping.when after does nothing",
    "--loop.matches --loop.no-enabled": "loop.matches does nothing",
    "--mapping.depth.engine classical --mapping.depth.weights x": "the engine classical has none",
    "--mapping.loss.colour --mapping.loss.l1-weight 0": "mapping.loss.colour does nothing",
    "--prior.card omnidata": "prior.card does nothing",
    "--prior.normal-card omnidata": "prior.normal-card does nothing",
}


@pytest.mark.parametrize("words", CASES)
def test_what_does_nothing_says_so(words: str) -> None:
    (sentence,) = said("run", *words.split())
    assert CASES[words] in sentence


def test_a_live_run_says_that_it_refines_no_poses() -> None:
    paper = preset("paper")
    (sentence,) = idle_settings(paper, is_live=True)
    assert sentence.startswith("mapping.pose-iterations does nothing: a live run")
    assert idle_settings(preset("default"), is_live=True) == []


ON_THE_WAY = {
    "mapping.lag": ["2"],
    "mapping.window": ["5"],
    "mapping.views-per-step": ["3"],
    "mapping.no-final-depth": [],
    "mapping.pose-iterations": ["5"],
    "mapping.pose-every": ["1"],
    "mapping.pose-lr": ["1e-3"],
    "mapping.ablation.map-update": ["coherent"],
}


@pytest.mark.parametrize("name", ON_THE_WAY)
def test_a_map_made_after_the_video_heeds_nothing_that_is_for_one_on_the_way(name: str) -> None:
    words = (f"--{name}", *ON_THE_WAY[name])
    (sentence,) = said("run", *words, maps_at_end=True)
    assert sentence.startswith(f"{name.replace('no-', '')} does nothing: the map is made of all")
    assert said("run", *words) == []
    # Those of a preset are nobody's change, unless it makes its map on the way itself.
    assert said("run", "--preset", "fast", maps_at_end=True) == []
    final = ["--mapping.final-iterations", "300"]
    (many,) = said("run", "--preset", "paper", *final, maps_at_end=True)
    assert many.startswith("mapping.lag, mapping.window, mapping.views-per-step, mapping.pose-")


def test_a_map_made_after_the_video_heeds_all_others() -> None:
    """What it is trained by, and steps: they are at least as many as on the way."""
    for words in ("--mapping.iterations 9", "--mapping.lr-final 0.2", "--mapping.photo.per-step 1"):
        assert said("run", *words.split(), maps_at_end=True) == []


def test_what_is_heeded_says_nothing() -> None:
    assert said("run", "--tracking.weights", "x.pth", "--tracking.operator", "droid") == []
    assert said("run", "--mapping.no-final-depth") == []
    assert said("run", "--mapping.final-iterations", "0") == []
