"""Inlining of the functions that compiled kernels call.

Of a function that two kernels call, each has a copy of its own, optimised with the kernel; the
function itself has one more. All have the same name, and where LLVM does not inline them, whichever
the process has loaded first serves all. Under ``fastmath`` the copies may round differently: then a
kernel's results depend on what the process has compiled or called before, and on whether the kernel
came from the disk. So what such kernels call is inlined, and kept nowhere by itself.
"""

from collections.abc import Mapping
from typing import Any


def inlined(options: Mapping[str, Any]) -> dict[str, Any]:
    """Options of a function that such kernels call, by those of a kernel: LLVM has to inline it.

    It is compiled anew with each kernel that the disk does not have, never taken from there.
    """
    return {**options, "cache": False, "forceinline": True}
