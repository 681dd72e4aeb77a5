"""Dense bundle adjustment that gradients pass through, for a batch of clips at once.

The same Gauss-Newton steps as :mod:`geogs.bundle.dense`, without its robust weights: depths are
eliminated, the small camera systems are solved in float64, poses move by left retraction. All of it
is plain autograd, so that a network can be taught what measurements and weights make the
adjusted poses and depths right (Teed and Deng, "DROID-SLAM", NeurIPS 2021, section 3.2).

The edges of all clips are the same. Positions may be in pixels or in cells, if only intrinsics,
positions and weights agree. Projection and the derivatives of points are the tracker's. Its
hyper-edges are not used: made one by one they would give autograd a graph each, where here the
sources of all clips are eliminated at once; nor its robust weights, since the network gives the
weights.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from geogs.bundle.projection import CellProjection, motion_rows, relative_motion, seen_from_targets
from geogs.geometry.least_squares import Policy, Step, minimise
from geogs.geometry.lie import retract, se3_adjoint


@dataclass(frozen=True)
class ClipCameras:
    """The pinhole camera of each clip, and where in its images inverse depth is kept."""

    intrinsics: Float[Tensor, "b 4"]
    """fx, fy, cx, cy."""
    cells: Float[Tensor, "p 2"]
    """x, y."""

    @property
    def focal_and_centre(self) -> tuple[Float[Tensor, "b 1 1 2"], Float[Tensor, "b 1 1 2"]]:
        """For numbers of each edge and cell."""
        focal, centre = self.intrinsics[:, None, None].split(2, -1)
        return focal, centre

    @property
    def rays(self) -> Float[Tensor, "b p 3"]:
        """K^-1 (x, y, 1) of every cell."""
        focal, centre = self.focal_and_centre
        xy = (self.cells - centre[:, 0]) / focal[:, 0]
        return torch.cat([xy, torch.ones_like(xy[..., :1])], -1)


@dataclass(frozen=True)
class ClipEdges:
    """Which view of a clip is measured in which other; the same for every clip."""

    source: Int[Tensor, "e"]
    target: Int[Tensor, "e"]


@dataclass(frozen=True)
class ClipState:
    """What is adjusted."""

    T_cw: Float[Tensor, "b v 4 4"]
    """World to camera."""
    inverse_depth: Float[Tensor, "b v p"]

    def detach(self) -> "ClipState":
        """The same numbers without a past."""
        return ClipState(self.T_cw.detach(), self.inverse_depth.detach())


@dataclass(frozen=True)
class ClipMatches:
    """What was measured."""

    pixels: Float[Tensor, "b e p 2"]
    """Position in the target of every cell of the source."""
    weight: Float[Tensor, "b e p 2"]
    """Inverse variance of x and y."""


@dataclass(frozen=True)
class ClipBundleOptions:
    """How a batch is adjusted; the defaults are DROID-SLAM's, for positions in cells."""

    iterations: int = 2
    fixed_poses: int = 2
    """Leading views that stay where they are. Two set the scale."""
    damping: float = 1e-4
    """Levenberg damping relative to the diagonal of the reduced system."""
    damping_floor: float = 0.1
    """Added to that diagonal."""
    depth_damping: float = 0.0
    """Damping of inverse depth relative to the mean curvature of its view."""
    depth_floor: float = 1e-7
    """Added to the curvature of inverse depth."""
    min_inverse_depth: float = 1e-3
    max_inverse_depth: float = 1e2


@dataclass(frozen=True)
class _System:
    """Normal equations of one step; depths are diagonal."""

    hessian: Float[Tensor, "b n n"]
    """Between the free poses, float64."""
    gradient: Float[Tensor, "b n"]
    coupling: Float[Tensor, "b n q"]
    """Between free poses and all inverse depths."""
    curvature: Float[Tensor, "b q"]
    depth_gradient: Float[Tensor, "b q"]


def relative_motions(T_cw: Float[Tensor, "b v 4 4"], edges: ClipEdges) -> Float[Tensor, "b e 4 4"]:
    """T_ji = T_j T_i^-1 of every edge i -> j."""
    return relative_motion(T_cw, edges.source, edges.target)


def reproject(cameras: ClipCameras, state: ClipState, edges: ClipEdges) -> CellProjection:
    """Where the cells of every edge's source fall in its target."""
    T, d = relative_motions(state.T_cw, edges), state.inverse_depth[:, edges.source]
    y, valid, z = seen_from_targets(cameras.rays[:, None], T, d)
    focal, centre = cameras.focal_and_centre
    return CellProjection(focal * y[..., :2] / z[..., None] + centre, valid, z)


def adjust(
    cameras: ClipCameras,
    state: ClipState,
    edges: ClipEdges,
    matches: ClipMatches,
    options: ClipBundleOptions | None = None,
) -> ClipState:
    """Take ``options.iterations`` damped Gauss-Newton steps from a state.

    Differentiable in the state and the matches. A clip whose camera system cannot be solved keeps
    its poses in that step.
    """
    options = options or ClipBundleOptions()

    def linearised(state: ClipState) -> _System:
        return _normal_equations(cameras, state, edges, matches, options)

    def step(state: ClipState, system: _System, damping: float) -> Step[ClipState]:
        """A clip that cannot be solved does not end the steps of the others."""
        return Step(_moved(state, *_solve(system, damping, options.damping_floor), options))

    policy = Policy(options.iterations, options.damping)
    return minimise(state, linearised, step, policy).state


