"""Parsers that do what none may do, by which the fuzz tests are tested."""

import ctypes
import os

import mutations
from parsers.base import Parser


def hostile() -> dict[str, Parser]:
    """By what they do."""
    found = {"crashes": crash, "hangs": hang, "floods": flood, "stumbles": stumble, "reads": len}
    return {
        name: Parser(lambda folder: None, (), mutations.binary, lambda f, do=do: do(f.parts))
        for name, do in found.items()
    }


def crash(_: object) -> None:
    os.abort()


def hang(_: object) -> None:
    """Without a look at signals, as a library in C."""
    ctypes.PyDLL(None).sleep(600)


def flood(_: object) -> int:
    return len(b"x" * (1 << 30))


def stumble(_: object) -> None:
    raise KeyError("stumbled")
