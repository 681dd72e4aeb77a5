"""Every setting has a range, and nothing outside of it is accepted."""

import math
from collections.abc import Iterator
from dataclasses import MISSING, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from geogs import config
from geogs.application.result_settings import EvalSettings
from geogs.application.run_settings import ReconstructSettings, RunSettings
from geogs.cli.demo import DemoOptions
from geogs.config.setting import Kind, Only, Range, Settings, Time, kinds
from geogs.errors import InputError
from geogs_bench.bench_options import BenchOptions
from geogs_synth.camera.flaws import Flaws
from geogs_synth.cli import SynthOptions
from geogs_train.cli import TrainOptions

TREES = (config.Config(), config.ReconstructConfig())
TRAINING = TrainOptions("flow", Path("x"))
COMMANDS = (
    RunSettings, ReconstructSettings, EvalSettings, BenchOptions, DemoOptions, SynthOptions,
    Flaws,
)  # fmt: skip


def groups(tree: object, name: str = "") -> Iterator[tuple[str, object]]:
    """All dataclasses of a tree with their dotted names."""
    yield name, tree
    for field in fields(tree):
        inner = getattr(tree, field.name)
        if is_dataclass(inner):
            yield from groups(inner, f"{name}.{field.name}" if name else field.name)


CLASSES = {type(group) for tree in (*TREES, TRAINING) for _, group in groups(tree)} | set(COMMANDS)
NUMBERS = [
    pytest.param(kind, name, setting, id=f"{kind.__name__}.{name}")
    for kind in sorted(CLASSES, key=lambda kind: kind.__name__)
    for name, setting in kinds(kind)
    if setting.base in (int, float)
]


def made(kind: type, name: str, value: object) -> object:
    """An instance with one setting of a value; those that it bounds are moved out of its way."""
    values = {f.name: "x" for f in fields(kind) if f.default is f.default_factory is MISSING}
    values = {k: Path(x) if dict(kinds(kind))[k].base is Path else x for k, x in values.items()}
    values[name] = value
    movable = dict(kinds(kind))[name].allows(value)
    for other, setting in kinds(kind) if movable else ():
        if name in setting.range.partners():
            group = type("Group", (), {name: value})
            default = next(f.default for f in fields(kind) if f.name == other)
            some = [default, value, value + 1]
            values[other] = next(v for v in some if setting.allows(v, group))
    return kind(**values)


def wrapped(setting: Kind, value: object) -> object:
    return (value,) if setting.is_tuple else value


@pytest.mark.parametrize(("kind", "name", "setting"), NUMBERS)
def test_every_number_has_a_range_and_is_finite(kind: type, name: str, setting: Kind) -> None:
    assert setting.range != Range()
    bad = [math.nan, math.inf, -math.inf, True, "1", 1j]
    bad += [] if setting.is_optional else [None]
    bad += [1.5] if setting.base is int else []
    assert not any(setting.allows(wrapped(setting, value)) for value in bad if value is not None)
    # The tests' own type checks wrap what is not in this package, and come first.
    tried = (
        bad if kind.__module__.startswith("geogs.config.") else bad[: 3 * (setting.base is float)]
    )
    for value in tried:
        with pytest.raises(InputError, match="must be"):
            made(kind, name, wrapped(setting, value))


@pytest.mark.parametrize(("kind", "name", "setting"), NUMBERS)
def test_bounds_belong_to_a_range_or_end_it(kind: type, name: str, setting: Kind) -> None:
    bounds = setting.range
    for bound, sign in ((bounds.least, -1), (bounds.most, 1)):
        if isinstance(bound, int | float):
            value = setting.base(bound)
            assert getattr(made(kind, name, wrapped(setting, value)), name) is not None
            step = 1 if setting.base is int else max(abs(value), 1e-9) * 1e-6
            with pytest.raises(InputError, match="must be"):
                made(kind, name, wrapped(setting, value + sign * step))
    for bound in (bounds.above, bounds.below):
        if isinstance(bound, int | float):
            with pytest.raises(InputError, match="must be"):
                made(kind, name, wrapped(setting, setting.base(bound)))


@pytest.mark.parametrize(("kind", "name", "setting"), NUMBERS)
def test_no_number_but_a_time_may_be_so_small_that_it_is_nothing(kind, name, setting) -> None:
    is_time = Time in setting.marks or name == "minutes"
    if setting.base is float and not is_time and not setting.range.holds(0):
        assert not setting.range.holds(1e-300)


