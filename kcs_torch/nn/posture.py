"""What a body usually does: the directions of its bones, seen from its trunk."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from torch import Tensor

from kcs_torch.errors import OptionError, ShapeError, SkeletonError
from kcs_torch.functional.chain import bone_vectors
from kcs_torch.functional.guarded import or_one, safe_root, unit_size
from kcs_torch.functional.precision import full_precision, narrow, wide
from kcs_torch.nn.checks import check_beside, check_lengths, check_positive
from kcs_torch.nn.layers import SkeletonModule
from kcs_torch.nn.lengths import LEAST, usual_size
from kcs_torch.nn.masks import bone_share, known_points, weighs_joints
from kcs_torch.skeleton import Skeleton
from kcs_torch.skeleton.graph import find_pieces

__all__ = ["PostureEnergy", "has_trunk", "trunk_joints"]

FEWEST = 3
"""Joints of a trunk, at least."""

TRUNK_SPREAD = 18.0
"""Bones that stray from the template by less than this, in degrees, are of the trunk."""

ROUNDING = 1.0
"""Rounding of a scatter's eigenvalues, over its trace and the machine precision, that is allowed for."""

BEND = (0.15, 0.3)
"""How far a hinge's upper and lower bone hang from the template on average, as a share of their length."""


class PostureEnergy(SkeletonModule):
    """-log marginal likelihood of a clip's bone directions, seen from the trunk, under one Gaussian of unknown moments.

    y_tb = (R_t^T b_t / L_b - m_b) / d_b, with the trunk's rotation R_t, the directions m that the template and the
    hinges suggest and the spreads d of the skeleton. Of n independent frames with scatter S = sum_t (y - mean)(y -
    mean)^T and mean y', a normal - inverse-Wishart prior of strength nu leaves

        (n + nu)/2 log det(I + (S + n kappa/(n + kappa) y' y'^T) / nu):

    the log-det of Procrustes-aligned bones for long clips, a pull to the template for short ones.

    A body that moves in one way might as well do so as its own mirror image, left and right exchanged. Of a Gaussian
    that says so, what both sides have in common, (y_left + M y_right) / sqrt 2, is independent of what sets them apart,
    (y_left - M y_right) / sqrt 2, with M the reflection in the body's middle plane. The energy is then the sum of one
    such term for each of the two (Shah, Chandrasekaran: Group Symmetry and Covariance Regularization, 2012).

    Args:
        skeleton: with a template and spreads, and a trunk of at least three joints.
        strength: nu, in frames.
        kappa: strength of the prior on the mean, in frames.
        correlation: frames that tell as much as one independent frame.
        symmetric: the mirror image of a motion is as likely as the motion; it makes no difference to skeletons without
            twins, or with bones whose mirror images are no bones.

    Raises:
        SkeletonError: the skeleton has no template, no spreads or no trunk.
        OptionError: a number is not positive.

    >>> energy = PostureEnergy("h36m17")
    >>> energy(torch.randn(4, 30, 17, 3)).shape
    torch.Size([4])
    """

    trunk: Tensor
    affine: Tensor
    axes: Tensor
    mean: Tensor
    deviation: Tensor
    rest: Tensor
    rest_lengths: Tensor
    halves: Tensor

    def __init__(
        self,
        skeleton: str | Path | Skeleton,
        *,
        strength: float = 10.0,
        kappa: float = 1.0,
        correlation: float = 15.0,
        symmetric: bool = True,
    ) -> None:
        super().__init__(skeleton)
        body = self.skeleton
        check_positive(self, finite=True, strength=strength, kappa=kappa)
        check_positive(self, correlation=correlation)
        self.strength, self.kappa, self.correlation = strength, kappa, correlation
        trunk = trunk_joints(body)
        if len(trunk) < FEWEST:
            raise SkeletonError(
                f"skeleton '{body.name}' has no trunk: expected a template and spreads, with at least three joints "
                f"joined by bones that stray by less than {TRUNK_SPREAD:g} degrees"
            )
        rest = body.template_points(dtype=torch.float64)
        rest = rest - rest.mean(0)
        rest = rest * (0.5 / rest.square().sum(-1).mean().sqrt())  # a standing person of about 1.75
        vectors = bone_vectors(rest, body.bone_index())
        length = vectors.norm(dim=-1)
        flat = rest[trunk] - rest[trunk].mean(0)
        axes = torch.linalg.svd(flat)[2].mT  # columns: the trunk's two long axes and its normal
        axes = torch.cat([axes[:, :2], axes[:, 2:] * torch.linalg.det(axes).sign()], -1)  # right-handed
        along = torch.sin(torch.deg2rad(torch.tensor(body.spread, dtype=torch.float64))).clamp_max(0.6)
        side, mean = 0.7 * along, vectors / length.clamp_min(1e-9)[:, None]
        lateral, hang = _hinge_facts(body, rest)
        firm = torch.tensor([i in hang for i in range(body.num_bones)])
        side = torch.where(firm, along / 3, side)
        mean = 0.95 * (mean + lateral)
        self.register_buffer("trunk", torch.tensor(trunk), persistent=False)
        self.register_buffer("affine", torch.linalg.pinv(flat @ axes[:, :2]), persistent=False)
        self.register_buffer("axes", axes, persistent=False)
        self.register_buffer("mean", mean, persistent=False)
        self.register_buffer("deviation", torch.stack([side, along, along], -1), persistent=False)
        self.register_buffer("rest", rest, persistent=False)
        self.register_buffer("rest_lengths", length, persistent=False)
        self.register_buffer("halves", _halves(body, symmetric), persistent=False)

    def frame(self, points: Tensor) -> Tensor:
        """The trunk's rotation R_t, template to camera, (..., T, 3, 3): the best affine fit, made square.

        Args:
            points: (..., T, N, 3).

        Raises:
            ShapeError: the points are not of this skeleton.
        """
        self._check(points)
        part = wide(points.index_select(-2, self.trunk))
        part = unit_size(part - part.mean(-2, keepdim=True), 2)
        with full_precision(part):
            first, second = (self.affine.to(part) @ part).unbind(-2)  # images of the trunk's two long axes
            first = _unit(first)
            second = _unit(second - (second * first).sum(-1, keepdim=True) * first)
            turned = torch.stack([first, second, torch.linalg.cross(first, second)], -1)
            return narrow(turned @ self.axes.to(part).mT, points)

    def directions(self, points: Tensor, lengths: Tensor | None = None, weights: Tensor | None = None) -> Tensor:
        """Bones seen from the trunk over their lengths, (..., T, B, 3), 0 where a length is 0; as in :meth:`forward`.

        Half precision comes back as single.
        """
        self._check(points)
        check_lengths(lengths, points, self)
        joints = weights is not None and weighs_joints(weights, points, self)
        with full_precision(points):
            points = wide(known_points(points, weights, self))
            vectors = bone_vectors(points, self.bones)
            if lengths is None:
                share = None
                if weights is not None:
                    share = bone_share(weights, self.bones) if joints else weights[..., None]
                lengths = usual_size(vectors, share, LEAST)
            lengths = lengths.to(vectors.dtype)[..., None, :, None]
            return vectors @ self.frame(points) / torch.where(lengths <= 0, torch.inf, lengths)

    def forward(
        self,
        points: Tensor,
        lengths: Tensor | None = None,
        weights: Tensor | None = None,
        *,
        independent: Tensor | None = None,
    ) -> Tensor:
        """Return the energy of each clip.

        Args:
            points: (..., T, N, 3).
            lengths: (..., B); None takes each bone's root mean square over the frames that count, and a
                hundredth of all bones', so that none is 0.
            weights: (..., T, N) of the joints: a bone weighs as much as the lesser of its ends, and no more than the
                least joint of the trunk, which it is seen from; or (..., T) of the frames: 0 for one that pads a
                shorter clip; all 1 if None.
            independent: (..., T) how many independent frames each frame counts for, in place of weights: weights of 1
                are 1 / correlation.

        Returns:
            (...).

        Raises:
            ShapeError: the shapes do not fit.
            OptionError: weights and independent are both given.
        """
        self.check(points, clip=True)
        if independent is not None:
            if weights is not None:
                raise OptionError("PostureEnergy: expected weights or independent, got both")
            check_beside(independent, "independent", points.shape[-3:-2], points, self)
            weights = independent
        with full_precision(points):
            local = self.directions(points, lengths, weights)
            y = ((local - self.mean.to(local)) / self.deviation.to(local)).flatten(-2)
            count: Tensor | float
            each: Tensor | float = 1.0
            pull: Tensor | float = 1.0
            if weights is None:
                count, mean = y.shape[-2] / self.correlation, y.sum(-2, keepdim=True) / max(y.shape[-2], 1)
                off, each = y - mean, 1 / self.correlation
                pull = count * self.kappa / (count + self.kappa)
            elif independent is None and weighs_joints(weights, points, self):
                firm = torch.minimum(bone_share(weights, self.bones), weights[..., self.trunk].amin(-1, keepdim=True))
                share = firm.to(local).clamp_min(0).repeat_interleave(3, -1) / self.correlation  # (..., T, 3B)
                count, own = share.amax(-1).sum(-1), share.sum(-2, keepdim=True)
                mean = (share * y).sum(-2, keepdim=True) / or_one(own)
                off = safe_root(share) * (y - mean)
                mean = mean * safe_root(own * self.kappa / (own + self.kappa))
            else:
                share = weights.to(local).clamp_min(0)[..., None] / (self.correlation if independent is None else 1)
                count = share.sum((-2, -1))
                mean = (share * y).sum(-2, keepdim=True) / or_one(count)[..., None, None]
                off, each = y - mean, share[..., None, :, :]
                pull = (count * self.kappa / (count + self.kappa))[..., None, None, None]
            off, mean = (self.taken_apart(rows) for rows in (off, mean))  # (..., S, T or 1, K)
            scatter = (off * each).mT @ off + pull * (mean.mT @ mean)
            each = count[..., None] if isinstance(count, Tensor) else count
            return narrow(self.of_scatter(scatter, each).sum(-1), points)

    def _check(self, points: Tensor) -> None:
        self.check(points, clip=True)
        if points.shape[-1] != 3:
            raise ShapeError(f"PostureEnergy: expected points (..., T, N, 3), got {tuple(points.shape)}")

    def taken_apart(self, rows: Tensor) -> Tensor:
        """Bones' coordinates (..., T, 3B) in each of the halves, (..., S, T, K)."""
        rows = rows[..., None, :, :]
        return rows if len(self.halves) == 1 else rows @ self.halves.to(rows).mT

    def of_scatter(self, scatter: Tensor, count: Tensor | float) -> Tensor:
        """(n + nu)/2 log det(I + S / nu), (...), of scatters S (..., K, K) of n independent frames, (...) or one.

        What rounding may take from the eigenvalues of a large S is added, so that there always is a factor.
        """
        ratio = scatter / self.strength
        least = 1 + ROUNDING * torch.finfo(ratio.dtype).eps * ratio.diagonal(dim1=-2, dim2=-1).sum(-1)
        eye = torch.eye(scatter.shape[-1], dtype=scatter.dtype, device=scatter.device)
        factor, _ = torch.linalg.cholesky_ex(ratio + least[..., None, None] * eye)
        return (count + self.strength) * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)


