"""Expectation maximisation of a Procrustean normal distribution from 2D tracks."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from kcs_torch.functional.rotation import rotation_matrix
from kcs_torch.methods.pnd.distribution import ProcrusteanNormal, align_to_mean, second_moment, unit_mean

__all__ = ["Expectation", "expect", "fit_procrustean_normal", "freed", "maximise"]

CHUNK = 32
"""Frames whose matrices are made at once: more would not stay in the processor's caches."""

FARTHEST = 0.2
"""Radians that a step may turn a frame by, at most, and the change of its log scale."""


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
    image = freed(tracks.mT, root, unit)  # (T, 2, N)
    power = image.square().sum() / (2 * weights.sum())
    least = final * power + torch.finfo(tracks.dtype).tiny
    level = noise * start.covariance.diagonal().mean() * start.scales.square().mean()
    level = torch.maximum(level, least)
    count = 2 * ((weights > 0).sum(1) - 1).clamp_min(0)
    now, history, damping = start, [], 1e-3
    found = expect(now, image, root, unit, count, level, damping)
    history.append(found.likelihood)
    change = math.inf
    for _ in range(num_steps):
        after = torch.maximum(found.noise, least)
        after = torch.where(after < level, torch.maximum(after, fall * level), after)
        trial = maximise(now, found)
        result = expect(trial, image, root, unit, count, after, damping)
        if not bool(result.likelihood >= found.likelihood):  # NaN, too: the plain M-step cannot fall
            damping = min(damping * 10, 1e6)
            trial = replace(now, covariance=second_moment(found.aligned - now.mean, now.mean, found.rest))
            result = expect(trial, image, root, unit, count, after, damping)
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
class Expectation:
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


def expect(
    now: ProcrusteanNormal, image: Tensor, root: Tensor, unit: Tensor, count: Tensor, level: Tensor, damping: float
) -> Expectation:
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
            across = freed(across.mT, soft[:, None], axis[:, None]).mT
        across = across.reshape(chunk, size, three)  # P S
        square = camera[:, None] @ across.view(chunk, size, 3, joints)  # (t, 2N, 2, N)
        if even:
            square = square * soft[0, 0].square()
            across = across * soft[0, 0]
        else:
            square = freed(square, soft[:, None], axis[:, None])
        square = square.reshape(chunk, size, size) + level * eye
        factor, info = torch.linalg.cholesky_ex(square)
        whiten = torch.linalg.solve_triangular(factor, eye.expand_as(factor), upper=False)  # G = L L^T, this is L^-1
        off = image[index] - freed(camera @ mean, soft, axis)
        white = whiten @ off.reshape(chunk, size, 1)
        gain = whiten @ across
        posterior = mean + (gain.mT @ white).view(chunk, 3, joints)
        likelihood = -white.square().sum((1, 2)) / 2 - factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        likelihood = torch.where(info == 0, likelihood, -torch.inf) + (size - count[index]) / 2 * level.log()
        # Gradient in the camera's rows: G^-1 ((w - P M) Y^T - P S), summed over joints.
        free = whiten.view(chunk, size, 2, joints)  # L^-1, back before the weights and the loss of the translation
        free = soft[:, None, None] * (free - axis[:, None, None] * (axis[:, None, None] * free).sum(-1, keepdim=True))
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
    return Expectation(likelihood.sum(), posterior.mT, frames * now.covariance - inner, step, noise)


def maximise(now: ProcrusteanNormal, found: Expectation) -> ProcrusteanNormal:
    """M-step: rotations and scales by their steps, the mean, all aligned to it, and the covariance about it."""
    mean = unit_mean(found.aligned.mean(0), found.aligned)
    turn, factor = align_to_mean(found.aligned, mean)
    aligned = (found.aligned @ turn) * factor[:, None, None]
    return ProcrusteanNormal(
        mean,
        second_moment(aligned - mean, mean, found.rest),
        rotation_matrix(found.steps[:, :3]) @ now.rotations @ turn,
        now.scales * found.steps[:, 3].exp() / factor,
        aligned,
    )


def freed(values: Tensor, root: Tensor, unit: Tensor) -> Tensor:
    """Weigh the joints (last dimension) and take off the translation that fits best."""
    weighed = values * root[:, None]
    return weighed - unit[:, None] * (unit[:, None] * weighed).sum(-1, keepdim=True)
