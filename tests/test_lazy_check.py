"""The checks of types that all tests run under."""

import numpy as np
import pytest
from jaxtyping import Float, TypeCheckError, jaxtyped

from lazy_check import checked


def cut(length: int):
    """A function of its own that keeps so many numbers, and says that it keeps all."""

    @jaxtyped(typechecker=checked)
    def inner(x: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        return x[:length]

    return inner


def test_arguments_and_results_are_checked_at_every_call():
    for _ in range(2):
        assert cut(3)(np.zeros(3)).shape == (3,)
        with pytest.raises(TypeCheckError, match="parameters"):
            cut(3)(np.zeros((3, 3)))
        with pytest.raises(TypeCheckError, match="return value"):
            cut(2)(np.zeros(3))
