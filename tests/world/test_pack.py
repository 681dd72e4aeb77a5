"""States as records: taken apart, made again, and what does not fit is said."""

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import pytest
import torch
from jaxtyping import BFloat16, Bool, Float32, Float64, Int16, UInt8
from torch import Tensor

from geogs.errors import InputError
from geogs.geometry.camera import Camera
from geogs.limits import UNBOUNDED
from geogs.world.cell_depths import MeasuredCells
from geogs.world.grid import SampleGrid
from geogs.world.keyframes import KeyframeSet, KeyframeTable, check_keyframes
from geogs.world.kinds import schema
from geogs.world.pack import pack, unpack


class Mood(Enum):
    """One of two."""

    CALM = "calm"
    WILD = "wild"


class Pair(NamedTuple):
    """A named tuple of arrays."""

    first: Float32[Tensor, "n 2"]
    second: Bool[Tensor, "n"]


@dataclass(frozen=True)
class Leaf:
    """Arrays that share a length."""

    a: Annotated[Float64[np.ndarray, "n"], UNBOUNDED]
    b: Int16[Tensor, "n 3"]


@dataclass(frozen=True)
class Twig:
    """Another kind."""

    size: int


@dataclass(eq=False)
class Tree:
    """All that a record may have."""

    name: str
    height: float
    count: int
    is_old: bool
    mood: Mood
    kind: Literal["oak", "elm"]
    girth: float | Literal["unknown"]
    path: Path | None
    leaf: Leaf | None
    several: list[Leaf | Twig]
    by_pair: dict[tuple[int, int], Twig]
    span: tuple[int, str]
    ages: tuple[Annotated[float, UNBOUNDED], ...]
    pair: Pair
    small: BFloat16[Tensor, ""]
    shared: UInt8[np.ndarray, "k"] | None = None
    tool: Any = field(default=None, metadata={"stored": False})


def tree() -> Tree:
    base = torch.arange(24).reshape(8, 3).short()
    leaf = Leaf(np.array([1.0, math.inf]), base[2:4])  # a part of a larger tensor
    pair = Pair(torch.zeros(0, 2), torch.zeros(0, dtype=torch.bool))
    return Tree(
        "beech", 0.1 + 0.2, 2**127, True, Mood.WILD, "elm", "unknown", Path("a/b"), leaf,
        [Twig(3), leaf],
        {(1, 2): Twig(5), (0, 9): Twig(6)}, (1, "x"), (math.inf, 2.0), pair,
        torch.tensor(1.5, dtype=torch.bfloat16), None, print,
    )  # fmt: skip


def test_what_was_taken_apart_is_the_same_again():
    given, packed = tree(), pack(Tree, tree())
    values = json.loads(json.dumps(packed.values))
    made = unpack(Tree, values, packed.arrays, {})
    for name in (
        "name",
        "height",
        "count",
        "is_old",
        "mood",
        "kind",
        "girth",
        "path",
        "span",
        "ages",
    ):
        assert getattr(made, name) == getattr(given, name), name
    assert list(made.by_pair.items()) == list(given.by_pair.items())  # in their order
    assert made.several[0] == Twig(3)
    for own, other in ((made.leaf, given.leaf), (made.several[1], given.several[1])):
        np.testing.assert_array_equal(own.a, other.a)
        assert torch.equal(own.b, other.b)
    assert made.leaf.b.untyped_storage().nbytes() == 12
    assert made.pair.first.shape == (0, 2)
    assert made.small.dtype == torch.bfloat16
    assert float(made.small) == 1.5
    assert made.tool is None
    assert sorted(packed.arrays) == sorted(
        ["leaf.a", "leaf.b", "pair.first", "pair.second", "several.1.a", "several.1.b", "small"]
    )


def test_what_cannot_be_stored_is_told_when_it_is_written():
    wrong = tree()
    wrong.count = 1.5
    with pytest.raises(TypeError, match="count is a float, not int"):
        pack(Tree, wrong)
    wrong = tree()
    wrong.several = [Mood.CALM]
    with pytest.raises(TypeError, match=r"several.0 is a Mood"):
        pack(Tree, wrong)


