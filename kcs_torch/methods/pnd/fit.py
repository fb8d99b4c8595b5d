"""Expectation maximisation of Procrustean normal distributions from 2D tracks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from typing import TypeVar

import torch
from torch import Tensor

from kcs_torch.functional.rotation import rotation_matrix
from kcs_torch.methods.pnd.distribution import ProcrusteanNormal, align_to_mean, second_moment, unit_mean

__all__ = ["Expectation", "Image", "expect", "fit_procrustean_normal", "maximise"]

CHUNK, GPU_CHUNK = 1024, 32 * 1024
"""Joints of the frames whose matrices are made at once: on a processor more would not stay in its caches."""

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
) -> tuple[ProcrusteanNormal, Tensor, Tensor]:
    """Fit Procrustean normal distributions to 2D tracks by EM; no likelihood falls in any step but one undone next.

    E-step: with the tracks w = P vec(Y) + e, e ~ N(0, s I / weight), P the two rows of c R for each joint, and any
    translation, the posterior of Y has the mean M + K (w - P M) and covariance S - K P S, K = S P^T G^-1,
    G = P S P^T + s I. M-step: s; M, onto which the posterior means are aligned; S, the second moment about it, in the
    directions that deform. R and c move by a Gauss-Newton step on the likelihood of their frame, as the expectation of
    the complete likelihood tells nothing of them where there is little noise.

    Args:
        tracks: w (K, T, N, 2) of K clips, finite.
        weights: (K, T, N), 0 where unseen; 1 is the noise's own variance. Frames without any, behind the others, are
            padding.
        start: to start from, of K clips.
        num_steps: EM steps.
        noise: first s, a share of the deformation's variance.
        final: least s, a share of the tracks' variance.
        fall: s falls by no more than this factor in a step.

    Returns:
        The fits, with posterior means as their shapes; the log-likelihoods (num_steps + 1, K) at the start and after
        each step; and the share of each clip's shapes that its last step changed (K,). A clip whose likelihood is no
        number after a step ends before it; fewer steps are made when all have ended.
    """
    data = Image.of(tracks, weights)
    power = data.values.square().sum((1, 2, 3)) / (2 * weights.sum((1, 2)))
    least = final * power + torch.finfo(tracks.dtype).tiny
    deformation = start.covariance.diagonal(dim1=1, dim2=2).mean(1)
    level = torch.maximum(noise * deformation * start.scales.square().sum(1) / data.frames, least)
    damping, change = torch.full_like(level, 1e-3), torch.full_like(level, torch.inf)
    now, found = start, expect(start, data, level, damping)
    history, going = [found.likelihood], torch.ones_like(level, dtype=torch.bool)
    for _ in range(num_steps):
        after = torch.maximum(found.noise, least)
        after = torch.where(after < level, torch.maximum(after, fall * level), after)
        trial = maximise(now, found, data.inside)
        result = expect(trial, data, after, damping)
        worse = ~(result.likelihood >= found.likelihood)  # NaN, too: the plain M-step cannot fall
        damping = torch.where(worse, (damping * 10).clamp_max(1e6), (damping / 3).clamp_min(1e-4))
        undone = (worse & going).nonzero().flatten()
        if len(undone):
            plain, last, image = _some(now, undone), _some(found, undone), _some(data, undone)
            moment = second_moment(last.aligned, plain.mean, image.inside, last.rest)
            plain = replace(plain, covariance=moment)
            trial = _put(trial, undone, plain)
            result = _put(result, undone, expect(plain, image, after[undone], damping[undone]))
        going = going & result.likelihood.isfinite()
        ended = (~going).nonzero().flatten()
        if len(ended) == len(going):
            break
        if len(ended):
            trial, result = _put(trial, ended, _some(now, ended)), _put(result, ended, _some(found, ended))
        before = now.scales[..., None, None] * (found.aligned @ now.rotations.mT)
        now, found, level = trial, result, after
        shape = now.scales[..., None, None] * (found.aligned @ now.rotations.mT)
        moved = torch.linalg.vector_norm(shape - before, dim=(1, 2, 3))
        change = torch.where(going, moved / torch.linalg.vector_norm(shape, dim=(1, 2, 3)), change)
        history.append(found.likelihood)
    return replace(now, aligned=found.aligned), torch.stack(history), change


@dataclass(frozen=True)
class Image:
    """Tracks of K clips, each frame weighed, which makes noise white, and without its translation.

    Attributes:
        values: (K, T, 2, N), 0 in the padding.
        root: square roots of the weights (K, T, N); some that are not all 0 in the padding.
        unit: the same (K, T, N), of norm 1 in each frame.
        count: numbers (K, T) that a frame tells.
        inside: (K, T), False in the padding.
        frames: (K,) that are no padding.
    """

    values: Tensor
    root: Tensor
    unit: Tensor
    count: Tensor
    inside: Tensor
    frames: Tensor

    @classmethod
    def of(cls, tracks: Tensor, weights: Tensor) -> Image:
        """Of tracks (K, T, N, 2) and their weights (K, T, N), all 0 in the padding and nowhere else."""
        inside = (weights > 0).any(-1)
        root = torch.where(inside[..., None], weights, weights[:, :1]).sqrt()
        unit = root / torch.linalg.vector_norm(root, dim=-1, keepdim=True)
        values = freed(tracks.mT.contiguous() * root[..., None, :], unit)
        count = 2 * ((weights > 0).sum(-1) - 1).clamp_min(0)
        return cls(torch.where(inside[..., None, None], values, 0), root, unit, count, inside, inside.sum(-1))


@dataclass(frozen=True)
class Expectation:
    """What the E-step finds.

    Attributes:
        likelihood: log p(tracks) of each clip (K,), but for a constant.
        aligned: posterior means (K, T, N, 3), 0 in the padding.
        rest: sum over a clip's frames of the posterior covariances (K, 3N, 3N).
        steps: (K, T, 4) by which rotations (camera's frame) and log scales should move.
        noise: the variance (K,) that the M-step gives it.
    """

    likelihood: Tensor
    aligned: Tensor
    rest: Tensor
    steps: Tensor
    noise: Tensor


def expect(now: ProcrusteanNormal, data: Image, level: Tensor, damping: Tensor) -> Expectation:
    """E-step, a few frames at a time, and the Gauss-Newton step of each frame's rotation and scale.

    Args:
        now: of K clips; scales are 0 in the padding, which takes part in nothing then.
        data: of K clips.
        level: s (K,).
        damping: of the Gauss-Newton steps (K,), a share of the normal matrix's diagonal.
    """
    clips, frames, _, joints = data.values.shape
    size, three = 2 * joints, 3 * joints
    mean, covariance = now.mean.mT.contiguous(), now.covariance.reshape(clips, 3, -1)
    pairs = covariance.view(clips, 3, joints, 3, joints).transpose(2, 3).reshape(clips, 9, -1)
    axes = torch.eye(3, dtype=mean.dtype, device=mean.device)
    spin = -torch.linalg.cross(axes[:, None].expand(3, 3, 3), axes[None].expand(3, 3, 3), dim=-1)  # (3, 3, 3)
    eye = torch.eye(size, dtype=mean.dtype, device=mean.device)
    inner = torch.zeros_like(now.covariance)
    aligned, steps = mean.new_zeros(clips, frames, 3, joints), mean.new_zeros(clips, frames, 4)
    likelihood, miss = mean.new_zeros(2, clips, frames)
    levels, dampings = level[:, None].expand(clips, frames), damping[:, None].expand(clips, frames)
    most = (CHUNK if mean.device.type == "cpu" else GPU_CHUNK) // joints
    for clip, time in _blocks(data.frames.tolist(), max(1, most)):
        some = clip, time
        few, span = data.count[some].shape
        chunk = few * span
        turn, image, soft, axis = (x[some].flatten(0, 1) for x in (now.rotations, data.values, data.root, data.unit))
        scale, here, damp = (x[some].reshape(chunk, 1, 1) for x in (now.scales, levels, dampings))
        even = bool((soft == soft[:, :1]).all())  # then nothing weighs a frame's image, and S has no translation
        camera = scale * turn[:, :2]  # (t, 2, 3)
        rows = camera.view(few, -1, 3)
        across = (rows @ covariance[clip]).view(chunk, size, three)  # P S
        square = _image_covariance(camera, pairs[clip], soft, axis, even) + here * eye
        factor, info = torch.linalg.cholesky_ex(square)
        whiten = torch.linalg.solve_triangular(factor, eye.expand_as(factor), upper=False)  # G = L L^T, this is L^-1
        # Applied to an image as it is: weighed, without its translation, and white.
        free = whiten.view(chunk, size, 2, joints)
        free = ((free if even else freed(free, axis[:, None])) * soft[:, None, None]).view(chunk, size, size)
        off = image - freed((rows @ mean[clip]).view(chunk, 2, joints) * soft[:, None], axis)
        white = whiten @ off.view(chunk, size, 1)
        gain = free @ across
        posterior = ((gain.mT @ white).view(few, span, 3, joints) + mean[clip, None]).flatten(0, 1)
        told = -white.square().sum((1, 2)) / 2 - factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        likelihood[some] = torch.where(info == 0, told, -torch.inf).view(few, span)
        ways = torch.cat([(scale[:, None] * (spin @ turn[:, None]))[:, :, :2], camera[:, None]], 1)  # (t, 4, 2, 3)
        gradient, moves = _slopes(ways, free, white, gain, posterior)
        steps[some] = _gauss_newton(gradient, moves, damp).view(few, span, 4)
        miss[some] = ((whiten.mT @ white).square().sum((1, 2)) - whiten.square().sum((1, 2))).view(few, span)
        aligned[some] = posterior.view(few, span, 3, joints)
        flat = gain.view(few, -1, three)
        inner[clip] += flat.mT @ flat
    far = torch.linalg.vector_norm(steps, dim=-1, keepdim=True)
    steps = torch.where(far.isfinite(), steps * (FARTHEST / far.clamp_min(FARTHEST)), 0)
    likelihood = likelihood + (size - data.count) / 2 * levels.log()
    noise = level * data.frames * size + level.square() * torch.where(data.inside, miss, 0).sum(1)
    return Expectation(
        torch.where(data.inside, likelihood, 0).sum(1),
        torch.where(data.inside[..., None, None], aligned, 0).mT,
        data.frames[:, None, None] * now.covariance - inner,
        steps,
        noise / data.count.sum(1).clamp_min(1),
    )


def _image_covariance(camera: Tensor, pairs: Tensor, soft: Tensor, axis: Tensor, even: bool) -> Tensor:
    """P S P^T (t, 2N, 2N) of weighed images without their translation.

    Args:
        camera: (t, 2, 3) the two rows of c R in each frame.
        pairs: (k, 9, N N) covariances by pairs of axes, of the k clips that the frames belong to, as many to each.
        soft: (t, N) square roots of the weights.
        axis: (t, N) the same, of norm 1.
        even: whether the weights of each frame are all the same; then S has no translation.
    """
    chunk, joints = soft.shape
    twice = camera[:, :, None, :, None] * camera[:, None, :, None, :]
    square = (twice.view(len(pairs), -1, 9) @ pairs).view(chunk, 2, 2, joints, joints)
    if even:
        square = square * soft[:, :1, None, None, None].square()
    else:
        for _ in range(2):  # from both sides
            square = freed(square * soft[:, None, None, None], axis[:, None, None]).mT
    return square.transpose(2, 3).reshape(chunk, 2 * joints, 2 * joints)


def _slopes(ways: Tensor, free: Tensor, white: Tensor, gain: Tensor, posterior: Tensor) -> tuple[Tensor, Tensor]:
    """Gradient (t, 4) of frames' likelihoods, and derivatives (t, 2N, 4) of their white images.

    Args:
        ways: (t, 4, 2, 3) by which the two rows of c R may move: three turns, and growth.
        free: L^-1 (t, 2N, 2N), which makes images white; G = L L^T.
        white: L^-1 (w - P M) (t, 2N, 1).
        gain: L^-1 P S (t, 2N, 3N).
        posterior: means Y (t, 3, N).
    """
    chunk, _, joints = posterior.shape
    # In the camera's rows: G^-1 ((w - P M) Y^T - P S), summed over joints.
    pull = (free.mT @ white).view(chunk, 2, joints)
    left = free.view(chunk, -1, 2, joints).transpose(1, 2).reshape(chunk, 2, -1)
    right = gain.view(chunk, -1, 3, joints).transpose(1, 2).reshape(chunk, 3, -1)
    slope = pull @ posterior.mT - left @ right.mT
    moves = free @ (ways.view(chunk, 8, 3) @ posterior).view(chunk, 4, -1).mT
    return (slope[:, None] * ways).sum((2, 3)), moves


def _gauss_newton(gradient: Tensor, moves: Tensor, damping: Tensor) -> Tensor:
    """Steps (t, 4, 1) by gradients (t, 4), derivatives (t, 2N, 4) of white images and dampings (t, 1, 1)."""
    normal = moves.mT @ moves
    normal = normal + (damping * normal + 1e-9) * torch.eye(4, dtype=normal.dtype, device=normal.device)
    solver, _ = torch.linalg.cholesky_ex(normal)
    return torch.cholesky_solve(gradient[..., None], solver)


def maximise(now: ProcrusteanNormal, found: Expectation, inside: Tensor) -> ProcrusteanNormal:
    """M-step: rotations and scales by their steps, the mean, all aligned to it, and the covariance about it."""
    mean = unit_mean(found.aligned)
    turn, factor = align_to_mean(found.aligned, mean, inside)
    aligned = (found.aligned @ turn) * factor[..., None, None]
    return ProcrusteanNormal(
        mean,
        second_moment(aligned, mean, inside, found.rest),
        rotation_matrix(found.steps[..., :3]) @ now.rotations @ turn,
        now.scales * found.steps[..., 3].exp() / factor,
        aligned,
    )


def freed(weighed: Tensor, unit: Tensor) -> Tensor:
    """Take the translation that fits best off joints (last dimension) that are weighed."""
    return weighed - unit[..., None, :] * (unit[..., None, :] * weighed).sum(-1, keepdim=True)


def _blocks(counts: list[int], most: int) -> Iterator[tuple[slice, slice]]:
    """All frames of clips, no more than ``most`` at once: of one clip, or of neighbours that are short."""
    few = max(1, most // max(counts))
    for first in range(0, len(counts), few):
        longest = max(counts[first : first + few])
        for begin in range(0, longest, most // few):
            yield slice(first, first + few), slice(begin, min(begin + most // few, longest))


Record = TypeVar("Record", ProcrusteanNormal, Image, Expectation)


def _some(record: Record, index: Tensor) -> Record:
    """Some of the clips, (k,) of their numbers."""
    return type(record)(*(getattr(record, field.name)[index] for field in fields(record)))


def _put(record: Record, index: Tensor, values: Record) -> Record:
    """The clips (k,) of ``index`` replaced."""
    pairs = ((getattr(record, field.name), getattr(values, field.name)) for field in fields(record))
    return type(record)(*(whole.index_copy(0, index, part) for whole, part in pairs))