def _jacobians(
    cameras: ClipCameras, p: CellProjection, state: ClipState, edges: ClipEdges
) -> tuple[Float[Tensor, "b e 6 2 p"], Float[Tensor, "b e p 2"], Float[Tensor, "b e 6 6"]]:
    """d pixel / d xi of T_ji (left perturbation), d pixel / d inverse depth; Ad of T_ji."""
    d = state.inverse_depth[:, edges.source]
    T = relative_motions(state.T_cw, edges)
    focal, centre = cameras.focal_and_centre
    x, y = ((p.pixels - centre) / focal).unbind(-1)
    q = 1 / p.z
    rows = torch.stack(motion_rows(x, y, d * q), 3)
    tx, ty, tz = T[..., None, :3, 3].to(d).unbind(-1)
    depth = focal * torch.stack([(tx - tz * x) * q, (ty - tz * y) * q], -1)
    return rows * focal[..., None], depth, se3_adjoint(T)


def _normal_equations(
    cameras: ClipCameras,
    state: ClipState,
    edges: ClipEdges,
    matches: ClipMatches,
    options: ClipBundleOptions,
) -> _System:
    projection = reproject(cameras, state, edges)
    J, J_depth, adjoint = _jacobians(cameras, projection, state, edges)
    residual = matches.pixels - projection.pixels
    weight = matches.weight * projection.valid[..., None]
    wJ = J * weight.mT[:, :, None]
    # An edge is linearised in its relative motion, xi_rel = xi_target - Ad xi_source.
    block = (wJ.flatten(3) @ J.flatten(3).mT).double()
    right = (wJ * residual.mT[:, :, None]).sum((3, 4)).double()[..., None]
    joint = (wJ * J_depth.mT[:, :, None]).sum(3)
    A = -adjoint.double()
    views = state.inverse_depth.shape[1]
    i, j = edges.source, edges.target
    hessian = _summed(
        views * views,
        (views * j + j, block),
        (views * j + i, block @ A),
        (views * i + j, A.mT @ block),
        (views * i + i, A.mT @ block @ A),
    )
    gradient = _summed(views, (j, right), (i, A.mT @ right))
    coupling = _summed(
        views * views, (views * j + i, joint), (views * i + i, A.mT.to(joint) @ joint)
    )
    curvature = _summed(views, (i, (weight * J_depth.square()).sum(-1)))
    depth_gradient = _summed(views, (i, (weight * J_depth * residual).sum(-1)))
    mean = curvature.mean(-1, keepdim=True)
    curvature = curvature + options.depth_damping * mean + options.depth_floor
    free = slice(6 * options.fixed_poses, None)
    square = hessian.unflatten(1, (views, views)).transpose(2, 3).flatten(3).flatten(1, 2)
    wide = coupling.unflatten(1, (views, views)).transpose(2, 3).flatten(3).flatten(1, 2)
    return _System(
        square[:, free, free],
        gradient.flatten(1)[:, free],
        wide[:, free],
        curvature.flatten(1),
        depth_gradient.flatten(1),
    )


def _summed(places: int, *parts: tuple[Tensor, Tensor]) -> Tensor:
    """Parts (b, e, ...) added up at the places (e,) they belong to: (b, places, ...)."""
    first = parts[0][1]
    total = first.new_zeros(len(first), places, *first.shape[2:])
    for place, part in parts:
        total = total.index_add(1, place, part)
    return total


def _solve(system: _System, damping: float, floor: float) -> tuple[Tensor, Tensor]:
    """Steps of the free poses (b, n), float64, and of all inverse depths (b, q)."""
    scaled = system.coupling / system.curvature[:, None]
    S = system.hessian - (scaled @ system.coupling.mT).double()
    right = system.gradient - (scaled @ system.depth_gradient[..., None])[..., 0].double()
    diagonal = S.diagonal(dim1=1, dim2=2).abs()
    S = S + torch.diag_embed(damping * diagonal + floor)
    _, info = torch.linalg.cholesky_ex(S.detach())
    good = (info == 0) & torch.isfinite(S).all((1, 2)) & torch.isfinite(right).all(1)
    eye = torch.eye(S.shape[1], dtype=S.dtype, device=S.device)
    S = torch.where(good[:, None, None], S, eye)
    right = torch.where(good[:, None], right, 0.0)
    xi = torch.cholesky_solve(right[..., None], torch.linalg.cholesky(S))
    moved = system.coupling.mT @ xi.to(system.coupling)
    return xi[..., 0], (system.depth_gradient - moved[..., 0]) / system.curvature


def _moved(state: ClipState, xi: Tensor, delta: Tensor, options: ClipBundleOptions) -> ClipState:
    fixed = options.fixed_poses
    T, d = state.T_cw, state.inverse_depth
    free = retract(xi.unflatten(1, (-1, 6)).to(T), T[:, fixed:])
    d = (d + delta.view_as(d)).clamp(options.min_inverse_depth, options.max_inverse_depth)
    return ClipState(torch.cat([T[:, :fixed], free], 1), d)
