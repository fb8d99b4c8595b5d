"""PND: Procrustean normal distribution, fitted by expectation maximisation (Lee, Cho, Choi, Oh, CVPR 2013)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from kcs_torch.functional.align import nearest_rotation
from kcs_torch.functional.camera import complete_rotation
from kcs_torch.functional.rotation import rotation_matrix
from kcs_torch.methods.base import Estimate, Method
from kcs_torch.methods.sfam import SfAM
from kcs_torch.methods.unseen import place_unseen
from kcs_torch.types import Tracks

__all__ = ["PND", "ProcrusteanNormal", "align_to_mean", "fit_procrustean_normal", "procrustean_tangent"]

CHUNK = 32
"""Frames whose matrices are made at once: more would not stay in the processor's caches."""

FEWEST = 3
"""Seen joints without which a frame says nothing of its rotation: its start is then taken for seen."""

FARTHEST = 0.2
"""Radians that a step may turn a frame by, at most, and the change of its log scale."""

SETTLED = 5e-3
"""Share of the shapes that the last step may change them by."""


@dataclass(frozen=True)
class PND(Method):
    """Shapes without their rigid motion follow one Gaussian; depth, rotations and scales are fitted to the tracks.

    With Y_t = X_t R_t / c_t the shapes, turned and scaled onto their mean M as generalised Procrustes analysis does,
    vec(Y_t) ~ N(vec M, S), where S has no variance in the directions in which M moves, turns or grows: nothing rigid
    is taken for deformation. The tracks are c_t Y_t R_t^T without depth, and noise. EM finds S, M, the noise and, by
    Gauss-Newton on the likelihood of each frame, R_t and c_t; it starts from shapes of low rank (:class:`SfAM` without
    bones). Unseen joints are unknowns of the E-step. No rank is chosen, no smoothness assumed, and bones are not
    looked at.

    Args:
        num_steps: EM steps.
        noise: first variance of the noise, a share of that of the deformation.
        final: variance of the noise, a share of that of the tracks, that it does not fall below.
        fall: factor by which it falls in a step, at most; falling slowly it keeps the fit from the nearest optimum.
        spread: variance that is added to the start's in every direction, a share of their mean.

    Raises:
        OptionError: a value is out of range.
    """

    name: ClassVar[str] = "pnd"
    keeps_lengths: ClassVar[bool] = False
    num_steps: int = 50
    noise: float = 0.015
    final: float = 1e-6
    fall: float = 0.88
    spread: float = 3e-3

    def __post_init__(self) -> None:
        super().__post_init__()
        self._expect(self.num_steps >= 1, "num_steps", "at least 1")
        self._expect(0 < self.noise < math.inf, "noise", "a positive number")
        self._expect(0 < self.final < 1, "final", "a number between 0 and 1")
        self._expect(0 < self.fall < 1, "fall", "a number between 0 and 1")
        self._expect(0 <= self.spread < math.inf, "spread", "a number >= 0")

    def solve(self, tracks: Tracks, cameras: Tensor | None) -> Estimate:
        """Start from low rank, fit, and take the posterior mean of the shapes."""
        given = tracks.points
        if given.device.type != "mps":  # what the noise leaves of a covariance is small beside the shapes
            tracks = replace(tracks, points=given.double(), weights=tracks.weights.double())
        known = tracks.seen.any(0)
        start = SfAM(beta=0.0, camera_path="free").solve(tracks, None if cameras is None else cameras.to(tracks.points))
        points, rows, settled, steps = start.points, start.cameras, True, 1
        local = points[:, known] - points[:, known].mean(1, keepdim=True)
        if local.shape[1] > 3 and bool(local.isfinite().all()) and bool(local.square().sum() > 0):
            seen = tracks.seen[:, known]
            thin = seen.sum(1, keepdim=True) < FEWEST
            weights = torch.where(thin, torch.ones_like(local[..., 0]), tracks.weights[:, known])
            image = torch.where((seen & ~thin)[..., None], tracks.points[:, known], local[..., :2])
            first = ProcrusteanNormal.of_shapes(local, complete_rotation(rows), spread=self.spread)
            fitted, _, change = fit_procrustean_normal(
                image, weights, first, num_steps=self.num_steps, noise=self.noise, final=self.final, fall=self.fall
            )
            points = points.clone()
            points[:, known] = fitted.shapes()
            rows, settled, steps = fitted.rotations[:, :2], change <= SETTLED, self.num_steps
        points = place_unseen(points, known, tracks.skeleton).to(given)
        one = torch.ones_like(points[:, 0, 0])
        return Estimate(points, rows.to(given) if cameras is None else cameras, one, settled, steps)


