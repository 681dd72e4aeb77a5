"""SO(3), SE(3) and Sim(3) as batched matrices: exp, log, inverse, adjoint, retraction.

Elements are plain matrices, so composition is ``@`` and a batch is a leading dimension. Tangents
are ``[tau(3), phi(3)(, sigma(1))]``. Every function is differentiable everywhere, including zero,
and the logarithms are valid up to (not at) a half turn.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

Numbers = tuple[Tensor, Tensor, Tensor]
"""Factors of I, K and K^2."""


class TranslationMap:
    """V with translation = V tau: the integral of exp(s (sigma I + K)) over s in [0, 1], K the
    cross product with phi.

    As K^3 = -theta^2 K, all such matrices are a I + b K + c K^2, stored as three numbers each.
    """

    def __init__(self, phi: Float[Tensor, "*b 3"], sigma: Float[Tensor, "*b"]) -> None:
        self._phi = phi
        self._square = phi.square().sum(-1)
        halvings = halvings_of((self._square.sqrt() + sigma.abs()).detach())
        zero = torch.zeros_like(sigma)
        one = torch.ones_like(sigma)
        h: Numbers = (sigma / 2**halvings, one / 2**halvings, zero)
        term: Numbers = (one, zero, zero)
        v: Numbers = (one, zero, zero)
        for k in range(2, 13):
            a, b, c = self._product(term, h)
            term = a / k, b / k, c / k
            v = v[0] + term[0], v[1] + term[1], v[2] + term[2]
        a, b, c = self._product(h, v)
        e: Numbers = (a + 1, b, c)
        for _ in range(halvings):
            a, b, c = self._product((e[0] + 1, e[1], e[2]), v)
            v = (a / 2, b / 2, c / 2)
            e = self._product(e, e)
        self._v = v

    def __matmul__(self, tau: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        """Return V tau."""
        return self._apply(self._v, tau)

    def solve(self, t: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        """Return V^-1 t."""
        a, b, c = self._v
        p = a - self._square * c
        determinant = p.square() + self._square * b.square()
        inverse = 1 / a, -b / determinant, (b.square() - c * p) / (a * determinant)
        return self._apply(inverse, t)

    def _product(self, x: Numbers, y: Numbers) -> Numbers:
        (a, b, c), (d, e, f) = x, y
        return (
            a * d,
            a * e + b * d - self._square * (b * f + c * e),
            a * f + c * d + b * e - self._square * (c * f),
        )

    def _apply(self, x: Numbers, tau: Tensor) -> Tensor:
        a, b, c = (k[..., None] for k in x)
        once = torch.linalg.cross(*torch.broadcast_tensors(self._phi, tau))
        twice = torch.linalg.cross(*torch.broadcast_tensors(self._phi, once))
        return a * tau + b * once + c * twice


def halvings_of(size: Tensor) -> int:
    """Return how often matrices of these sizes are halved before summing their series."""
    most = float(size.max()) if size.numel() else 0.0
    return max(0, math.ceil(math.log2(most / 0.5))) if 0.5 < most < math.inf else 0


def _is_small(x2: Tensor) -> Tensor:
    """Whether the closed forms lose digits at a squared angle, where a Taylor series takes over."""
    return x2 < (1e-4 if x2.dtype is torch.float64 else 1e-3)


def so3_hat(phi: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """The skew matrix with ``hat(a) b = a x b``."""
    x, y, z = phi.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack([o, -z, y, z, o, -x, -y, x, o], -1).unflatten(-1, (3, 3))


def _angle_series(t2: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """sin(t)/t, (1-cos t)/t^2 and (t-sin t)/t^3 from t^2."""
    small = _is_small(t2)
    safe = torch.where(small, torch.ones_like(t2), t2)
    t = safe.sqrt()
    a = torch.where(small, 1 - t2 / 6 * (1 - t2 / 20 * (1 - t2 / 42)), t.sin() / t)
    b = torch.where(small, 0.5 - t2 / 24 * (1 - t2 / 30 * (1 - t2 / 56)), (1 - t.cos()) / safe)
    c = torch.where(
        small, 1 / 6 - t2 / 120 * (1 - t2 / 42 * (1 - t2 / 72)), (t - t.sin()) / (safe * t)
    )
    return a, b, c


def so3_exp(phi: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Rotation by ``|phi|`` radians about ``phi`` (Rodrigues)."""
    a, b, _ = (x[..., None, None] for x in _angle_series((phi * phi).sum(-1)))
    k = so3_hat(phi)
    return torch.eye(3, dtype=phi.dtype, device=phi.device) + a * k + b * (k @ k)


