"""How alike errors of flow are: on errors of known correlation."""

import math
import re

import pytest
import torch

from flow_correlation import correlation, factor

NUMBER = re.compile(r"factor ([\d.]+)")


def factor_of(z: torch.Tensor, edges: int = 6) -> float:
    found = NUMBER.search(factor(z, edges))
    assert found is not None
    return float(found.group(1))


def test_independent_errors_need_no_factor():
    z = torch.randn(8, 2, 30, 40, 2, generator=torch.Generator().manual_seed(0))
    assert factor_of(z) == pytest.approx(1.0, abs=0.03)
    assert factor_of(2 * z) == pytest.approx(2.0, abs=0.06)


def test_blocks_of_one_error_count_as_one():
    g = torch.Generator().manual_seed(1)
    coarse = torch.randn(16, 2, 20, 20, 2, generator=g)
    z = coarse.repeat_interleave(3, 2).repeat_interleave(3, 3)
    # A mean over blocks of nine alike has nine times the variance.
    assert factor_of(z) == pytest.approx(3.0, rel=0.12)


def test_edges_that_err_alike_count_as_one():
    g = torch.Generator().manual_seed(2)
    one = torch.randn(16, 1, 30, 40, 2, generator=g)
    assert factor_of(one.expand(-1, 2, -1, -1, -1)) == pytest.approx(math.sqrt(6), rel=0.03)


def test_unknown_cells_do_not_count():
    z = torch.randn(2, 2, 20, 20, 2, generator=torch.Generator().manual_seed(3))
    z[:, :, :10] = torch.nan
    assert correlation(z, z, 0, 0) == pytest.approx(1.0, abs=1e-5)
    assert abs(correlation(z, z, 0, 3)) < 0.1
    assert math.isnan(correlation(z, z, 15, 0))
