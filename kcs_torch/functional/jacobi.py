"""Eigenvectors of many small symmetric matrices at once on a GPU, by Jacobi rotations in a Triton kernel.

cuSOLVER takes matrices of up to 32 rows in batches and larger ones one after another, each of which leaves nearly the
whole device idle. Here every matrix has a thread block of its own. A round rotates n/2 disjoint pairs of rows and
columns, a sweep of n - 1 rounds meets every pair once (the circle method of tournaments), and sweeps repeat until
nothing is left beside the diagonal.

Eigenvalues of many orders of magnitude, as Gram matrices of smooth motion have, would take a sweep or more for each
order. So two steps of the QR algorithm go before, with the largest entries of the diagonal first: they part what is
large from what is small, and five sweeps do where there were fourteen.

Golub, Van Loan 2013, sections 5.2 (Householder QR), 8.3 (the QR algorithm), 8.5 (cyclic and parallel Jacobi).
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

__all__ = ["jacobi"]

SWEEPS = 30
"""At most so many. Some five are usual, and twenty if eigenvalues are repeated many times."""

SMALL = {torch.float32: 1e-5, torch.float64: 1e-12}
"""Size of what was beside the diagonal before a sweep, a share of the whole, after which no further sweep follows: each
leaves about the square of what it finds."""

STEPS = 2
"""Of the QR algorithm."""

TILES = {16: (16, 4), 32: (32, 8), 64: (32, 8)}
"""For up to so many pairs: how many have their columns rotated at once (a tile for each of a pair's four entries has to
fit into registers), and the warps of a thread block."""


def jacobi(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Return eigenvalues (K, n) in rising order, and eigenvectors (K, n, n) in columns.

    Args:
        matrix: (K, n, n), symmetric, on a GPU; n from 2 to 128. NaN and infinity lead to NaN.
    """
    size = matrix.shape[-1]
    peak = matrix.abs().amax((-2, -1), keepdim=True)  # first, so that no square overflows
    peak = torch.where(peak == 0, torch.ones_like(peak), peak)
    order = matrix.diagonal(dim1=-2, dim2=-1).argsort(-1, descending=True)
    turn = torch.eye(size, dtype=matrix.dtype, device=matrix.device)[order]  # (K, n, n), with eigenvectors in its rows
    work = turn @ (matrix / peak) @ turn.mT
    for _ in range(STEPS):
        step = _householder(work)
        turn, work = step @ turn, step @ work @ step.mT
        work = (work + work.mT) / 2
    values, rest = _rotate(work)
    values, order = values.sort(dim=-1)
    rows = rest.gather(1, order[..., None].expand_as(rest)) @ turn
    return values * peak[..., 0], rows.mT


def _householder(matrix: Tensor) -> Tensor:
    """The orthogonal Q^T (K, n, n) of the QR decomposition of (K, n, n).

    Of the reflections I - tau v v^T, which ``geqrf`` yields for many matrices at once, their product is
    Q = I - V W^-1 V^T with the triangle W of 1 / tau on and v_i . v_j above the diagonal.
    """
    packed, tau = torch.geqrf(matrix)
    eye = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
    moves = tau != 0
    vectors = (packed.tril(-1) + eye) * moves[:, None]
    inner = (vectors.mT @ vectors).triu(1) + torch.diag_embed(1 / torch.where(moves, tau, torch.ones_like(tau)))
    return eye - vectors @ torch.linalg.solve_triangular(inner.mT, vectors.mT, upper=False)