@dataclass(frozen=True)
class ProcrusteanNormal:
    """A Procrustean normal distribution and the frames' places in it; vectors hold all x, then all y, then all z.

    Attributes:
        mean: M (N, 3), centred, of unit norm.
        covariance: S (3N, 3N).
        rotations: R (T, 3, 3), from the aligned frame to the camera's.
        scales: c (T,), positive.
        aligned: Y (T, N, 3), each frame's shape, or its posterior mean.
    """

    mean: Tensor
    covariance: Tensor
    rotations: Tensor
    scales: Tensor
    aligned: Tensor

    def shapes(self) -> Tensor:
        """The shapes in the camera's frame, c Y R^T, (T, N, 3)."""
        return self.scales[:, None, None] * (self.aligned @ self.rotations.mT)

    @classmethod
    def of_shapes(cls, points: Tensor, rotations: Tensor, *, spread: float = 0.0) -> ProcrusteanNormal:
        """Align shapes by generalised Procrustes analysis and take their moments.

        Args:
            points: X (T, N, 3), centred, in each frame's camera.
            rotations: (T, 3, 3), a first guess of R.
            spread: variance to add in every direction that deforms, a share of their mean.
        """
        aligned = points @ rotations
        mean = _unit(aligned.mean(0), aligned)
        for _ in range(20):
            turn, factor = align_to_mean(aligned, mean)
            aligned = (aligned @ turn) * factor[:, None, None]
            mean = _unit(aligned.mean(0), aligned)
        turn, factor = align_to_mean(aligned, mean)
        aligned = (aligned @ turn) * factor[:, None, None]
        rotations = nearest_rotation(points.mT @ aligned)
        size = (points * (aligned @ rotations.mT)).sum((1, 2)) / aligned.square().sum((1, 2))
        scales = torch.maximum(size, LEAST * size.median().clamp_min(LEAST * size.amax()))
        away, tangent = _vector(aligned - mean), procrustean_tangent(mean)
        covariance = tangent @ (away.mT @ away / len(points)) @ tangent
        covariance = covariance + spread * covariance.diagonal().mean() * tangent
        return cls(mean, covariance, rotations, scales, aligned)


LEAST = 0.05
"""A frame's scale, at least, as a share of the median: a frame that shows a single point still has a place."""


def fit_procrustean_normal(
    tracks: Tensor,
    weights: Tensor,
    start: ProcrusteanNormal,
    *,
    num_steps: int = 50,
    noise: float = 0.015,
    final: float = 1e-6,
    fall: float = 0.88,
) -> tuple[ProcrusteanNormal, Tensor, float]:
    """Fit a Procrustean normal distribution to 2D tracks by EM; the likelihood falls in no step but one undone next.

    E-step: with the tracks w = P vec(Y) + e, e ~ N(0, s I / weight), P the two rows of c R for each joint, and any
    translation, the posterior of Y has the mean M + K (w - P M) and covariance S - K P S, K = S P^T G^-1,
    G = P S P^T + s I. M-step: s; M, onto which the posterior means are aligned; S, the second moment about it, in the
    directions that deform. R and c move by a Gauss-Newton step on the likelihood of their frame, as the expectation of
    the complete likelihood tells nothing of them where there is little noise.

    Args:
        tracks: w (T, N, 2), finite.
        weights: (T, N), 0 where unseen; 1 is the noise's own variance.
        start: to start from.
        num_steps: EM steps.
        noise: first s, a share of the deformation's variance.
        final: least s, a share of the tracks' variance.
        fall: s falls by no more than this factor in a step.

    Returns:
        The fit, with posterior means as its shapes; the log-likelihood (num_steps + 1,) at the start and after each
        step; and the share of the shapes that the last step changed.
    """
    root = weights.sqrt()
    unit = root / torch.linalg.vector_norm(root, dim=1, keepdim=True)
    image = _freed(tracks.mT, root, unit)  # (T, 2, N)
    power = image.square().sum() / (2 * weights.sum())
    least = final * power + torch.finfo(tracks.dtype).tiny
    level = noise * start.covariance.diagonal().mean() * start.scales.square().mean()
    level = torch.maximum(level, least)
    count = 2 * ((weights > 0).sum(1) - 1).clamp_min(0)
    now, history, damping = start, [], 1e-3
    found = _expect(now, image, root, unit, count, level, damping)
    history.append(found.likelihood)
    change = math.inf
    for _ in range(num_steps):
        after = torch.maximum(found.noise, least)
        after = torch.where(after < level, torch.maximum(after, fall * level), after)
        trial = _maximise(now, found)
        result = _expect(trial, image, root, unit, count, after, damping)
        if not bool(result.likelihood >= found.likelihood):  # NaN, too: the plain M-step cannot fall
            damping = min(damping * 10, 1e6)
            trial = replace(now, covariance=_second_moment(found.aligned - now.mean, found.rest, now.mean))
            result = _expect(trial, image, root, unit, count, after, damping)
        else:
            damping = max(damping / 3, 1e-4)
        if not bool(result.likelihood.isfinite()):
            break
        before = now.scales[:, None, None] * (found.aligned @ now.rotations.mT)
        now, found, level = trial, result, after
        shape = now.scales[:, None, None] * (found.aligned @ now.rotations.mT)
        change = float(torch.linalg.vector_norm(shape - before) / torch.linalg.vector_norm(shape))
        history.append(found.likelihood)
    return replace(now, aligned=found.aligned), torch.stack(history), change