@pytest.mark.parametrize("kind", sorted(CLASSES, key=lambda kind: kind.__name__))
def test_what_bounds_a_setting_is_checked_before_it(kind: type) -> None:
    assert issubclass(kind, Settings)
    order = [name for name, _ in kinds(kind)]
    for name, setting in kinds(kind):
        for partner in setting.range.partners():
            assert order.index(partner) < order.index(name)


@pytest.mark.parametrize("tree", [*TREES, TRAINING], ids=lambda tree: type(tree).__name__)
def test_every_group_knows_its_place(tree: Settings) -> None:
    for name, group in groups(tree):
        assert type(group).group == name


def test_presets_are_valid() -> None:
    for name in ("fast", "default", "accurate"):
        assert config.preset(name).mapping.window == 8
        assert config.reconstruct_preset(name).mapping.loss.l1_cut == 0.1
    assert config.preset("paper").mapping.window == 11


@given(least=st.integers(-5, 5), most=st.integers(-5, 5), x=st.floats(-9, 9), odd=st.booleans())
def test_a_range_holds_what_its_bounds_say(least: int, most: int, x: float, odd: bool) -> None:
    closed, opened = Range(least, most), Range(above=least, below=most)
    assert closed.holds(x, None) == (least <= x <= most)
    assert opened.holds(x, None) == (least < x < most)
    assert Range(least, most, or_zero=True).holds(0, None)
    assert Range(least, most, or_zero=True).holds(x, None) == (least <= x <= most or x == 0)
    assert Range(least, most, odd=odd).holds(round(x), None) == (
        least <= round(x) <= most and (not odd or round(x) in range(-9, 10, 2))
    )


@dataclass(frozen=True)
class Sweep(Settings, group="sweep"):
    """A made-up group."""

    window: Annotated[int, Range(1, 9)] = 4
    resident_views: Annotated[int, Range(above="window")] = 10
    name: Literal["a", "b"] = "a"
    folder: Path | None = None
    times: tuple[Annotated[float, Range(0, below=1)], ...] = (0.5,)


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ({"window": -3}, "sweep.window is -3, but must be a whole number from 1 to 9."),
        ({"window": 2.0}, "sweep.window is 2.0, but must be a whole number from 1 to 9."),
        (
            {"window": 8, "resident_views": 8},
            "sweep.resident-views is 8, but must be a whole number above window (window is 8).",
        ),
        ({"name": "c"}, "sweep.name is 'c', but must be a or b."),
        ({"folder": "x"}, "sweep.folder is 'x', but must be none or a path."),
        (
            {"times": (0.5, 1.0)},
            "sweep.times is (0.5, 1.0), but must be numbers at least 0 and below 1.",
        ),
        ({"times": 0.5}, "sweep.times is 0.5, but must be numbers at least 0 and below 1."),
    ],
)  # fmt: skip
def test_a_value_that_cannot_be_is_refused_in_one_sentence(values: dict, sentence: str) -> None:
    with pytest.raises(InputError) as error:
        Sweep(**values)
    assert str(error.value) == sentence


def test_numbers_of_other_libraries_are_numbers() -> None:
    assert Sweep(window=np.int32(3), times=(np.float32(0.25),)).window == 3
    with pytest.raises(InputError):
        Sweep(times=(np.float32("nan"),))


def test_kinds_come_from_types() -> None:
    kind = Kind.of(Annotated[tuple[Annotated[float, Range(0, 1)], ...] | None, Only("run")])
    assert (kind.base, kind.is_tuple, kind.is_optional) == (float, True, True)
    assert (kind.range, kind.marks) == (Range(0, 1), (Only("run"),))
    time = Kind.of(Annotated[float, Time])
    assert [time.read(text) for text in ("90", "90s", "1.5m", "2min", ".5h")] == [
        90.0, 90.0, 90.0, 120.0, 1800.0,
    ]  # fmt: skip
    assert not time.allows(time.read("soon"))
    auto = Kind.of(Annotated[float | Literal["auto"], Range(0, 1)])
    assert (auto.base, auto.word, str(auto)) == (float, "auto", "auto or a number from 0 to 1")
    assert [auto.read(text) for text in ("Auto", "0.5")] == ["auto", 0.5]
    assert all(auto.allows(value) for value in ("auto", 0.5))
    assert not any(auto.allows(value) for value in ("none", "0.5", 2.0, None))
    assert kind.read("0.5,1") == (0.5, 1.0)
    assert kind.read("None") is None
    assert not kind.allows(kind.read("0.5,x"))
    with pytest.raises(TypeError, match="no setting can be of the type"):
        Kind.of(dict[str, int])