def has_trunk(skeleton: Skeleton) -> bool:
    """Whether enough joints are the trunk's to tell which way the body faces: at least three."""
    return len(trunk_joints(skeleton)) >= FEWEST


def trunk_joints(skeleton: Skeleton) -> list[int]:
    """Joints of the largest piece that bones of little spread hold together; none without a template or spreads."""
    if skeleton.template is None or skeleton.spread is None or not skeleton.is_tree:
        return []
    firm = [bone for bone, s in zip(skeleton.bones, skeleton.spread, strict=True) if s < TRUNK_SPREAD]
    return max(find_pieces(skeleton.num_joints, firm), key=len)


def _hinge_facts(body: Skeleton, rest: Tensor) -> tuple[Tensor, set[int]]:
    """How hinges shift the mean directions (B, 3), and which bones swing in the plane of a firm hinge."""
    where = {frozenset(bone): i for i, bone in enumerate(body.bones)}
    shift = torch.zeros(body.num_bones, 3, dtype=rest.dtype)
    firm: set[int] = set()
    for hinge in body.hinges:
        upper, lower = (where[frozenset(bone)] for bone in hinge.bones)
        axis = _unit(rest[hinge.left] - rest[hinge.right])
        along = _unit(rest[hinge.joint] - rest[hinge.parent])
        towards = hinge.sign * torch.linalg.cross(axis, along)  # the side that the lower bone bends to
        bends_first = not any(h.joint == hinge.parent for h in body.hinges)
        if bends_first:  # an ankle's rest is the template's
            shift[upper] = -BEND[0] * towards
            shift[lower] = BEND[1] * towards
        if hinge.firm >= 0.5:
            firm |= {upper, lower}
    return shift, firm