@dataclass(frozen=True)
class _Expectation:
    """What the E-step finds.

    Attributes:
        likelihood: log p(tracks), but for a constant.
        aligned: posterior means (T, N, 3).
        rest: sum over frames of the posterior covariances (3N, 3N).
        steps: (T, 4) by which rotations (camera's frame) and log scales should move.
        noise: the variance that the M-step gives it.
    """

    likelihood: Tensor
    aligned: Tensor
    rest: Tensor
    steps: Tensor
    noise: Tensor


def _expect(
    now: ProcrusteanNormal, image: Tensor, root: Tensor, unit: Tensor, count: Tensor, level: Tensor, damping: float
) -> _Expectation:
    """E-step, a few frames at a time, and the Gauss-Newton step of each frame's rotation and scale.

    All matrices of a frame are in the weighted image without its translation, where noise is white.
    """
    frames, _, joints = image.shape
    size, three = 2 * joints, 3 * joints
    mean, covariance = now.mean.mT.contiguous(), now.covariance.reshape(3, -1).contiguous()
    axes = torch.eye(3, dtype=image.dtype, device=image.device)
    spin = -torch.linalg.cross(axes[:, None].expand(3, 3, 3), axes[None].expand(3, 3, 3), dim=-1)  # (3, 3, 3)
    even = bool((root == root[:1, :1]).all())  # then nothing weighs the image, and S has no translation
    eye = torch.eye(size, dtype=image.dtype, device=image.device)
    inner = torch.zeros_like(now.covariance)
    parts = []
    for index in torch.arange(frames, device=image.device).split(CHUNK):
        turn, scale, soft, axis = now.rotations[index], now.scales[index, None, None], root[index], unit[index]
        camera, chunk = scale * turn[:, :2], len(index)  # (t, 2, 3)
        across = (camera.reshape(-1, 3) @ covariance).view(chunk, 2, joints, three)
        if not even:
            across = _freed(across.mT, soft[:, None], axis[:, None]).mT
        across = across.reshape(chunk, size, three)  # P S
        square = camera[:, None] @ across.view(chunk, size, 3, joints)  # (t, 2N, 2, N)
        if even:
            square = square * soft[0, 0].square()
            across = across * soft[0, 0]
        else:
            square = _freed(square, soft[:, None], axis[:, None])
        square = square.reshape(chunk, size, size) + level * eye
        factor, info = torch.linalg.cholesky_ex(square)
        whiten = torch.linalg.solve_triangular(factor, eye.expand_as(factor), upper=False)  # G = L L^T, this is L^-1
        off = image[index] - _freed(camera @ mean, soft, axis)
        white = whiten @ off.reshape(chunk, size, 1)
        gain = whiten @ across
        posterior = mean + (gain.mT @ white).view(chunk, 3, joints)
        likelihood = -white.square().sum((1, 2)) / 2 - factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        likelihood = torch.where(info == 0, likelihood, -torch.inf) + (size - count[index]) / 2 * level.log()
        # Gradient in the camera's rows: G^-1 ((w - P M) Y^T - P S), summed over joints.
        free = _freed(whiten.view(chunk, size, 2, joints), soft[:, None], axis[:, None])
        pull = (free.reshape(chunk, size, size).mT @ white).view(chunk, 2, joints)
        spread = free.transpose(1, 2).reshape(chunk, 2, -1) @ gain.view(chunk, size, 3, joints).permute(
            0, 1, 3, 2
        ).reshape(chunk, -1, 3)
        slope = pull @ posterior.mT - spread
        ways = torch.cat([(scale[:, None] * (spin @ turn[:, None]))[:, :, :2], camera[:, None]], 1)  # (t, 4, 2, 3)
        gradient = (slope[:, None] * ways).sum((2, 3))
        moves = free.reshape(chunk, size, size) @ (ways @ posterior[:, None]).reshape(chunk, 4, size).mT
        normal = moves.mT @ moves
        normal = normal + torch.diag_embed(damping * normal.diagonal(dim1=-2, dim2=-1)) + 1e-9 * axes.new_ones(4).diag()
        solver, _ = torch.linalg.cholesky_ex(normal)
        step = torch.cholesky_solve(gradient[..., None], solver)[..., 0]
        miss = (whiten.mT @ white).square().sum((1, 2)) - whiten.square().sum((1, 2))
        flat = gain.reshape(-1, three)
        inner += flat.mT @ flat
        parts.append((likelihood, posterior, step, miss))
    likelihood, posterior, step, miss = (torch.cat(part) for part in zip(*parts, strict=True))
    far = torch.linalg.vector_norm(step, dim=-1, keepdim=True)
    step = torch.where(far.isfinite(), step * (FARTHEST / far.clamp_min(FARTHEST)), torch.zeros_like(step))
    noise = (level * frames * size + level.square() * miss.sum()) / count.sum().clamp_min(1)
    return _Expectation(likelihood.sum(), posterior.mT, frames * now.covariance - inner, step, noise)


