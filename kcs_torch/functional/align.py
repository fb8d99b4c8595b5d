"""Alignment of point sets: Procrustes rotations with batch dimensions (Kabsch 1976, Umeyama 1991)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from kcs_torch.errors import OptionError, ShapeError, unknown
from kcs_torch.functional.derivatives import Once, applied, batch_first
from kcs_torch.functional.guarded import LOST, largest, or_one, unit_size
from kcs_torch.functional.precision import alike, full_precision, wide
from kcs_torch.functional.rotation import skew
from kcs_torch.functional.shapes import check_batches, check_core, check_floats

__all__ = ["ALIGNMENTS", "centre", "minimal_turn", "nearest_rotation", "procrustes", "superpose"]

ALIGNMENTS = {
    "none": "as it stands",
    "root": "the root joint of each frame moved onto the true one",
    "scale": "the root joint of each frame moved onto the true one, and each frame scaled about it, never mirrored",
    "rigid": "each frame moved and turned, not scaled",
    "similarity": "each frame moved, turned and scaled (Procrustes)",
    "sequence": "each frame moved; all frames turned and scaled by the same (Procrustes over the clip)",
}
"""What each alignment of a motion with the truth does, by name."""


def check_alignment(how: str, root: int | None = None) -> None:
    """Raise an OptionError unless ``how`` names an alignment, and ``root`` is an index or None."""
    if not isinstance(how, str) or how not in ALIGNMENTS:
        raise unknown("alignment", how, ALIGNMENTS)
    if root is not None and (isinstance(root, bool) or not isinstance(root, int)):
        raise OptionError(f"root: expected the index of a joint, as skeleton.index('pelvis') gives, got {root!r}")


def centre(points: Tensor, weights: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Subtract the weighted mean over joints.

    Args:
        points: (..., N, D), finite.
        weights: (..., N), 0 or less where a joint does not count; all 1 where None. All-zero weights give the mean 0.

    Returns:
        centred points (..., N, D) and the mean (..., 1, D).

    Raises:
        ShapeError: they are not of these shapes, or the points not in floating point.
    """
    check_floats(points, "centre: points", "N", "D")
    if weights is None:
        mean = points.mean(-2, keepdim=True)
    else:
        check_core(weights, "centre: weights", points.shape[-2])
        check_batches("centre: points and weights", points, weights, cores=(2, 1))
        share = wide(weights).clamp_min(0)
        total = or_one(share.sum(-1)[..., None, None])
        mean = (wide(points) * share[..., None]).sum(-2, keepdim=True) / total
        mean = mean.to(torch.promote_types(points.dtype, weights.dtype))
    return points - mean, mean


def minimal_turn(source: Tensor, target: Tensor) -> Tensor:
    """Return the rotation R of least angle that takes one direction to another: R source || target.

    Args:
        source: (..., 3), of any length.
        target: (..., 3), of any length.

    Returns:
        (..., 3, 3); the identity where either is zero, a half turn about some normal where they are opposite.

    Raises:
        ShapeError: one of them is not (..., 3), or not in floating point.

    >>> minimal_turn(torch.tensor([2.0, 0, 0]), torch.tensor([0.0, 3, 0])).tolist()
    [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    """
    check_floats(source, "minimal_turn: source", 3)
    check_floats(target, "minimal_turn: target", 3)
    check_batches("minimal_turn: source and target", source, target, cores=(1, 1))
    with full_precision(source):
        return _minimal_turn(*alike(source, target))


def _minimal_turn(source: Tensor, target: Tensor) -> Tensor:
    """:func:`minimal_turn` of arguments that fit, in one dtype."""
    a, b = (torch.nn.functional.normalize(x / or_one(largest(x, 1)), dim=-1) for x in (source, target))
    a, b = torch.broadcast_tensors(a, b)
    still = (a.square().sum(-1) < 0.5) | (b.square().sum(-1) < 0.5)
    spin = skew(torch.linalg.cross(a, b))
    cosine = (a * b).sum(-1)[..., None, None]
    back = cosine < 0
    eye = torch.eye(3, dtype=a.dtype, device=a.device)
    turn = eye + spin + spin @ spin / torch.where(back, torch.ones_like(cosine), 1 + cosine)
    # Farther than a right angle 1 + cosine cancels: a half turn about a, then one about the middle between a and b.
    apart, middle, least = a - b, a + b, torch.finfo(a.dtype).eps
    far = torch.where(back[..., 0], apart.square().sum(-1, keepdim=True), 1)
    opposite = middle.detach().abs().amax(-1, keepdim=True) < LOST * least
    axis = torch.arange(3, device=a.device) == a.abs().argmin(-1, keepdim=True)  # a comparison, which vmap can follow
    middle = torch.where(opposite, torch.linalg.cross(a, axis.to(a.dtype)), middle)
    middle = torch.nn.functional.normalize(middle, dim=-1, eps=least)
    middle = middle - (middle * apart).sum(-1, keepdim=True) / far * apart  # lengths of 1 are so up to rounding only
    half = lambda axis: 2 * axis[..., :, None] * axis[..., None, :] - eye  # noqa: E731
    over = half(torch.nn.functional.normalize(middle, dim=-1)) @ half(a)
    return torch.where(still[..., None, None], eye, torch.where(back, over, turn))


