"""The search as a recording says the same as the search itself, for any number of neighbours."""

import pytest
import torch

from geogs.depth.network.model import DepthNetwork
from geogs.depth.network.options import DepthNetworkOptions
from geogs.depth.network.recorded import RecordedSearch
from geogs.depth.network.views import StereoViews

SMALL = DepthNetworkOptions(
    encoder=(8, 8, 8), matching=8, groups=4, metadata=8, planes=8, context=(8, 8, 8, 8, 8),
    volume=(8, 8, 8, 8), decoder=8,
)  # fmt: skip


def views(neighbours: int, seed: int, device: str) -> StereoViews:
    random = torch.Generator().manual_seed(seed)
    T = torch.eye(4).repeat(1, neighbours, 1, 1)
    T[..., :3, 3] = 0.2 * torch.randn(1, neighbours, 3, generator=random)
    lens = torch.tensor([[60.0, 60.0, 31.5, 31.5]])
    bounds = (torch.tensor([x]) for x in (0.5, 4.0, 1.5))
    return StereoViews(
        torch.rand(1, 3, 64, 64, generator=random),
        torch.rand(1, neighbours, 3, 64, 64, generator=random),
        lens,
        lens[:, None].expand(-1, neighbours, -1),
        T,
        torch.ones(1, neighbours, dtype=torch.bool),
        *bounds,
    ).to(device)


def test_without_a_gpu_it_is_called_as_it_is():
    seen = []

    def work(given: StereoViews) -> tuple[torch.Tensor, ...]:
        seen.append(given)
        return (given.image,)

    search, given = RecordedSearch(work), views(2, 0, "cpu")
    assert search(given)[0] is given.image
    assert search(given)[0] is given.image
    assert len(seen) == 2
    assert seen[0] is given


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_a_recording_says_the_same_for_other_views_and_other_numbers_of_neighbours():
    torch.manual_seed(0)
    network = DepthNetwork(SMALL).cuda().eval().requires_grad_(False)

    def work(given: StereoViews) -> tuple[torch.Tensor, ...]:
        found = network(given)
        return found.log_depth, found.log_scale, found.normal

    search = RecordedSearch(work)
    given = [views(k, seed, "cuda") for seed, k in enumerate((2, 3, 2, 3, 1, 2))]
    with torch.no_grad():
        found = [search(v) for v in given]  # none of them is overwritten by a later one
        for one, v in zip(found, given, strict=True):
            for a, b in zip(one, work(v), strict=True):
                torch.testing.assert_close(a, b, rtol=1e-2, atol=1e-3)
    assert not torch.equal(found[0][0], found[2][0])
