"""Run ``geogs`` with another value of a module's constant: ``MODULE:NAME VALUE COMMAND …``.

The value is set as soon as the module has been executed, before other modules import the constant.
"""

import importlib.abc
import importlib.machinery
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType


@dataclass(frozen=True)
class Constant:
    """A constant of a module."""

    module: str
    name: str

    @classmethod
    def named(cls, words: str) -> "Constant":
        """The constant of ``MODULE:NAME``. Raises ValueError for other words."""
        module, name = words.split(":")
        return cls(module, name)

    def __str__(self) -> str:
        return f"{self.module}:{self.name}"


class _Finder(importlib.abc.MetaPathFinder):
    """Finds the one module, and has its constant changed once it is loaded."""

    def __init__(self, constant: Constant, value: float) -> None:
        self._constant = constant
        self._value = value

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        if fullname != self._constant.module:
            return None
        spec = importlib.machinery.PathFinder.find_spec(fullname, path, target)
        if spec is not None and spec.loader is not None:
            execute = spec.loader.exec_module

            def changed(module: ModuleType) -> None:
                execute(module)
                setattr(module, self._constant.name, self._value)

            spec.loader.exec_module = changed  # type: ignore[method-assign]
        return spec


def change(constant: Constant, value: float) -> None:
    """Give a constant another value in this process; its module must not be imported yet."""
    assert constant.module not in sys.modules, f"{constant.module} is imported already"
    sys.meta_path.insert(0, _Finder(constant, value))


if __name__ == "__main__":
    words, number, *arguments = sys.argv[1:]
    change(Constant.named(words), float(number) if "." in number or "e" in number else int(number))
    from geogs.cli.main import main

    sys.exit(main(arguments))
