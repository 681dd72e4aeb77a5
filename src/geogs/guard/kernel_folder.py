"""Cache folder of the kernels that numba has compiled for the CPU.

Numba uses the folder of a kernel's source, or else one of the user's; where both are read-only, as
in many containers, it raises an error.
"""

import os
import stat
from pathlib import Path

VARIABLE = "NUMBA_CACHE_DIR"
"""Environment variable of numba's folder; a user's setting is kept."""


def find_kernel_folder() -> None:
    """Set a temporary folder where numba would find no writable one.

    It has to be called before numba is imported.
    """
    if VARIABLE not in os.environ and not any(map(can_be_written, _usual())):
        os.environ[VARIABLE] = str(temporary_folder())


def kernel_folder() -> Path:
    """Return the folder in which numba keeps kernels, or one of several."""
    if VARIABLE in os.environ:
        return Path(os.environ[VARIABLE])
    return next(filter(can_be_written, _usual()), _usual()[-1])


def _usual() -> tuple[Path, Path]:
    home = os.path.expanduser("~")
    cache = os.environ.get("XDG_CACHE_HOME") or os.path.join(home, ".cache")
    return Path(__file__).parent / "__pycache__", Path(cache) / "numba"


def can_be_written(folder: Path) -> bool:
    """Whether files can be made in a folder, existing or not."""
    there = next((f for f in (folder, *folder.parents) if f.exists()), None)
    return there is not None and there.is_dir() and os.access(there, os.W_OK | os.X_OK)


def temporary_folder() -> Path:
    """Return one folder for all processes of a user if nobody else can write there, else a new one.

    Whoever can write to the folder of kernels can have programs run.
    """
    import tempfile  # a tenth of the time of ``geogs --version``, and rarely needed

    user = os.getuid()
    folder = Path(tempfile.gettempdir()) / f"geogs-kernels-{user}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
        is_own = stat.S_ISDIR(status.st_mode) and status.st_uid == user
        if is_own and not status.st_mode & 0o077:
            return folder
    except OSError:
        pass
    return Path(tempfile.mkdtemp(prefix="geogs-kernels-"))
