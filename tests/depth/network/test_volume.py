"""The network that rates planes, and its gradients, against one that PyTorch differentiates."""

import itertools

import torch

from geogs.depth.network.volume import rate_planes

B, C, D, P = 2, 6, 3, 10
VOXEL, PIXEL, PLANE, WIDTH = 2, 3, 4, 5


def inputs() -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    rng = torch.Generator().manual_seed(3)

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=rng, dtype=torch.float64)

    given = [draw(B, C, P), draw(B, C, D, P), draw(B, VOXEL, D, P), draw(B, PIXEL, P)]
    sizes = [C + VOXEL + PIXEL + PLANE, WIDTH, WIDTH, 2]
    layers = [draw(*s) for i, o in itertools.pairwise(sizes) for s in ((o, i), (o,))]
    return [*given, draw(B, D, PLANE)], layers


def slow(given: list[torch.Tensor], layers: list[torch.Tensor]) -> torch.Tensor:
    """Voxel by voxel."""
    own, found, voxel, pixel, plane = given
    rows = []
    for b in range(B):
        for d in range(D):
            for p in range(P):
                numbers = (own[b, :, p] * found[b, :, d, p], voxel[b, :, d, p], pixel[b, :, p])
                x = torch.cat([*numbers, plane[b, d]])
                for n in range(0, 6, 2):
                    x = layers[n] @ x + layers[n + 1]
                    x = x.relu() if n < 4 else x
                rows.append(x)
    return torch.stack(rows).view(B, D, P, 2).movedim(-1, 1)


def test_ratings_and_their_gradients_are_those_of_single_voxels():
    given, layers = inputs()
    weights = torch.randn(B, 2, D, P, dtype=torch.float64)
    learning = [given[0], given[1], given[3], *layers]
    for x in learning:
        x.requires_grad_()
    right = slow(given, layers)
    fast = rate_planes(*given, layers)
    torch.testing.assert_close(fast.double(), right, atol=1e-5, rtol=1e-5)
    expected = torch.autograd.grad((right * weights).sum(), learning)
    found = torch.autograd.grad((fast * weights).sum(), learning)
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, atol=1e-5, rtol=1e-5)