def _maximise(now: ProcrusteanNormal, found: _Expectation) -> ProcrusteanNormal:
    """M-step: rotations and scales by their steps, the mean, all aligned to it, and the covariance about it."""
    mean = _unit(found.aligned.mean(0), found.aligned)
    turn, factor = align_to_mean(found.aligned, mean)
    aligned = (found.aligned @ turn) * factor[:, None, None]
    return ProcrusteanNormal(
        mean,
        _second_moment(aligned - mean, found.rest, mean),
        rotation_matrix(found.steps[:, :3]) @ now.rotations @ turn,
        now.scales * found.steps[:, 3].exp() / factor,
        aligned,
    )


def _second_moment(away: Tensor, rest: Tensor, mean: Tensor) -> Tensor:
    """S (3N, 3N) of deviations (T, N, 3) and the sum of their covariances, in the directions that deform the mean."""
    tangent = procrustean_tangent(mean)
    vectors = _vector(away)
    moment = tangent @ ((vectors.mT @ vectors + rest) / len(vectors)) @ tangent
    return (moment + moment.mT) / 2


def align_to_mean(shapes: Tensor, mean: Tensor) -> tuple[Tensor, Tensor]:
    """Return the rotations Q (T, 3, 3) and factors a (T,) that align shapes with a mean: a Y Q . M = M . M.

    Args:
        shapes: Y (T, N, 3), centred.
        mean: M (N, 3), centred.

    Generalised Procrustes analysis (Gower 1975), with the scale that puts shapes on the mean's tangent space.
    """
    turn = nearest_rotation(shapes.mT @ mean)
    along = ((shapes @ turn) * mean).sum((1, 2)) / mean.square().sum()
    return turn, 1 / torch.maximum(along, LEAST * along.median().clamp_min(LEAST * along.amax()))


def procrustean_tangent(mean: Tensor) -> Tensor:
    """Return the projector (3N, 3N) onto the directions in which a shape deforms: it neither moves, turns nor grows.

    Args:
        mean: (N, 3), centred; vectors hold all x, then all y, then all z.

    >>> mean = torch.tensor([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    >>> round(procrustean_tangent(mean).trace().item())
    5
    """
    joints = len(mean)
    eye = torch.eye(3, dtype=mean.dtype, device=mean.device)
    moves = eye[:, None].expand(3, joints, 3)
    turns = torch.linalg.cross(moves, mean.expand(3, joints, 3))
    rigid = _vector(torch.cat([moves / joints**0.5, turns, mean[None]]))  # (7, 3N)
    value, vector = torch.linalg.eigh(rigid @ rigid.mT)  # two or three joints, or joints on a line, have fewer
    kept = value > 1e-12 * value[-1]
    basis = (vector / torch.where(kept, value, torch.ones_like(value)).sqrt() * kept).mT @ rigid
    return torch.eye(3 * joints, dtype=mean.dtype, device=mean.device) - basis.mT @ basis


def _freed(values: Tensor, root: Tensor, unit: Tensor) -> Tensor:
    """Weigh the joints (last dimension) and take off the translation that fits best."""
    weighed = values * root[:, None]
    return weighed - unit[:, None] * (unit[:, None] * weighed).sum(-1, keepdim=True)


def _vector(points: Tensor) -> Tensor:
    """(T, N, 3) as (T, 3N): all x, all y, all z."""
    return points.mT.flatten(1)


def _unit(mean: Tensor, shapes: Tensor) -> Tensor:
    """A mean of unit norm; a shape in place of a mean that vanishes."""
    size = torch.linalg.vector_norm(mean)
    first = shapes[torch.linalg.vector_norm(shapes, dim=(1, 2)).argmax()]
    vague = size <= 1e-9 * torch.linalg.vector_norm(first)
    return torch.where(vague, first / torch.linalg.vector_norm(first), mean / torch.where(vague, 1, size))
