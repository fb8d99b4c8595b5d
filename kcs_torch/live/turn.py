"""The trunk's rotation from frame to frame: a 3 x 3 problem, in plain numbers, as small tensors cost calls only."""

from __future__ import annotations

import math

import torch
from torch import Tensor

__all__ = ["follow_rotation"]

Rows = list[list[float]]

LOW, HIGH = 0.9, 1.1
"""Bounds of the trunk's scale in a frame, over the body's."""

SETTLED = 1e-4
"""Turn in radians after which no further step is taken."""


def follow_rotation(gram: Tensor, moment: Tensor, start: Tensor, *, num_steps: int) -> Tensor:
    """Turn R to minimise sum_n w_n |y_n - s (R x_n)_xy|^2 over R and LOW <= s <= HIGH, by Levenberg-Marquardt.

    The step is that of :func:`kcs_torch.solvers.pose.fit_cameras`: with G = R gram R^T and M = R moment^T a turn w of
    the camera's axes has the normal matrix and gradient that are sums of their entries.

    Args:
        gram: x^T W x (3, 3), symmetric.
        moment: y^T W x (2, 3).
        start: R (3, 3).
        num_steps: steps.

    Returns:
        R (3, 3).
    """
    rows: Rows = start.tolist()
    spread: Rows = gram.tolist()
    seen: Rows = moment.tolist()
    cost, scale, g, m = _evaluate(rows, spread, seen)
    damping = 1e-3
    for _ in range(num_steps):
        a = scale * scale
        flat, deep = a * (g[0][0] + g[1][1]), a * g[2][2]
        zx, zy = -a * g[0][2], -a * g[1][2]
        free = 1 / flat if LOW < scale < HIGH and flat > 0 else 0.0
        # the normal matrix less the scale's share (variable projection), and the ridge
        xx, yy, xy = deep - zy * zy * free, deep - zx * zx * free, zx * zy * free
        ridge = (damping + 1e-9) * max(xx, yy, flat) + 1e-300
        xx, yy, zz = xx + ridge, yy + ridge, flat + ridge
        off = [[m[i][k] - scale * g[i][k] for k in (0, 1)] for i in range(3)]
        goal = [-scale * off[2][1], scale * off[2][0], scale * (off[0][1] - off[1][0])]
        turn = _solve(xx, xy, zx, yy, zy, zz, goal)
        trial = _turned(rows, turn)
        tried = _evaluate(trial, spread, seen)
        if tried[0] < cost:
            rows, (cost, scale, g, m) = trial, tried
            damping *= 0.3
            if sum(w * w for w in turn) < SETTLED**2:
                break
        else:
            damping *= 5
    return torch.tensor(rows, dtype=torch.float64)


def _evaluate(rows: Rows, gram: Rows, moment: Rows) -> tuple[float, float, Rows, Rows]:
    """Cost (less a constant), the best scale, G = R gram R^T and M = R moment^T (3, 2)."""
    half = [[sum(r[k] * gram[k][j] for k in range(3)) for j in range(3)] for r in rows]
    g = [[sum(h[k] * r[k] for k in range(3)) for r in rows] for h in half]
    m = [[sum(r[k] * y[k] for k in range(3)) for y in moment] for r in rows]
    match, size = m[0][0] + m[1][1], g[0][0] + g[1][1]
    scale = min(max(match / size, LOW), HIGH) if size > 0 else 1.0
    return scale * scale * size - 2 * scale * match, scale, g, m


def _solve(
    xx: float, xy: float, xz: float, yy: float, yz: float, zz: float, goal: list[float]
) -> tuple[float, float, float]:
    """Solution of a symmetric, positive definite 3 x 3 system."""
    a, b, c = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    d, e, f = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    whole = xx * a + xy * b + xz * c
    if not whole > 0:
        return 0.0, 0.0, 0.0
    x, y, z = goal
    return (a * x + b * y + c * z) / whole, (b * x + d * y + e * z) / whole, (c * x + e * y + f * z) / whole


def _turned(rows: Rows, turn: tuple[float, float, float]) -> Rows:
    """exp([w]x) R by the unit quaternion, so that rounding does not add up."""
    angle = math.sqrt(sum(w * w for w in turn))
    half = 0.5 * angle
    s = math.sin(half) / angle if angle > 1e-12 else 0.5
    q = math.cos(half), s * turn[0], s * turn[1], s * turn[2]
    w, x, y, z = q
    matrix = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return [[sum(t[k] * rows[k][j] for k in range(3)) for j in range(3)] for t in matrix]
