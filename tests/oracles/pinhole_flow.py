"""The term of dense flow through a pinhole, in plain PyTorch: what compiled loops are held to."""

from collections.abc import Iterator

import torch
from jaxtyping import Float
from torch import Tensor

from geogs.bundle.flow_term import SourceFlow, damped_curvature, normal_equations, weighed_residuals
from geogs.bundle.hyper_edge import DepthEquations, RelativeEdges
from geogs.bundle.problem import BundleProblem, sources_within
from geogs.bundle.projection import linearise, project, relative_motion
from geogs.bundle.protocols import BundleOptions
from geogs.bundle.terms import BundleState
from geogs.geometry.camera import Camera
from geogs.geometry.lie import se3_adjoint
from oracles.lens_reference import matched_cost


class PinholeFlow:
    """Dense flow of a pinhole camera that is known."""

    def __init__(self, camera: Camera, rays: Float[Tensor, "p 3"]) -> None:
        self.camera, self.rays = camera, rays

    def sources(
        self, problem: BundleProblem, state: BundleState, options: BundleOptions
    ) -> Iterator[SourceFlow]:
        """See the protocol."""
        i, j = problem.source, problem.target
        T_ji = relative_motion(state.T_cw, i, j)
        p = linearise(self.camera, self.rays, T_ji, state.inverse_depth[i])
        r, w = weighed_residuals(p, problem.pixels, problem.weight, options.huber)
        wJ = p.pose_jacobian * w.mT[:, None]
        H, v = normal_equations(wJ, p.pose_jacobian, r)
        coupling = (wJ * p.depth_jacobian.mT[:, None]).sum(2)
        curvature = (w * p.depth_jacobian.square()).sum(-1)
        depth_gradient = (w * p.depth_jacobian * r).sum(-1)
        adjoint = se3_adjoint(T_ji)
        for frame, e in sources_within(i):
            c = curvature[e].sum(0)
            depth = DepthEquations(
                coupling[e].flatten(0, 1),
                damped_curvature(c, options.depth_damping),
                depth_gradient[e].sum(0),
                c,
            )
            poses = torch.cat([j[e], j.new_tensor([frame])])
            block, g = torch.block_diag(*H[e]), v[e].reshape(-1)
            edges = RelativeEdges(poses, block, g, depth=depth, adjoint=adjoint[e])
            yield SourceFlow(frame, edges)

    def cost(self, problem: BundleProblem, state: BundleState, huber: float) -> float:
        """See the protocol."""
        i = problem.source
        T_ji = relative_motion(state.T_cw, i, problem.target)
        p = project(self.camera, self.rays, T_ji, state.inverse_depth[i])
        return matched_cost(p, problem.pixels, problem.weight, huber)

    def depths_after(
        self,
        problem: BundleProblem,
        state: BundleState,
        xi: Float[Tensor, "n 6"],
        options: BundleOptions,
    ) -> Iterator[tuple[int, DepthEquations]]:
        """Equations of the depths of each source after a step of the poses.

        The matches are linearised once more: sum_e w dp/dd (r - dp/dxi xi_rel).
        """
        i, j = problem.source, problem.target
        T_ji = relative_motion(state.T_cw, i, j)
        p = linearise(self.camera, self.rays, T_ji, state.inverse_depth[i])
        r, w = weighed_residuals(p, problem.pixels, problem.weight, options.huber)
        relative = (xi[j] - (se3_adjoint(T_ji) @ xi[i][..., None])[..., 0]).to(r)
        moved = (p.pose_jacobian * relative[:, :, None, None]).sum(1).mT
        curvature = (w * p.depth_jacobian.square()).sum(-1)
        gradient = (w * p.depth_jacobian * (r - moved)).sum(-1)
        for frame, e in sources_within(i):
            damped = damped_curvature(curvature[e].sum(0), options.depth_damping)
            yield frame, DepthEquations.alone(damped, gradient[e].sum(0))
