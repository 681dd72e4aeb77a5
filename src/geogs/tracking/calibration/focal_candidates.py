"""Initial focal length: several lenses tried on the same flows from one keyframe.

Flow needs no focal length, so it is measured once. For every candidate the keyframes are located by
the essential matrix and PnP and adjusted together with the focal length, and at last the
distortion: for a distorted lens pinholes of all focal lengths fit about equally badly, and the
adjustment may not get from any of them to barrel distortion, which is tried separately. The least
cost, with a penalty on distortion, wins.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.device_choice import grid_fields
from geogs.bundle.lens import LensBlock
from geogs.bundle.problem import BundleProblem
from geogs.bundle.shared import OPTIONS, SharedResult, solve_shared
from geogs.camera.distortion import USUAL_BEND
from geogs.geometry.camera import Camera
from geogs.tracking.calibration.unknowns import Unknowns
from geogs.tracking.matching.pnp import pnp
from geogs.tracking.matching.two_view import best_two_view, without
from geogs.types import FlowMatch
from geogs.world.grid import SampleGrid

FIELDS_OF_VIEW = (50.0, 70.0, 95.0)
"""Candidate fields of view besides the guess, degrees along the longer side."""
BEND_COST = 0.002
"""Penalty of a distortion of one prior deviation. Errors of matches are correlated, so costs that
differ by a few per cent mean little: above half of this the wrong minimum of a rotation loses."""
_STAGES = (30.0, 10), (10.0, 10), (3.0, 30)
"""Huber threshold and most steps of each stage. The last has many, as a long valley leads from a
pinhole to the lens; if it stops there, the wrong candidate may win."""


@dataclass(frozen=True)
class Start:
    """Keyframes located with one candidate; on the CPU."""

    lens: Camera
    T_cw: Float[Tensor, "n 4 4"]
    inverse_depth: Float[Tensor, "p"]
    """Inverse depth of the first keyframe's cells."""
    information: Float[Tensor, "p"]
    cost: float

    @property
    def penalised(self) -> float:
        """Cost with the prior on distortion: of two minima that fit a rotation about equally it
        selects the one with a plausible lens."""
        bends = zip((self.lens.k1, self.lens.k2), USUAL_BEND, strict=True)
        return self.cost + BEND_COST * sum((k / usual) ** 2 for k, usual in bends)


def candidates(camera: Camera, unknowns: Unknowns) -> list[Camera]:
    """Return the guess and, if it is uncertain, pinholes and barrels of other fields of view."""
    if not unknowns.focal:
        return [camera]
    guess = camera.with_focal(camera.fx)
    pinholes = [guess, *map(camera.with_field_of_view, FIELDS_OF_VIEW)]
    if not unknowns.radial:
        return pinholes
    # A typical wide-angle lens sees 70 degrees, with these k1 and k2.
    wide = [guess, camera.with_field_of_view(70.0)]
    return [*pinholes, *(c.moved(0.0, -0.2, 0.03) for c in wide)]


def try_candidate(
    lens: Camera, flows: list[FlowMatch], min_parallax: float, unknowns: Unknowns
) -> Start | None:
    """Locate the keyframes with the pinhole of a lens and adjust them, at last with k1 and k2 if
    these are unknown; None if there is no parallax."""
    camera = lens.pinhole
    flows = [f.on_cpu() for f in flows]
    grid = SampleGrid(camera)
    found = best_two_view(camera, flows[1::2], min_parallax)
    if found is None:
        return None
    best = 1 + 2 * found[0]
    view = found[1]
    flows = [without(f, view.apart) for f in flows]
    depth = grid_fields(grid).fill(view.inverse_depth, view.good.float())
    poses = [torch.eye(4, dtype=torch.float64)]
    for n, match in enumerate(flows):
        T: Tensor | None = view.T_ji
        if n != best:
            T = pnp(grid, depth, match.pixels[0], view.good & match.sure()[0])
        poses.append(poses[-1] if T is None else T)
    n = len(flows) + 1
    rows = torch.cat([depth[None], torch.ones(n - 1, grid.size)])
    problem = BundleProblem(
        torch.stack(poses),
        rows,
        torch.zeros(n - 1, dtype=torch.long),
        torch.arange(1, n),
        torch.arange(n) > 0,
        torch.ones(n, dtype=torch.bool),
        pixels=torch.cat([f.pixels for f in flows]),
        weight=torch.cat([f.weight for f in flows]),
    )
    result = _adjusted(problem, LensBlock(lens, grid.pixels, unknowns.focal), unknowns.radial)
    if result is None:
        return None
    return Start(
        result.block.lens, result.T_cw, result.inverse_depth[0], result.information[0], result.cost
    )


def _adjusted(problem: BundleProblem, block: LensBlock, radial: bool) -> SharedResult | None:
    """Adjust the problem from tolerant to strict, at the end with k1 and k2 if ``radial``."""
    result = None
    for huber, steps in _STAGES:
        block = replace(block, radial=radial and huber == _STAGES[-1][0])
        result = solve_shared(problem, block, replace(OPTIONS, iterations=steps, huber=huber))
        if not result.finite:
            return None
        block = result.block
        problem = replace(problem, T_cw=result.T_cw, inverse_depth=result.inverse_depth)
    return result
