"""The similarity between point sets."""

import pytest
import torch

from geogs.errors import GeogsError
from geogs.geometry.lie import so3_exp
from geogs.geometry.umeyama import umeyama

F64 = torch.float64


@pytest.mark.parametrize("with_scale", [True, False])
def test_umeyama_recovers_a_similarity(with_scale):
    g = torch.Generator().manual_seed(1)
    source = torch.randn(40, 3, dtype=F64, generator=g)
    R, t = so3_exp(torch.tensor([0.4, -1.9, 1.2], dtype=F64)), torch.tensor([3.0, -2, 0.5]).double()
    s = 2.7 if with_scale else 1.0
    scale, rotation, translation = umeyama(source, s * source @ R.mT + t, with_scale)
    assert abs(float(scale) - s) < 1e-12
    assert (rotation - R).abs().max() < 1e-12
    assert (translation - t).abs().max() < 1e-12


def test_umeyama_of_a_mirrored_set_is_still_a_rotation():
    source = torch.randn(30, 3, dtype=F64, generator=torch.Generator().manual_seed(2))
    _, R, _ = umeyama(source, source * torch.tensor([1.0, 1, -1], dtype=F64))
    assert float(torch.linalg.det(R)) == pytest.approx(1.0)


def test_umeyama_refuses_a_line():
    line = torch.linspace(0, 1, 10, dtype=F64)[:, None] * torch.tensor([1.0, 2, 3], dtype=F64)
    with pytest.raises(GeogsError, match="line"):
        umeyama(line, line)
