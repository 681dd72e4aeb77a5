"""Hypothesis strategies that damage a good file with its structure in mind."""

import json
import re
import struct
import warnings
from typing import Any

from hypothesis import strategies as st

WORDS = (
    "nan", "inf", "-inf", "1e400", "-1e400", "1e308", "1e-308", "0", "-0", "-1", "1", "2", "0.5",
    "1e9", "1e-9", "4294967296", "9223372036854775808", "-9223372036854775809", "1" + 400 * "0",
    "9" * 5000, "", "x", "é", "\x00", "\x1b[31m", "#", "%", ",", "[", "{", "null", "true", "1_0",
    "٣", "../../../../etc/passwd", "/etc/passwd", "/dev/zero", "/dev/stdin", "FOV", "PINHOLE",
    "OPENCV", "a" * 5000, "\ufeff", "\u2028", "0x10", "-", "+", ".", "..", "/",
)  # fmt: skip
"""Words that replace others."""

VALUES: tuple[Any, ...] = (
    None, True, False, 0, 1, -1, 2**31, 2**63, 2**64, 10**400, 0.5, -0.0, 1e308, 1e-308, 1e9, 1e-9,
    float("nan"), float("inf"), float("-inf"), "", "x", "nan", "1e400", "\x00", "../../etc/passwd",
    "/dev/zero", "\ud800", [], [[]], [None], [1], [1, 2, 3, 4], ["x"], {}, {"x": None}, 11 * [0.1],
    [float("nan")] * 4, 1.5, [[0.0] * 4] * 4, [[1.0] * 4] * 3,
)  # fmt: skip
"""Values that replace others in a document."""

FIELDS = (
    b"\0" * 4, b"\xff" * 4, b"\xff\xff\xff\x7f", b"\0\0\0\x80", b"\0\0\xc0\x7f", b"\0\0\x80\x7f",
    b"\0" * 8, b"\xff" * 8, b"\xff" * 7 + b"\x7f", b"\0" * 7 + b"\x80", struct.pack("<d", 1e308),
    struct.pack("<d", float("nan")), struct.pack("<d", float("-inf")), struct.pack("<d", 1e-308),
    struct.pack("<Q", 2**40), struct.pack("<I", 10**6), b"\x01", b"\xff", b"\0", b"\x80",
)  # fmt: skip
"""Bytes that replace as many others in a binary file."""


@st.composite
def text(draw: st.DrawFn, data: bytes) -> bytes:
    """Words and lines exchanged, doubled or left out; now and then the bytes."""
    for _ in range(draw(st.integers(1, 3))):
        words = re.split(r"([\s,:\[\]{}=\"]+)", data.decode("utf-8", "surrogateescape"))
        at = draw(st.integers(0, len(words) - 1))
        match draw(st.integers(0, 7)):
            case 0 | 1 | 2:
                words[at] = draw(st.sampled_from(WORDS))
            case 3:
                del words[at : at + draw(st.integers(1, 20))]
            case 4:
                words[at:at] = words[at : at + draw(st.integers(1, 20))]
            case 5:
                del words[at:]
            case 6:
                words[at] = draw(st.sampled_from(WORDS)) + words[at]
            case _:
                return draw(binary("".join(words).encode("utf-8", "surrogateescape")))
        data = "".join(words).encode("utf-8", "surrogateescape")
    return data


@st.composite
def binary(draw: st.DrawFn, data: bytes) -> bytes:
    """Fields with the extremes of their type, bytes left out, put in or doubled; cut off."""
    changed = bytearray(data)
    for _ in range(draw(st.integers(1, 4))):
        near = draw(st.sampled_from((64, 256, max(len(changed), 1))))  # headers decide most
        at = draw(st.integers(0, max(min(near, len(changed)) - 1, 0)))
        match draw(st.integers(0, 5)):
            case 0 | 1:
                field = draw(st.sampled_from(FIELDS))
                changed[at : at + len(field)] = field
            case 2:
                changed[at : at + 1] = bytes([draw(st.integers(0, 255))])
            case 3:
                del changed[at : at + draw(st.integers(1, 64))]
            case 4:
                changed[at:at] = changed[at : at + draw(st.integers(1, 64))]
            case _:
                del changed[draw(st.integers(0, max(len(changed) - 1, 0))) :]
    return bytes(changed)


