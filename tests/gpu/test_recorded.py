"""Work as a recording says the same as the work itself, for tensors of any sizes."""

import threading

import pytest
import torch

from geogs.depth.network.model import DepthNetwork
from geogs.depth.network.network_sizes import DepthNetworkOptions
from geogs.depth.network.stereo_views import StereoViews
from geogs.gpu.recorded import Recorded

SMALL = DepthNetworkOptions(
    encoder=(8, 8, 8), matching=8, groups=4, metadata=8, planes=8, context=(8, 8, 8, 8, 8),
    volume=(8, 8, 8, 8), decoder=8,
)  # fmt: skip

needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")


def views(neighbours: int, seed: int, device: str) -> StereoViews:
    random = torch.Generator().manual_seed(seed)
    T = torch.eye(4).repeat(1, neighbours, 1, 1)
    T[..., :3, 3] = 0.2 * torch.randn(1, neighbours, 3, generator=random)
    lens = torch.tensor([[60.0, 60.0, 31.5, 31.5]])
    bounds = (torch.tensor([x]) for x in (0.5, 4.0, 1.5))
    made = (
        torch.rand(1, 3, 64, 64, generator=random),
        torch.rand(1, neighbours, 3, 64, 64, generator=random),
        lens,
        lens[:, None].expand(-1, neighbours, -1),
        T,
        torch.ones(1, neighbours, dtype=torch.bool),
        *bounds,
    )
    return StereoViews(*(values.to(device) for values in made))


def test_without_a_gpu_it_is_called_as_it_is():
    seen = []

    def work(*given: torch.Tensor) -> tuple[torch.Tensor, ...]:
        seen.append(given)
        return given[:1]

    recorded, given = Recorded(work, "The work"), tuple(vars(views(2, 0, "cpu")).values())
    assert recorded(*given)[0] is given[0]
    assert recorded(*given)[0] is given[0]
    assert len(seen) == 2
    assert all(a is b for a, b in zip(seen[0], given, strict=True))


@pytest.mark.gpu
@needs_gpu
def test_a_recording_says_the_same_for_other_views_and_other_numbers_of_neighbours():
    torch.manual_seed(0)
    network = DepthNetwork(SMALL).cuda().eval().requires_grad_(False)

    def work(*given: torch.Tensor) -> tuple[torch.Tensor, ...]:
        found = network(StereoViews(*given))
        return found.log_depth, found.log_scale, found.normal

    recorded = Recorded(work, "The network")
    given = [
        tuple(vars(views(k, seed, "cuda")).values()) for seed, k in enumerate((2, 3, 2, 3, 1, 2))
    ]
    with torch.no_grad():
        found = [recorded(*v) for v in given]  # none of them is overwritten by a later one
        for one, v in zip(found, given, strict=True):
            for a, b in zip(one, work(*v), strict=True):
                torch.testing.assert_close(a, b, rtol=1e-2, atol=1e-3)
    assert not torch.equal(found[0][0], found[2][0])


@pytest.mark.gpu
@needs_gpu
def test_threads_with_streams_of_their_own_may_share_a_recording():
    def work(x: torch.Tensor) -> tuple[torch.Tensor, ...]:
        for _ in range(20):
            x = x @ x / x.norm()
        return (x,)

    recorded = Recorded(work, "The work")
    given = [torch.rand(300, 300, device="cuda") for _ in range(60)]
    expected = [work(x)[0] for x in given]
    found: dict[int, torch.Tensor] = {}

    def run(first: int) -> None:
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.default_stream())
        with torch.cuda.stream(stream):
            for n in range(first, len(given), 3):
                found[n] = recorded(given[n])[0]
            stream.synchronize()

    threads = [threading.Thread(target=run, args=(k,)) for k in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for n, wanted in enumerate(expected):
        torch.testing.assert_close(found[n], wanted, rtol=1e-4, atol=1e-5)


@pytest.mark.gpu
@needs_gpu
def test_work_that_cannot_be_recorded_is_done_as_it_is(caplog):
    def work(x: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return (x * float(x.sum()),)  # a number of the host

    recorded = Recorded(work, "The work")
    x = torch.arange(4.0, device="cuda")
    for _ in range(2):
        torch.testing.assert_close(recorded(x)[0], 6 * x)
    assert "The work is slower than it could be" in caplog.text
    assert 0 <= torch.rand((), device="cuda").item() < 1  # its generator records no longer