def _halves(body: Skeleton, symmetric: bool) -> Tensor:
    """Orthonormal rows (S, K, 3B) that take bones (B, 3) apart: into what both sides share and what sets them apart.

    S is 2, the rows of the second filled up with zeros; or 1, with the rows of the identity, where the body has no
    twins, or bones whose mirror images are no bones of it.
    """
    size = body.num_bones
    rows = torch.eye(3 * size, dtype=torch.float64).view(size, 3, 3 * size)
    twin = {a: b for pair in body.mirror for a, b in (pair, pair[::-1])}
    whole = {(twin.get(a, a), twin.get(b, b)) for a, b in body.bones} == set(body.bones)
    if not (symmetric and whole and body.mirror_bones):
        return rows.view(1, 3 * size, 3 * size)
    left, right = torch.tensor(body.mirror_bones).T
    middle = [b for b in range(size) if b not in {*left.tolist(), *right.tolist()}]
    image = rows[right] * rows.new_tensor([-1.0, 1.0, 1.0])[:, None]
    shared = torch.cat([math.sqrt(0.5) * (rows[left] + image).flatten(0, 1), rows[middle, 1:].flatten(0, 1)])
    apart = torch.cat([math.sqrt(0.5) * (rows[left] - image).flatten(0, 1), rows[middle, 0]])
    return torch.nn.utils.rnn.pad_sequence([shared, apart], batch_first=True)


def _unit(vectors: Tensor) -> Tensor:
    size = (vectors.square().sum(-1, keepdim=True) + 1e-18).sqrt()
    return vectors / size