def so3_log(rotation: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3"]:
    """Rotation vector in radians, norm at most pi; through the quaternion, stable near pi."""
    q = matrix_to_quaternion(rotation)
    w, v = q[..., 0], q[..., 1:]
    n2 = (v * v).sum(-1)
    small = _is_small(n2)
    n = torch.where(small, torch.ones_like(n2), n2).sqrt()
    far = 2 * torch.atan2(n, w) / n
    # 2 asin(n)/n with |q| = 1, so that the series needs only n^2.
    near = 2 + n2 / 3 + 3 * n2 * n2 / 20 + 5 * n2**3 / 56
    return v * torch.where(small, near, far)[..., None]


def _left_jacobian(phi: Tensor) -> Tensor:
    _, b, c = (x[..., None, None] for x in _angle_series((phi * phi).sum(-1)))
    k = so3_hat(phi)
    return torch.eye(3, dtype=phi.dtype, device=phi.device) + b * k + c * (k @ k)


def _compose(linear: Tensor, translation: Tensor) -> Tensor:
    top = torch.cat([linear, translation[..., None]], -1)
    # Host values would have to wait for a GPU.
    row = pad(torch.ones_like(top[..., :1, :1]), (3, 0))
    return torch.cat([top, row], -2)


def se3_exp(xi: Float[Tensor, "*b 6"]) -> Float[Tensor, "*b 4 4"]:
    """Exponential map of SE(3); ``xi = [tau, phi]``."""
    tau, phi = xi.split(3, -1)
    return _compose(so3_exp(phi), (_left_jacobian(phi) @ tau[..., None])[..., 0])


def se3_log(T: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 6"]:
    """Logarithm of SE(3), the inverse of :func:`se3_exp` for angles below pi."""
    phi = so3_log(T[..., :3, :3])
    tau = torch.linalg.solve(_left_jacobian(phi), T[..., :3, 3:])[..., 0]
    return torch.cat([tau, phi], -1)


def se3_inverse(T: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 4 4"]:
    """Inverse of a rigid motion."""
    Rt = T[..., :3, :3].mT
    return _compose(Rt, -(Rt @ T[..., :3, 3:])[..., 0])


def scaled(T: Float[Tensor, "*b 4 4"], factor: float) -> Float[Tensor, "*b 4 4"]:
    """The pose with its translation multiplied by ``factor``."""
    out = T.clone()
    out[..., :3, 3] *= factor
    return out


def se3_adjoint(T: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 6 6"]:
    """``Ad`` with ``T Exp(xi) T^-1 = Exp(Ad xi)``."""
    R = T[..., :3, :3]
    tR = so3_hat(T[..., :3, 3]) @ R
    return torch.cat([torch.cat([R, tR], -1), pad(R, (3, 0))], -2)


def _integral_of_exponential(M: Tensor) -> Tensor:
    """V(M) = sum M^k / (k+1)!, the integral of exp(s M) over s in [0, 1].

    M is halved until it is small, then the series is summed, then V is doubled again:
    V(2 M) = (I + exp(M)) V(M) / 2.
    """
    eye = torch.eye(M.shape[-1], dtype=M.dtype, device=M.device)
    halvings = halvings_of(M.detach().abs().sum(-1))
    h = M / 2**halvings
    term = eye.expand_as(M)
    v = eye.expand_as(M)
    for k in range(2, 13):
        term = term @ h / k
        v = v + term
    if halvings:
        e = eye + h @ v
        for _ in range(halvings):
            v = (eye + e) @ v / 2
            e = e @ e
    return v


def sim3_exp(xi: Float[Tensor, "*b 7"]) -> Float[Tensor, "*b 4 4"]:
    """Exponential map of Sim(3), ``xi = [tau, phi, sigma]``; the linear part is ``e^sigma R``."""
    tau, phi, sigma = xi.split([3, 3, 1], -1)
    linear = sigma.exp()[..., None] * so3_exp(phi)
    return _compose(linear, TranslationMap(phi, sigma[..., 0]) @ tau)


def sim3_scale(S: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b"]:
    """The scale of a similarity."""
    return torch.linalg.det(S[..., :3, :3]).pow(1 / 3)


def sim3_log(S: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 7"]:
    """Logarithm of Sim(3), the inverse of :func:`sim3_exp` for angles below pi."""
    s = sim3_scale(S)
    phi = so3_log(S[..., :3, :3] / s[..., None, None])
    sigma = s.log()
    tau = TranslationMap(phi, sigma).solve(S[..., :3, 3])
    return torch.cat([tau, phi, sigma[..., None]], -1)


def sim3_inverse(S: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 4 4"]:
    """Inverse of a similarity."""
    inv = S[..., :3, :3].mT / sim3_scale(S)[..., None, None] ** 2
    return _compose(inv, -(inv @ S[..., :3, 3:])[..., 0])


def sim3_adjoint(S: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 7 7"]:
    """``Ad`` with ``S Exp(xi) S^-1 = Exp(Ad xi)``."""
    s, t = sim3_scale(S), S[..., :3, 3]
    R = S[..., :3, :3] / s[..., None, None]
    top = torch.cat([S[..., :3, :3], so3_hat(t) @ R, -t[..., None]], -1)
    last = pad(torch.ones_like(t[..., None, :1]), (6, 0))
    return torch.cat([top, pad(R, (3, 1)), last], -2)


def sim3_small_adjoint(xi: Float[Tensor, "*b 7"]) -> Float[Tensor, "*b 7 7"]:
    """``ad`` with ``Exp(ad(xi)) = Ad(Exp(xi))``: the bracket of Sim(3) as a matrix."""
    tau, phi, sigma = xi.split([3, 3, 1], -1)
    turn = so3_hat(phi)
    eye = torch.eye(3, dtype=xi.dtype, device=xi.device)
    top = torch.cat([sigma[..., None] * eye + turn, so3_hat(tau), -tau[..., None]], -1)
    return pad(torch.cat([top, pad(turn, (3, 1))], -2), (0, 0, 0, 1))


def sim3_left_jacobian(xi: Float[Tensor, "*b 7"]) -> Float[Tensor, "*b 7 7"]:
    """``J`` with ``Exp(xi + d) = Exp(J d) Exp(xi)`` to first order; of ``-xi`` it is the right one.

    J is the integral of exp(s ad(xi)) over s in [0, 1].
    """
    return _integral_of_exponential(sim3_small_adjoint(xi))


def sim3_inverse_jacobian(xi: Float[Tensor, "*b 7"]) -> Float[Tensor, "*b 7 7"]:
    """The inverse of :func:`sim3_left_jacobian`.

    Near zero, where most errors are, by its own series with Bernoulli numbers: a third of the work.
    """
    ad = sim3_small_adjoint(xi)
    # Up to this size of the adjoint eight terms of the series are exact to all digits.
    far = ad.detach().abs().sum(-1).amax(-1) > 0.25
    second = ad @ ad
    fourth = second @ second
    series = second / 12 - fourth / 720 + (second / 30240 - fourth / 1209600) @ fourth
    inverse = torch.eye(7, dtype=ad.dtype, device=ad.device) - ad / 2 + series
    if not bool(far.any()):
        return inverse
    inverse = inverse.clone()
    inverse[far] = torch.linalg.inv(_integral_of_exponential(ad[far]))
    return inverse


def se3_left_jacobian(xi: Float[Tensor, "*b 6"]) -> Float[Tensor, "*b 6 6"]:
    """``J`` with ``Exp(xi + d) = Exp(J d) Exp(xi)`` to first order, of rigid motions."""
    return sim3_left_jacobian(pad(xi, (0, 1)))[..., :6, :6]


def retract(xi: Float[Tensor, "*b k"], T: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 4 4"]:
    """Left retraction ``Exp(xi) T``; six numbers move an SE(3), seven a Sim(3)."""
    return (se3_exp(xi) if xi.shape[-1] == 6 else sim3_exp(xi)) @ T


def move(xi: Float[Tensor, "*b 6"], T: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 4 4"]:
    """Left retraction whose rotation is made orthonormal again.

    Inverses are taken by transposition, so rounding errors would otherwise feed on themselves.
    """
    T = retract(xi, T)
    R = quaternion_to_matrix(matrix_to_quaternion(T[..., :3, :3]))
    return torch.cat([torch.cat([R, T[..., :3, 3:]], -1), T[..., 3:, :]], -2)


def transform(
    T: Float[Tensor, "*b 4 4"], points: Float[Tensor, "*b n 3"]
) -> Float[Tensor, "*b n 3"]:
    """Apply a rigid motion or similarity to points."""
    return points @ T[..., :3, :3].mT + T[..., None, :3, 3]


def quaternion_to_matrix(q: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b 3 3"]:
    """Rotation of a quaternion ``w, x, y, z`` of any non-zero norm."""
    w, x, y, z = (q / q.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    ]
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def matrix_to_quaternion(R: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 4"]:
    """Unit quaternion ``w, x, y, z`` with ``w >= 0``; the largest component is solved for first."""
    m = R.flatten(-2).unbind(-1)
    # Each row is 4 q_k (w, x, y, z) for one pivot k.
    z, y, x = m[7] - m[5], m[2] - m[6], m[3] - m[1]
    p = m[1] + m[3]
    s = m[2] + m[6]
    t = m[5] + m[7]
    diagonal = [
        1 + m[0] + m[4] + m[8],
        1 + m[0] - m[4] - m[8],
        1 - m[0] + m[4] - m[8],
        1 - m[0] - m[4] + m[8],
    ]
    rows = torch.stack(
        [
            torch.stack([diagonal[0], z, y, x], -1),
            torch.stack([z, diagonal[1], p, s], -1),
            torch.stack([y, p, diagonal[2], t], -1),
            torch.stack([x, s, t, diagonal[3]], -1),
        ],
        -2,
    )
    pivot = torch.stack(diagonal, -1).argmax(-1)
    index = pivot[..., None, None].expand(*pivot.shape, 1, 4)
    q = torch.gather(rows, -2, index)[..., 0, :]
    q = q / q.norm(dim=-1, keepdim=True)
    return torch.where(q[..., :1] < 0, -q, q)


def quaternion_multiply(
    a: Float[Tensor, "*b 4"], b: Float[Tensor, "*b 4"]
) -> Float[Tensor, "*b 4"]:
    """Hamilton product ``a b`` of quaternions ``w, x, y, z`` (first b, then a)."""
    aw, av = a[..., :1], a[..., 1:]
    bw, bv = b[..., :1], b[..., 1:]
    vector = aw * bv + bw * av + torch.linalg.cross(av.expand_as(bv), bv)
    return torch.cat([aw * bw - (av * bv).sum(-1, keepdim=True), vector], -1)