def nearest_rotation(matrix: Tensor, *, reflect: bool = False) -> Tensor:
    """Return the rotation Q that maximises trace(Q^T matrix): the polar factor, of determinant 1.

    Args:
        matrix: (..., D, D).
        reflect: True also admits reflections.

    Returns:
        (..., D, D), orthogonal. Differentiable once, by the sums of singular values, not their gaps: repeated singular
        values are safe, and directions in which the rotation is arbitrary have the derivative 0.

    Raises:
        ShapeError: it is not square, not in floating point, or holds NaN.
    """
    check_core(matrix, "nearest_rotation: matrix", "D", "D")
    if matrix.shape[-1] != matrix.shape[-2] or not matrix.is_floating_point():
        got = f"{tuple(matrix.shape)} of {matrix.dtype}"
        raise ShapeError(f"nearest_rotation: matrix: expected square ones in floating point, got {got}")
    out: Tensor = applied(_Polar, wide(matrix), reflect)[0]  # no LAPACK takes half precision
    return out.to(matrix.dtype)


def procrustes(
    source: Tensor, target: Tensor, weights: Tensor | None = None, *, reflect: bool = False
) -> tuple[Tensor, Tensor]:
    """Return the rotation Q that minimises sum_n w_n |source_n Q - target_n|^2 for centred point sets.

    Args:
        source: (..., N, D), centred and finite.
        target: (..., N, D), centred and finite.
        weights: (..., N), 0 or less where a point does not count; all 1 where None.
        reflect: True also admits reflections.

    Returns:
        Q (..., D, D), and the least-squares scale (...), so that ``scale * source @ Q`` is nearest to ``target``.

    Raises:
        ShapeError: the shapes differ, or source or target is not in floating point.

    >>> X = torch.tensor([[1.0, 0, 0], [-1, 0, 0], [0, 2, 0], [0, -2, 0]])
    >>> Q, scale = procrustes(X, 2 * X)
    >>> torch.allclose(Q, torch.eye(3)), round(scale.item(), 5)
    (True, 2.0)
    """
    check_floats(source, "procrustes: source", "N", "D")
    check_floats(target, "procrustes: target", "N", "D")
    if source.shape[-2:] != target.shape[-2:]:
        got = f"{tuple(source.shape)} and {tuple(target.shape)}"
        raise ShapeError(f"procrustes: source and target: expected equal shapes, got {got}")
    check_batches("procrustes: source and target", source, target, cores=(2, 2))
    if weights is not None:
        check_core(weights, "procrustes: weights", source.shape[-2])
        check_batches("procrustes: source, target and weights", source, target, weights, cores=(2, 2, 1))
    dtype = torch.promote_types(source.dtype, target.dtype)
    source, target = alike(wide(source), wide(target))
    left = source if weights is None else source * weights.to(source).clamp_min(0)[..., None]
    with full_precision(left):
        rotation = nearest_rotation(left.mT @ target, reflect=reflect)
        size = (left * source).sum((-2, -1))
        overlap = ((left @ rotation) * target).sum((-2, -1))
    return rotation.to(dtype), (overlap / or_one(size)).to(dtype)