@st.composite
def document(draw: st.DrawFn, value: Any, depth: int = 0) -> Any:
    """The value of a JSON or YAML file with a node somewhere exchanged, left out or nested."""
    inner: list[Any] = []
    if isinstance(value, dict):
        inner = list(value)
    elif isinstance(value, list):
        inner = list(range(len(value)))
    if not inner or draw(st.integers(0, 3 + 3 * (depth == 0))) == 0:
        match draw(st.integers(0, 3)):
            case 0:
                return [value]
            case 1:
                return str(value)
            case _:
                return draw(st.sampled_from(VALUES))
    at = draw(st.sampled_from(inner))
    copy = value.copy()
    match draw(st.integers(0, 6)):
        case 0:
            del copy[at]
        case 1 if isinstance(value, dict):
            copy[draw(st.sampled_from(("", "x", *inner)))] = draw(st.sampled_from(VALUES))
        case 1:
            copy.insert(at, value[at])
        case _:
            copy[at] = draw(document(value[at], depth + 1))
    return copy


@st.composite
def json_text(draw: st.DrawFn, data: bytes) -> bytes:
    """A JSON file whose values, or whose text, are damaged."""
    match draw(st.integers(0, 9)):
        case 0:
            return draw(text(data))
        case 1:
            return draw(st.sampled_from((b"[" * 100_000, b'{"a":' * 100_000, b"", b"null", b"[]")))
        case _:
            changed = json.loads(data)
            for _ in range(draw(st.integers(1, 3))):
                changed = draw(document(changed))
            return json.dumps(changed).replace("Infinity", "1e400").encode()


BOMB = "a: &a [0,0,0,0,0,0,0,0,0]\n" + "".join(
    f"{b}: &{b} [*{a},*{a},*{a},*{a},*{a},*{a},*{a},*{a},*{a}]\n"
    for a, b in zip("abcdefghij", "bcdefghijk", strict=True)
)
"""YAML that means 10^10 numbers."""


@st.composite
def yaml_text(draw: st.DrawFn, data: bytes) -> bytes:
    """A YAML file whose values, or whose text, are damaged."""
    import yaml

    match draw(st.integers(0, 9)):
        case 0 | 1 | 2:
            return draw(text(data))
        case 3:
            odd = (
                   "!!python/object/apply:os.system [x]", "a: *b", "? ? ?", "[" * 5000, "- " * 5000,
                   "2001-99-99", "!!timestamp 9", "!!binary x", "{a: &a [*a]}", BOMB, "\t", "%YAML",
                   "!!int x", "!!float x", "!!set {1,2}", "---\n---\n", "0x", "1:60:99", "<<: 1",
            )  # fmt: skip
            return draw(st.sampled_from(odd)).encode() + draw(st.sampled_from((b"", b"\n" + data)))
        case _:
            changed = yaml.safe_load(data)
            for _ in range(draw(st.integers(1, 3))):
                changed = draw(document(changed))
            return yaml.safe_dump(changed).encode("utf-8", "surrogatepass")


@st.composite
def safetensors(draw: st.DrawFn, data: bytes) -> bytes:
    """A safetensors file with a damaged header, or metadata that are, or damaged bytes."""
    length = int.from_bytes(data[:8], "little")
    header, rest = json.loads(data[8 : 8 + length]), data[8 + length :]
    match draw(st.integers(0, 5)):
        case 0:
            return draw(binary(data))
        case 1:
            return data[: 8 + length] + draw(binary(rest))
        case 2 | 3 if "metadata" in header.get("__metadata__", {}):
            own = header["__metadata__"]
            own["metadata"] = draw(json_text(own["metadata"].encode())).decode("utf-8", "replace")
        case _:
            header = draw(document(header))
    text = json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + rest


@st.composite
def archive(draw: st.DrawFn, data: bytes) -> bytes:
    """A NumPy archive with arrays exchanged, misshapen or left out, or damaged bytes."""
    import io

    import numpy as np

    if draw(st.integers(0, 3)) == 0:
        return draw(binary(data))
    with np.load(io.BytesIO(data)) as file:
        arrays = dict(file)
    for _ in range(draw(st.integers(1, 2))):
        name = draw(st.sampled_from(sorted(arrays)))
        array = arrays[name]
        match draw(st.integers(0, 6)):
            case 0:
                del arrays[name]
            case 1:
                arrays[name] = array.reshape(-1)[: draw(st.integers(0, 16))]
            case 2:
                kind = draw(st.sampled_from(("i1", "f2", "c16", "U4", "O")))
                with np.errstate(all="ignore"), warnings.catch_warnings(action="ignore"):
                    arrays[name] = array.astype(kind)
            case 3:
                arrays[name] = np.zeros_like(array)
            case 4:
                arrays[name] = array[None]
            case 5:
                arrays[draw(st.sampled_from(("world_mat_99", "world_mat_x", "é")))] = array
            case _:
                odd = st.sampled_from((np.nan, np.inf, 1e300, 1e-300, 0.0, -1.0))
                array = array.real.astype(np.float64)
                if array.size:
                    array.flat[draw(st.integers(0, array.size - 1))] = draw(odd)
                arrays[name] = array
        if not arrays:
            break
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()
