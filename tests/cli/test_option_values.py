"""Every option of every command with values below, at and above its range, and with none at all."""

import math
import os
from collections.abc import Callable, Sequence

import pytest

from geogs.cli import (
    demo,
    doctor,
    download,
    eval,
    export,
    locate,
    mesh,
    reconstruct,
    run,
    scale,
    view,
)
from geogs.cli.options import parse_options
from geogs.config.leaves import Leaf, leaves
from geogs.config.setting import Positional
from geogs.errors import GeogsError, InputError
from geogs_bench.bench_options import BenchOptions
from geogs_fleet import cli as fleet
from geogs_fleet.fleet_options import FleetOptions
from geogs_synth import cli as synth
from geogs_train.cli import TrainDepthOptions, TrainOptions

Parse = Callable[[Sequence[str]], object]


def plain(options: type, command: str) -> Parse:
    return lambda argv: parse_options(options, argv, command)


COMMANDS: dict[str, tuple[type, Parse, list[str]]] = {
    "run": (run.RunOptions, run.parse, ["v.mp4"]),
    "reconstruct": (
        reconstruct.ReconstructOptions, reconstruct.parse, ["scene", "--device", "cpu"]
    ),
    "eval": (eval.EvalSettings, plain(eval.EvalSettings, "eval"), ["out", "--gt", "truth"]),
    "export": (export.ExportSettings, plain(export.ExportSettings, "export"),
               ["out", "--to", "tum"]),
    "locate": (locate.LocateSettings, plain(locate.LocateSettings, "locate"),
               ["a.jpg", "--map", "out"]),
    "mesh": (mesh.RemeshSettings, plain(mesh.RemeshSettings, "mesh"), ["out"]),
    "scale": (scale.RescaleSettings, plain(scale.RescaleSettings, "scale"), ["out"]),
    "synth": (synth.SynthOptions, lambda argv: parse_options(
        synth.SynthOptions, argv, "synth", synth._defaults), ["out"]),
    "download": (download.DownloadOptions, plain(download.DownloadOptions, "download"), []),
    "demo": (demo.DemoOptions, plain(demo.DemoOptions, "demo"), []),
    "doctor": (doctor.DoctorOptions, plain(doctor.DoctorOptions, "doctor"), []),
    "fleet": (FleetOptions, fleet.parse, ["v.mp4"]),
    "view": (view.ViewSettings, plain(view.ViewSettings, "view"), ["out"]),
    "bench": (BenchOptions, plain(BenchOptions, "bench"), ["replica"]),
    "train flow": (TrainOptions, plain(TrainOptions, "train"), ["flow", "out"]),
    "train depth": (TrainDepthOptions, plain(TrainDepthOptions, "train"), ["depth", "out"]),
}  # fmt: skip
"""Options, what reads them, and what is needed beside the one that is looked at."""

EVERY = 1 if os.environ.get("GEOGS_FUZZ") else 10
"""Only every so many-th value of an option is tried, others of the next one; by `make fuzz` all."""

TEXTS = (
    "nan", "inf", "-1e400", "1e-300", "-1e-300", "1e300", "-1", "x", "", "9" * 5000, "0x10", "none",
    "\ud800", "\u202e", "a\nb", "\0", "nan,nan",
)  # fmt: skip


def values(leaf: Leaf) -> set[str]:
    """Below, at and above the bounds, and what is no number at all."""
    found = set(TEXTS)
    for bound in leaf.kind.range.bounds:
        if isinstance(bound, int | float):
            step = 1 if leaf.kind.base is int else max(abs(bound), 1) * 1e-6
            found |= {f"{bound + k * step:.15g}" for k in (-1, 0, 1)}
    return found


@pytest.mark.parametrize("command", COMMANDS)
def test_every_option_takes_what_its_type_says_and_refuses_the_rest_in_a_sentence(command):
    options, parse, needed = COMMANDS[command]
    tried = 0
    for place, leaf in enumerate(leaves(options, command)):
        if leaf.kind.base is bool or leaf.mark(Positional) is not None or leaf.name == "resume":
            continue
        for text in sorted(values(leaf))[place % EVERY :: EVERY]:
            tried += 1
            try:
                parse([*needed, f"{leaf.options[0]}={text}"])
            except InputError as error:
                said = str(error)
                assert said.endswith("."), said
                assert len(said) < 700, said
                assert "\n" not in said
            else:
                assert leaf.kind.base not in (int, float) or is_meant(leaf, text), (leaf, text)
    assert tried >= 1


def is_meant(leaf: Leaf, text: str) -> bool:
    """Whether an option of numbers may have been given as this text."""
    kind = leaf.kind
    if text == "none":
        return kind.is_optional
    if kind.is_tuple:
        return all(is_meant_number(leaf, part) for part in text.split(",") if part)
    return text == kind.word or is_meant_number(leaf, text)


def is_meant_number(leaf: Leaf, text: str) -> bool:
    number = float(text)
    return math.isfinite(number) and leaf.kind.range.holds(number)


def test_the_settings_of_the_whole_are_all_looked_at():
    names = {leaf.name for leaf in leaves(run.RunOptions, "run")}
    assert len(names) > 100
    assert {"input.stride", "mapping.window", "tracking.weights", "checkpoint-every"} <= names


def test_a_value_that_is_refused_is_shown_in_short():
    with pytest.raises(GeogsError) as error:
        run.parse(["v.mp4", "--input.stride=" + "9" * 5000])
    assert len(str(error.value)) < 300