def superpose(
    source: Tensor, target: Tensor, how: str, weights: Tensor | None = None, *, root: int | None = None
) -> Tensor:
    """Move a motion onto another in the way named, by least squares; never mirrored.

    A pose that only a negative scale would bring nearer shrinks to its root, and one whose joints coincide up to
    rounding stays a point: neither size nor turn have a derivative there.

    Args:
        source: (..., T, N, 3), finite; (..., N, 3) will do unless ``how`` is "sequence".
        target: as the source.
        how: a name in :data:`ALIGNMENTS`.
        weights: (..., T, N), 0 or less where a joint does not count; all 1 if None.
        root: index of the root joint for ``root`` and ``scale``; the middle of all joints if None.

    Returns:
        (..., T, N, 3), where the target is. Differentiable in both.

    Raises:
        OptionError: there is no such alignment, or no such root.
        ShapeError: they are not of these shapes, or source or target is not in floating point.
    """
    check_alignment(how, root)
    core: tuple[int | str, ...] = ("T", "N", 3) if how == "sequence" else ("N", 3)
    dims = len(core)
    check_floats(source, "superpose: source", *core)
    check_floats(target, "superpose: target", *source.shape[-dims:])
    check_batches("superpose: source and target", source, target, cores=(dims, dims))
    if weights is not None:
        check_core(weights, "superpose: weights", *source.shape[-dims:-1])
        check_batches("superpose: source, target and weights", source, target, weights, cores=(dims, dims, dims - 1))
    joints = source.shape[-2]
    if how in ("root", "scale") and root is not None and not -joints <= root < joints:
        raise OptionError(f"root: expected a joint index below {joints}, got {root}")
    if how == "none":
        return source
    dtype = torch.promote_types(source.dtype, target.dtype)
    source, target = alike(wide(source), wide(target))
    with full_precision(source):
        return _superposed(source, target, how, weights, root).to(dtype)


def _superposed(source: Tensor, target: Tensor, how: str, weights: Tensor | None, root: int | None) -> Tensor:
    """:func:`superpose` of arguments that fit, at least in single precision."""
    mass = torch.ones_like(target[..., 0]) if weights is None else weights.to(target).clamp_min(0)
    sequence = how == "sequence"
    over, counts = 3 if sequence else 2, mass[..., None] > 0
    lost = [LOST * torch.finfo(x.dtype).eps * largest(x, over, counts) for x in (source, target)]  # by centring
    if how in ("root", "scale") and root is not None:
        mean = target[..., root, None, :]
        source, target = source - source[..., root, None, :], target - mean
    else:
        source = centre(source, mass)[0]
        target, mean = centre(target, mass)
    if how == "root":
        return source + mean
    whole = (lambda x: x.flatten(-3, -2)[..., None, :, :]) if sequence else (lambda x: x)
    unit = unit_size(source, over, counts, lost[0])  # neither turn nor fitted scale depend on it
    if how != "scale":
        goal = unit_size(target, over, counts, lost[1])
        turn = nearest_rotation(whole(unit * mass[..., None]).mT @ whole(goal))
        source, unit = source @ turn, unit @ turn
    if how == "rigid":
        return source + mean
    heavy = unit * mass[..., None]
    size = whole(heavy * unit).sum((-2, -1))
    overlap = whole(heavy * target).sum((-2, -1))
    factor = (overlap / or_one(size)).clamp_min(0)
    return unit * factor[..., None, None] + mean


class _Polar(torch.autograd.Function):
    """(matrix (..., D, D), reflect) to its polar factor, and two intermediates."""

    @staticmethod
    def forward(matrix: Tensor, reflect: bool) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        u, size, vt = torch.linalg.svd(matrix)
        if not reflect:
            sign = torch.linalg.det(u @ vt).sign()[..., None]
            u = torch.cat([u[..., :-1], u[..., -1:] * sign[..., None]], -1)
            size = torch.cat([size[..., :-1], size[..., -1:] * sign], -1)
        return u @ vt, u, size, vt

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, bool], output: tuple[Tensor, ...]) -> None:
        ctx.mark_non_differentiable(*output[1:])
        ctx.save_for_backward(inputs[0], *output[1:])

    @staticmethod
    def backward(ctx: Any, grad: Tensor, *_: Any) -> tuple[Tensor, None]:
        return _PolarAdjoint.apply(grad, *ctx.saved_tensors), None

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], matrix: Tensor, reflect: bool) -> Any:
        return _Polar.apply(matrix.movedim(in_dims[0] or 0, 0), reflect), (0, 0, 0, 0)


class _PolarAdjoint(Once):
    """The derivative, not to be differentiated again: it takes the matrix so that autograd notices who tries."""

    @staticmethod
    def forward(grad: Tensor, matrix: Tensor, u: Tensor, size: Tensor, vt: Tensor) -> Tensor:
        inner = u.mT @ grad @ vt.mT
        total = size[..., :, None] + size[..., None, :]
        firm = total > 1e-6 * size.abs().amax(-1)[..., None, None]  # else any turn in this plane would do
        spin = torch.where(firm, (inner - inner.mT) / torch.where(firm, total, torch.ones_like(total)), 0)
        return u @ spin @ vt

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> None:
        raise RuntimeError("second derivatives of nearest_rotation are not supported")

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *tensors: Tensor) -> Any:
        padded, _ = batch_first(info, in_dims, tensors, (2, 2, 2, 1, 2))
        return _PolarAdjoint.apply(*padded), 0
