"""Inlining of the functions that compiled kernels call.

If two kernels call a function, each has its own copy, optimised with the kernel; the function
itself has one more. All have the same name, and where LLVM does not inline them, the copy that the
process loads first serves all. Under ``fastmath`` the copies may round differently: then a kernel's
results depend on what the process has compiled or called before, and on whether the kernel came
from the disk. So functions called by such kernels are always inlined and never cached alone.
"""

from collections.abc import Mapping
from typing import Any


def inlined(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return a kernel's options changed for a function that it calls: LLVM has to inline it.

    It is compiled again with each kernel that is not cached on disk, and never cached itself.
    """
    return {**options, "cache": False, "forceinline": True}
