"""Run-time shape checks for the whole suite, and where the shared data is."""

from pathlib import Path

import jaxtyping
import pytest
import torch

SOURCE = Path(__file__).parents[1] / "src"


def _typed_modules() -> list[str]:
    """Every module of ours except compiled kernels, which the type checker must not wrap, and
    settings, which check themselves."""
    names = []
    for path in SOURCE.glob("geogs*/**/*.py"):
        name = ".".join(path.relative_to(SOURCE).with_suffix("").parts)
        left_out = ".splat.cpu." in name or name.startswith("geogs.config.")
        if not name.endswith(("_kernels", "__init__")) and not left_out:
            names.append(name)
    return sorted(names)


torch.set_num_threads(1)  # as the system works; more only wait for each other
jaxtyping.install_import_hook(_typed_modules(), "beartype.beartype")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of development sequences; tests that need it are skipped without it."""
    folder = Path(__file__).parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("the development data (../shared/data) is not on this machine")
    return folder
