"""Bones: incidence matrices, bone vectors, lengths and the KCS matrix (Wandt et al. 2018, section 3)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from kcs_torch.errors import ShapeError
from kcs_torch.functional.guarded import or_one, safe_norm, unit_size
from kcs_torch.functional.precision import full_precision, wide, widened
from kcs_torch.functional.shapes import check_core, check_floats

__all__ = [
    "bone_lengths",
    "bone_vectors",
    "chain_inverse",
    "incidence",
    "kcs_matrix",
    "points_from_bones",
    "pose_matrix",
]


def incidence(bones: Tensor | Sequence[Sequence[int]], num_joints: int, *, dtype: torch.dtype | None = None) -> Tensor:
    """Return C with +1 at each bone's child and -1 at its parent, so that bones are ``C.mT @ points``.

    Args:
        bones: (B, 2) integer (parent, child) pairs.
        num_joints: N.
        dtype: of the result; torch's default if None.

    Returns:
        (N, B) incidence matrix (KCS eq. 4), on the device of ``bones``.

    Raises:
        ShapeError: ``bones`` is not (B, 2), or an index is outside 0..N-1.

    >>> incidence([(0, 1), (1, 2)], 3).tolist()
    [[-1.0, 0.0], [1.0, -1.0], [0.0, 1.0]]
    """
    index = index_rows(bones)
    # A compiled graph cannot look at numbers, nor are there any on the meta device: the indices were checked before.
    look = index.numel() > 0 and not index.is_meta and not torch.compiler.is_compiling()
    try:
        low, high = (int(index.min()), int(index.max())) if look else (0, -1)
    except RuntimeError:  # nor can torch.func.vmap
        low, high = 0, -1
    if low < 0 or high >= num_joints:
        raise ShapeError(f"bones: expected joint indices 0..{num_joints - 1}, got {low}..{high}")
    joint, kind = torch.arange(num_joints, device=index.device)[:, None], dtype or torch.get_default_dtype()
    return (index[:, 1] == joint).to(kind) - (index[:, 0] == joint).to(kind)


@widened
def chain_inverse(matrix: Tensor) -> Tensor:
    """Return D = pinv(C).mT, the map back from bones to joints: ``D @ bones`` has joint mean zero.

    For a tree it is exact. For a closed chain it is the least-squares pose; each separate piece is centred by itself.

    Args:
        matrix: (N, B) incidence matrix C.

    Returns:
        (N, B) matrix D (the D of KCS Algorithm 1, transposed as points are rows here).

    Raises:
        ShapeError: the matrix is not (N, B), or not in floating point.

    >>> C = incidence([(0, 1), (1, 2)], 3)
    >>> X = torch.tensor([[0.0, 0, 0], [0, 1, 0], [0, 2, 0]])
    >>> (chain_inverse(C) @ (C.mT @ X)).round(decimals=5).tolist()
    [[0.0, -1.0, 0.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    """
    check_floats(matrix, "chain_inverse: matrix", "N", "B")
    return torch.linalg.pinv(matrix).mT


def points_from_bones(vectors: Tensor, inverse: Tensor) -> Tensor:
    """Return joint positions with joint mean zero, ``D @ bones``.

    Args:
        vectors: (..., B, D) bone vectors.
        inverse: (N, B) from :func:`chain_inverse`.

    Returns:
        (..., N, D) points.

    Raises:
        ShapeError: they are not of these shapes.
    """
    check_core(vectors, "points_from_bones: vectors", "B", "D")
    check_core(inverse, "points_from_bones: inverse", "N", vectors.shape[-2])
    with full_precision(vectors):
        return inverse @ vectors


def bone_vectors(points: Tensor, bones: Tensor | Sequence[Sequence[int]]) -> Tensor:
    """Return child minus parent for each bone: ``C.mT @ points`` without the matrix product (KCS eq. 5).

    Args:
        points: (..., N, D).
        bones: (B, 2) integer (parent, child) pairs.

    Returns:
        (..., B, D), in the unit of the points.

    Raises:
        ShapeError: ``bones`` is not (B, 2), a list that has other indices, or the points are not (..., N, D).

    >>> bone_vectors(torch.tensor([[0.0, 0], [1, 2]]), [(0, 1)]).tolist()
    [[1.0, 2.0]]
    """
    check_core(points, "bone_vectors: points", "N", "D")
    index = index_rows(bones, points.shape[-2]).to(points.device)
    return points.index_select(-2, index[:, 1]) - points.index_select(-2, index[:, 0])


def bone_lengths(points: Tensor, bones: Tensor | Sequence[Sequence[int]]) -> Tensor:
    """Return the length of each bone; the gradient at a zero-length bone is zero, never NaN.

    Args:
        points: (..., N, D).
        bones: (B, 2) integer (parent, child) pairs.

    Returns:
        (..., B), in the unit of the points.

    Raises:
        ShapeError: as of :func:`bone_vectors`.

    >>> bone_lengths(torch.tensor([[0.0, 0, 0], [0, 3, 4]]), [(0, 1)]).tolist()
    [5.0]
    """
    return safe_norm(bone_vectors(points, bones))


def kcs_matrix(vectors: Tensor) -> Tensor:
    """Return Psi = B B^T, the inner products of all bones; squared lengths on its diagonal (KCS eq. 7).

    Args:
        vectors: (..., B, D) bone vectors.

    Returns:
        (..., B, B), in squared units; unchanged by any rotation or reflection of the pose.

    Raises:
        ShapeError: the vectors are not (..., B, D).

    >>> kcs_matrix(torch.tensor([[3.0, 0], [1, 2]])).tolist()
    [[9.0, 3.0], [3.0, 5.0]]
    """
    check_core(vectors, "kcs_matrix: vectors", "B", "D")
    with full_precision(vectors):
        return vectors @ vectors.mT


def pose_matrix(
    points: Tensor,
    bones: Tensor | Sequence[Sequence[int]],
    *,
    normalise: bool = False,
    weights: Tensor | None = None,
) -> Tensor:
    """Return the KCS matrix of points, ``kcs_matrix(bone_vectors(points, bones))``, in less time.

    Bones are taken as differences, not as the product with C that defines them: exact in any matmul precision, and a
    joint that is not finite spoils its own bones only. They run along the last dimension, as products want it.

    Args:
        points: (..., N, D).
        bones: (B, 2) integer (parent, child) pairs.
        normalise: divide by the mean squared bone length, which frees the matrix of scale. A pose that is one point
            gives 0, with the derivative 0.
        weights: (..., B) of the bones in that mean; those of weight 0 are taken for 0 in the normalised matrix.

    Returns:
        (..., B, B), in squared units, or without one.

    Raises:
        ShapeError: ``bones`` is not (B, 2), or points that are to be normalised are not in floating point.

    >>> pose_matrix(torch.tensor([[0.0, 0], [3, 0], [4, 2]]), [(0, 1), (1, 2)]).tolist()
    [[9.0, 3.0], [3.0, 5.0]]
    """
    (check_floats if normalise else check_core)(points, "pose_matrix: points", "N", "D")
    parents, children = index_rows(bones, points.shape[-2]).to(points.device).unbind(-1)
    rows = points.mT
    across = rows.index_select(-1, children) - rows.index_select(-1, parents)  # (..., D, B)
    if normalise:
        if weights is not None:  # a bone to an unseen joint says nothing of the body's size
            across = torch.where(weights[..., None, :] > 0, across, torch.zeros_like(across))
        across = unit_size(across, 2)
    with full_precision(across):
        matrix = torch.bmm(across.mT, across) if across.ndim == 3 else across.mT @ across
    if not normalise:
        return matrix
    square = matrix.diagonal(dim1=-2, dim2=-1)
    if weights is None:
        size = square.mean(-1)
    else:
        weights = wide(weights)
        size = ((weights * square).sum(-1) / or_one(weights.sum(-1))).to(square.dtype)
    return matrix / or_one(size)[..., None, None]


def index_rows(
    rows: Tensor | Sequence[Sequence[int]],
    joints: int | None = None,
    *,
    what: str = "bones",
    form: tuple[str, ...] = ("parent", "child"),
) -> Tensor:
    """Rows of joint indices, (B, 2) for bones; those of a list are among so many joints, or any if None.

    Those of a tensor are not looked at, which would wait for its device.

    Raises:
        ShapeError: the rows are not of this form, or a list has other indices.
    """
    shape = f"shape ({what[0].upper()}, {len(form)}) of indices ({', '.join(form)})"
    if not isinstance(rows, Tensor):
        try:
            listed = [tuple(row) for row in rows]
        except TypeError:
            raise ShapeError(f"{what}: expected {shape}, got {rows!r}") from None
        for row in listed:
            if len(row) != len(form) or not all(hasattr(i, "__index__") for i in row):
                raise ShapeError(f"{what}: expected {shape}, got a row {row}")
            if joints is not None and not all(0 <= i < joints for i in row):
                raise ShapeError(f"{what}: expected joint indices 0..{joints - 1}, got {row}")
        return torch.tensor(listed, dtype=torch.long).reshape(-1, len(form))
    if rows.ndim != 2 or rows.shape[-1] != len(form) or rows.is_floating_point():
        raise ShapeError(f"{what}: expected {shape}, got {tuple(rows.shape)} of {rows.dtype}")
    return rows
