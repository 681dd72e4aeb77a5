"""Run the wheel in an environment that has nothing but it and what it asks for.

    python .github/try_wheel.py DIST ENVIRONMENT

DIST has one wheel, ENVIRONMENT is made anew. On Linux PyTorch's CPU build is taken, as PyPI's is
that for CUDA; another index is named by TORCH_INDEX, PyPI by an empty one. CONSTRAINTS is a file
with versions, such as constraints.txt.
"""

import os
import subprocess
import sys
import tempfile
import venv
import zipfile
from pathlib import Path

_CPU = "https://download.pytorch.org/whl/cpu" if sys.platform == "linux" else ""
_BINARIES = "geogs/gpu/compiled/sm_"
_DEMO = ("demo", "-o", "demo", "--frames", "40", "--width", "160", "--height", "120")


def main(dist: Path, environment: Path) -> None:
    """Install it and run it from elsewhere than the sources; raises where something fails."""
    (wheel,) = dist.resolve().glob("geogs-*.whl")
    if not any(name.startswith(_BINARIES) for name in zipfile.ZipFile(wheel).namelist()):
        raise SystemExit(f"{wheel.name} has no compiled kernels; make dist compiles them.")
    venv.create(environment, with_pip=True, clear=True)
    programs = environment.resolve() / ("Scripts" if sys.platform == "win32" else "bin")
    pip = [programs / "python", "-m", "pip", "install", "--quiet"]
    if constraints := os.environ.get("CONSTRAINTS"):
        pip += ["-c", Path(constraints).resolve()]
    index = os.environ.get("TORCH_INDEX", _CPU)
    if index:
        subprocess.run([*pip, "torch", "--index-url", index], check=True)
    subprocess.run([*pip, wheel], check=True)
    with tempfile.TemporaryDirectory() as elsewhere:
        for words in (("--version",), ("doctor",), _DEMO, ("export", "demo/result", "--to", "glb")):
            subprocess.run([programs / "geogs", *words], check=True, cwd=elsewhere)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
