"""Compiled loops over the rays of a rotating camera; they release the interpreter lock.

Rows of frames are rectified in parallel to tracking. Hundreds of NumPy calls a frame, each of which
may release the lock and wait for it again, would take longer than their arithmetic. Arrays are
written by element: products, rows and sums of NumPy take numba seconds to compile.
"""

import numpy as np
from numba import njit

_EXACT = {"cache": True, "nogil": True, "error_model": "numpy"}
_SMALL = 1e-4
"""Radians below which sine and cosine are taken from their series, exact to 1e-16 there."""


@njit(**_EXACT)
def turn(vectors, by, out):
    """Rotate each vector (n, 3) by its own rotation vector (n, 3), into ``out``.

    Source: Rodrigues' formula.
    """
    for n in range(len(vectors)):
        a, b, c = by[n, 0], by[n, 1], by[n, 2]
        x, y, z = vectors[n, 0], vectors[n, 1], vectors[n, 2]
        square = a * a + b * b + c * c
        angle = np.sqrt(square)
        if angle > _SMALL:
            sine = np.sin(angle) / angle
            cosine = 2.0 * (np.sin(0.5 * angle) / angle) ** 2
        else:
            sine = 1.0 - square / 6.0
            cosine = 0.5 - square / 24.0
        ox, oy, oz = b * z - c * y, c * x - a * z, a * y - b * x
        out[n, 0] = x + sine * ox + cosine * (b * oz - c * oy)
        out[n, 1] = y + sine * oy + cosine * (c * ox - a * oz)
        out[n, 2] = z + sine * oz + cosine * (a * oy - b * ox)


@njit(**_EXACT)
def nearest_turn(matrix):
    """Replace a matrix (3, 3) by the nearest rotation; return whether its determinant is positive.

    Source: the polar decomposition by Newton's iteration (Higham 1986).
    """
    other = np.empty((3, 3))
    largest = 0.0
    for i in range(3):
        for j in range(3):
            largest = max(largest, abs(matrix[i, j]))
    for _ in range(30):  # ten are usual
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            for m in range(3):
                n = (m + 1) % 3
                o = (m + 2) % 3
                other[i, m] = matrix[j, n] * matrix[k, o] - matrix[j, o] * matrix[k, n]
        determinant = 0.0
        for i in range(3):
            determinant += matrix[0, i] * other[0, i]
        if not determinant > 1e-15 * largest**3:
            return False
        scale = np.sqrt(np.sqrt((other * other).sum() / (matrix * matrix).sum()) / determinant)
        change = 0.0
        for i in range(3):
            for j in range(3):
                new = 0.5 * (scale * matrix[i, j] + other[i, j] / (scale * determinant))
                change = max(change, abs(new - matrix[i, j]))
                matrix[i, j] = new
        largest = 1.0
        if change < 1e-14:
            break
    return True


@njit(**_EXACT)
def turning_between(first, second, first_time, second_time, inside, interval, tolerance, rounds):
    """Estimate the rotation rate between two images that most rays agree on.

    Args:
        first, second: rays (n, 3) in either camera.
        first_time, second_time: seconds (n) from the middle row of its image to that of a ray.
        inside: 1 for rays that count, 0 for others (n).
        interval: seconds between the middle rows.
        tolerance: radians at which a ray loses half of its weight.
        rounds: number of reweightings.

    Returns:
        the rate (3), radians per second, and the residual of each ray (n), radians.
    """
    rate = np.zeros(3)
    moment = np.empty((3, 3))
    weight = inside.copy()
    a = np.empty_like(first)
    b = np.empty_like(second)
    error = np.empty_like(weight)
    first_turn = np.empty_like(first)
    second_turn = np.empty_like(second)
    for _ in range(rounds):
        for n in range(len(weight)):
            for i in range(3):
                first_turn[n, i] = -first_time[n] * rate[i]
                second_turn[n, i] = -second_time[n] * rate[i]
        turn(first, first_turn, a)
        turn(second, second_turn, b)
        for i in range(3):
            for j in range(3):
                moment[i, j] = 0.0
                for n in range(len(weight)):
                    moment[i, j] += weight[n] * b[n, i] * a[n, j]
        if not nearest_turn(moment):
            error[:] = np.inf
            break
        x, y = moment[2, 1] - moment[1, 2], moment[0, 2] - moment[2, 0]
        z = moment[1, 0] - moment[0, 1]
        sine = np.sqrt(x * x + y * y + z * z)
        cosine = moment[0, 0] + moment[1, 1] + moment[2, 2] - 1.0
        factor = np.arctan2(sine, cosine) / sine if sine > 1e-12 else 0.5
        factor /= interval
        rate[0] = factor * x
        rate[1] = factor * y
        rate[2] = factor * z
        for n in range(len(error)):
            square = 0.0
            for i in range(3):
                turned = 0.0
                for j in range(3):
                    turned += moment[i, j] * a[n, j]
                square += (b[n, i] - turned) ** 2
            error[n] = np.sqrt(square)
            weight[n] = inside[n] / (1.0 + square / (tolerance * tolerance))
    return rate, error