def _rotate(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Eigenvalues (K, n) of (K, n, n) in no order, and eigenvectors in rows."""
    count, size = matrix.shape[:2]
    even = size + size % 2  # a row of zeros for an odd one to be paired with: it is never turned
    work = matrix.new_zeros(count, even, even)
    work[:, :size, :size] = matrix
    vectors = torch.eye(even, dtype=matrix.dtype, device=matrix.device).expand(count, -1, -1).contiguous()
    half = max(16, triton.next_power_of_2(even // 2))
    turns = work.new_empty(count, 2, half)
    tile, warps = TILES[half]
    _sweeps[(count,)](
        work, vectors, turns, SMALL[matrix.dtype] ** 2, SWEEPS, n=even, HALF=half, TILE=tile, num_warps=warps
    )
    return work.diagonal(dim1=-2, dim2=-1)[:, :size], vectors[:, :size, :size]


@triton.jit
def _pairs(k, turn, n: tl.constexpr, COUNT: tl.constexpr):  # type: ignore[no-untyped-def]
    """The k-th pair of a round: the last one stays where it is, and the others go round.

    They are said to be in order, which they nearly are, so that neighbouring threads take neighbouring columns.
    """
    up = turn + k
    down = turn - k
    first = tl.where(k == 0, n - 1, tl.where(up < n - 1, up, up - (n - 1)))
    second = tl.where(down < 0, down + (n - 1), down)
    return tl.max_contiguous(first, COUNT), tl.max_contiguous(second, COUNT)


@triton.jit
def _sweeps(  # type: ignore[no-untyped-def]
    work, vectors, turns, small, sweeps, n: tl.constexpr, HALF: tl.constexpr, TILE: tl.constexpr
):  # fmt: skip
    """Diagonalise work[i] of program i in place; vectors[i] collects the rotations, turns[i] holds those of a round."""
    own = tl.program_id(0).to(tl.int64)
    work += own * n * n
    vectors += own * n * n
    turns += own * 2 * HALF
    k = tl.arange(0, HALF)
    live = k < n // 2
    row = k[:, None]
    whole = tl.zeros((), dtype=work.dtype.element_ty)
    for begin in range(0, n, TILE):
        column = begin + tl.arange(0, TILE)[None, :]
        for top in range(0, n, HALF):
            inside = (top + row < n) & (column < n)
            part = tl.load(work + (top + row) * n + column, mask=inside, other=0.0)
            whole += tl.sum(tl.sum(part * part, axis=1), axis=0)
    made = 0
    beside = whole
    while (made < sweeps) & (beside > small * whole):
        made += 1
        found = tl.zeros((HALF,), dtype=work.dtype.element_ty)
        for turn in range(n - 1):
            p, q = _pairs(k, turn, n, HALF)
            app = tl.load(work + p * n + p, mask=live, other=0.0)
            aqq = tl.load(work + q * n + q, mask=live, other=0.0)
            apq = tl.load(work + p * n + q, mask=live, other=0.0)
            found += 2 * apq * apq
            apart = aqq - app
            sum_of = tl.abs(apart) + tl.sqrt(apart * apart + 4 * apq * apq)
            tangent = 2 * tl.where(apart < 0, -apq, apq) / tl.where(sum_of > 0, sum_of, 1.0)
            cos = 1 / tl.sqrt(1 + tangent * tangent)
            sin = tangent * cos
            tl.store(turns + k, cos)
            tl.store(turns + HALF + k, sin)
            tl.debug_barrier()  # from here on entries change that all threads have read
            cos = tl.load(turns + k)[:, None]
            sin = tl.load(turns + HALF + k)[:, None]
            p = p[:, None] * n
            q = q[:, None] * n
            for begin in range(0, n // 2, TILE):
                j = begin + tl.arange(0, TILE)
                inside = live[:, None] & (j < n // 2)[None, :]
                pj, qj = _pairs(j, turn, n, TILE)
                pj = pj[None, :]
                qj = qj[None, :]
                c = tl.load(turns + j)[None, :]
                s = tl.load(turns + HALF + j)[None, :]
                pp = tl.load(work + p + pj, mask=inside, other=0.0)
                pq = tl.load(work + p + qj, mask=inside, other=0.0)
                qp = tl.load(work + q + pj, mask=inside, other=0.0)
                qq = tl.load(work + q + qj, mask=inside, other=0.0)
                up = cos * pp - sin * qp
                uq = cos * pq - sin * qq
                lp = sin * pp + cos * qp
                lq = sin * pq + cos * qq
                tl.store(work + p + pj, up * c - uq * s, mask=inside)
                tl.store(work + p + qj, up * s + uq * c, mask=inside)
                tl.store(work + q + pj, lp * c - lq * s, mask=inside)
                tl.store(work + q + qj, lp * s + lq * c, mask=inside)
            for begin in range(0, n, TILE):
                column = begin + tl.arange(0, TILE)[None, :]
                inside = live[:, None] & (column < n)
                upper = tl.load(vectors + p + column, mask=inside, other=0.0)
                lower = tl.load(vectors + q + column, mask=inside, other=0.0)
                tl.store(vectors + p + column, cos * upper - sin * lower, mask=inside)
                tl.store(vectors + q + column, sin * upper + cos * lower, mask=inside)
            tl.debug_barrier()
        beside = tl.sum(found, axis=0)