@pytest.mark.parametrize(
    ("place", "change"),
    [
        ("height", lambda v, a: v.update(height="high")),
        ("count", lambda v, a: v.update(count=True)),
        ("mood", lambda v, a: v.update(mood="__class__")),
        ("mood", lambda v, a: v.update(mood=[])),
        ("kind", lambda v, a: v.update(kind="yew")),
        ("it", lambda v, a: v.update(tool="os.system")),
        ("it", lambda v, a: v.pop("name")),
        ("leaf", lambda v, a: v.update(leaf=[])),
        ("several", lambda v, a: v.update(several=[[7, {}]])),
        ("several", lambda v, a: v.update(several=["__reduce__"])),
        ("by_pair", lambda v, a: v.update(by_pair=v["by_pair"][:1] * 2)),
        ("span", lambda v, a: v.update(span=[1])),
        ("small", lambda v, a: v.update(small="elsewhere")),
        ("leaf.b", lambda v, a: a.pop("leaf.b")),
        ("leaf.b", lambda v, a: a.update({"leaf.b": torch.zeros(2, 3)})),
        ("leaf.b", lambda v, a: a.update({"leaf.b": torch.zeros(2, 4).short()})),
        ("leaf.b", lambda v, a: a.update({"leaf.b": torch.zeros(3, 3).short()})),  # n is 2
    ],
)
def test_what_does_not_fit_is_said(place: str, change: Callable[[dict, dict], None]):
    packed = pack(Tree, tree())
    change(packed.values, packed.arrays)
    with pytest.raises(InputError, match=rf"^{place}(\.0)? is missing"):
        unpack(Tree, packed.values, packed.arrays, {})


def test_a_schema_changes_with_names_types_and_shapes():
    @dataclass
    class A:
        x: Float32[Tensor, "n 2"]
        y: int

    @dataclass
    class B:
        x: Float32[Tensor, "n 2"]
        y: int

    first = schema(A)
    B.__name__ = "A"
    assert schema(B) == first
    seen = {first}
    for kind in (Float64[Tensor, "n 2"], Float32[Tensor, "n 3"], Float32[np.ndarray, "n 2"], int):
        B.__annotations__["x"] = kind
        seen.add(schema(B))
    B.__annotations__ = {"x": Float32[Tensor, "n 2"], "y": int | None}
    seen.add(schema(B))
    assert len(seen) == 6


def test_a_keyframe_with_measured_depth_comes_back():
    grid = SampleGrid(Camera(60.0, 60.0, 31.5, 23.5, 64, 48))
    segment = KeyframeTable.on(grid).new_set()
    image, eye = np.zeros((48, 64, 3), np.uint8), torch.eye(4, dtype=torch.float64)
    keyframe = segment.add(0, 0.0, image, None, eye)
    keyframe.sensor_depth = np.linspace(1, 3, 64 * 48, dtype=np.float32).reshape(48, 64)
    keyframe.measured = MeasuredCells(torch.rand(grid.size), torch.rand(grid.size))
    packed = pack(KeyframeTable, segment.table)
    table = unpack(KeyframeTable, packed.values, packed.arrays, packed.archives).attached(grid)
    packed = pack(KeyframeSet, segment)
    again = unpack(KeyframeSet, packed.values, packed.arrays, {}).attached(table)
    check_keyframes(table, [again])
    back = again[0]
    np.testing.assert_array_equal(back.image, image)
    assert torch.equal(back.T_cw, eye)
    assert torch.equal(back.measured.information, keyframe.measured.information)
    np.testing.assert_allclose(back.sensor_depth, keyframe.sensor_depth, rtol=1e-6)
    assert keyframe.sensor_depth[0, 1] == pytest.approx(1 + 2 / (64 * 48 - 1), rel=5e-4)
