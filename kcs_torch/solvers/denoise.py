"""2D tracks without noise, gaps and outliers: an empirical Bayes smoother over time and joints together."""

from __future__ import annotations

import itertools
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from kcs_torch.errors import ShapeError
from kcs_torch.functional.shapes import check_floats
from kcs_torch.functional.temporal import blend_windows, interpolate, window_starts
from kcs_torch.functional.weights import known
from kcs_torch.solvers.completion import complete_tracks
from kcs_torch.solvers.spectrum import TINY, temporal_modes, unshared, white_power
from kcs_torch.solvers.stray import body_size, each_joint, far_off, stray_from_neighbours

__all__ = ["Denoised", "denoise_tracks"]

# Bands of temporal modes, each with its own covariance between joints: how joints sway together differs from how
# they twitch together. Modes 0..2 are the parabola of a window, mode i has about i/2 periods in it.
_BANDS = (0, 3, 6, 12, 24, 48)
_NEIGHBOUR = 0.3  # what the modes of the next band count in a band's covariance
_PRIOR_SAMPLES = 10.0  # modes' worth of belief that joints move independently
# Estimates and conjugate gradient steps before outliers are judged, and again after: most by the last.
_ROUNDS = ((2, 40), (1, 40), (1, 60))
_CHUNK = 256  # windows solved at once: bounds memory
# Of the body's size: below it nothing is gained, and gaps would converge more slowly.
_LEAST_NOISE = 1e-3
# Noise that lasts for several frames is told where joints do not share the first part of a band's deviation, and surely
# where not the second.
_LASTS = (0.08, 0.13)
_MORE = 2.0  # power of noise that lasts, over what can be told of it


class Denoised(NamedTuple):
    """What :func:`denoise_tracks` finds.

    Attributes:
        points: (..., T, N, 2) smoothed and filled tracks, in the tracks' units.
        weights: (..., T, N) as given, 0 at outliers.
        noise: (..., N) standard deviation of a coordinate's noise, white and lasting, in the tracks' units, at the
            usual weight of what is seen.
        outliers: (..., T, N), True where a seen joint was rejected and its place filled.
        left: (..., N) standard deviation of what the noise leaves in the points, by the model, were all joints seen.
    """

    points: Tensor
    weights: Tensor
    noise: Tensor
    outliers: Tensor
    left: Tensor


def denoise_tracks(
    tracks: Tensor, weights: Tensor, *, time: Tensor | None = None, window: int = 64, quick: int = 12
) -> Denoised:
    r"""Smooth 2D tracks, fill what is unseen and reject outliers; all parameters come from the clip itself.

    In windows of L frames, with temporal modes u_i (eigenvectors of the third-difference penalty, polynomials first),
    the tracks' coordinates x_i = u_i^T X about their mean follow a Gaussian, and measurements add white noise and noise
    that lasts for several frames, as a filter's or a detector's does:

        x_i ~ N(0, g_i Q_b(i)),    y_tn = x_tn + r_tn + e_tn,    r_i ~ N(0, c_i I),    e_tn ~ N(0, s^2 / w_tn I_2)

    g_i is the clip's spectrum and Q_b its covariance between the 2N coordinates, for every band b of modes, both
    estimated from the clip (moments, with shrinkage to independent joints). s^2 is the level at which the spectrum
    stops falling, unless joints move together there, and at least what quick modes do not share: clean tracks come back
    as they are but for their own jitter. Joints that are seen less than half as often as any do not count there, as
    what fills their gaps has no noise, and would make that of the others seem less. c_i is twice what the modes of a
    band do not share beyond s^2, where that is more than motion leaves unshared, about a tenth of the band's deviation;
    slower modes, which motion fills, have what quicker ones tell. Given these, v = x + r is the minimum of sum w_tn
    |y_tn - v_tn|^2 / s^2 + sum_i v_i^T (g_i Q_b + c_i)^-1 v_i, by conjugate gradients with the solution for even
    weights as preconditioner, and x_i = g_i Q_b (g_i Q_b + c_i)^-1 v_i. Cost is linear in T.

    A joint is an outlier where it is further from what the rest of the clip predicts than six times the usual distance
    (the median of the joint's clip, or up to four times that where its surroundings have more) plus .04 of the body's
    size, the median distance of its joints from their centre: first from the nearest frames of the joint, then, twice,
    from the model without the joint itself.

    Args:
        tracks: (..., T, N, 2); NaN is unseen.
        weights: (..., T, N) in [0, 1], 0 where unseen, and so is what is below, or NaN.
        time: (..., T) of each frame, in frames, where some of a long gap were left out; else 0, 1, 2 ... It tells how
            far joints may move from frame to frame.
        window: L, frames solved together; windows overlap by half.
        quick: first mode that may tell noise that lasts from motion: mode i has about i / 2 periods in a window. People
            move together from 2 or 3 Hz on, which is mode 12 of 64 frames at 30 a second.

    Returns:
        :class:`Denoised`, a constant for autograd. Clips of fewer than 12 frames are only filled and cleared of
        outliers; of none, none.

    Raises:
        ShapeError: they are not of these shapes, or the tracks not in floating point.

    >>> time = torch.linspace(0, 6, 100, dtype=torch.float64)[:, None, None]
    >>> truth = torch.sin(time + torch.arange(8).reshape(4, 2)) * 100
    >>> noisy = truth + 5 * torch.randn(truth.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    >>> noisy[50, 2] += 200
    >>> found = denoise_tracks(noisy, torch.ones(100, 4))
    >>> found.outliers.nonzero().tolist(), bool((found.points - truth).square().mean().sqrt() < 2)
    ([[50, 2]], True)

    Garcia 2010 smooths gappy data by one spectrum in the same way; here the joints' covariance is added.
    """
    check_floats(tracks, "denoise_tracks: tracks", "T", "N", 2)
    shape = tracks.shape
    if not isinstance(weights, Tensor) or weights.shape != shape[:-1]:
        got = f"shape {tuple(weights.shape)}" if isinstance(weights, Tensor) else type(weights).__name__
        raise ShapeError(f"denoise_tracks: weights: expected a tensor of shape {tuple(shape[:-1])}, got {got}")
    if time is not None and time.shape != shape[:-2]:
        raise ShapeError(f"denoise_tracks: time: expected shape {tuple(shape[:-2])}, got {tuple(time.shape)}")
    weights = weights.detach()
    weights = torch.where((weights > 0) & tracks.isfinite().all(-1), weights, 0)  # False for NaN, too
    if not tracks.numel():
        none = tracks.new_zeros(*shape[:-3], shape[-2])
        return Denoised(tracks.detach(), weights, none, torch.zeros_like(weights, dtype=torch.bool), none)
    values = known(tracks.detach(), weights)
    values = values.reshape(-1, *shape[-3:]).double()  # (K, T, N, 2): the spectra span more than float32
    given = weights.reshape(values.shape[:-1]).double()
    size = body_size(values, given > 0)
    unit = torch.where(size > TINY, size, torch.ones_like(size))[:, None, None, None]
    values = values / unit
    frames, joints = values.shape[1], values.shape[2]
    length = min(window, frames)
    starts = window_starts(frames, length, length // 2)
    index = torch.tensor(starts, device=tracks.device)[:, None] + torch.arange(length, device=tracks.device)
    model = _Model(length, values, quick)

    judge = partial(stray_from_neighbours, time=None if time is None else time.reshape(values.shape[:2]))
    outliers = each_joint(judge, values, given > 0)
    points = values
    for last, (rounds, steps) in enumerate(_ROUNDS, start=1 - len(_ROUNDS)):
        live = torch.where(outliers, torch.zeros_like(given), given)
        if points is values:
            points = _fill(values, live > 0)
        mean = points.mean(1, keepdim=True)
        y, x = ((a - mean)[:, index].flatten(-2) for a in (values, points))  # (K, H, L, M), M = 2N
        w = live[:, index].repeat_interleave(2, -1)
        for _ in range(rounds):
            model.fit(y, x, w)
            parts = zip(y.split(_CHUNK, 1), x.split(_CHUNK, 1), w.split(_CHUNK, 1), strict=True)
            x = torch.cat([model.still(model.solve(*part, steps)) for part in parts], 1)
        points = blend_windows(x.unflatten(-1, (joints, 2)).movedim(0, 2), starts, frames).movedim(1, 0) + mean
        if last == 0:
            break
        error = (values - points).norm(dim=-1) / (1 - model.leverage()[:, None] * live).clamp_min(1e-3)
        outliers = each_joint(far_off, error, given > 0)
    noise, left = (
        (power.sqrt()[:, None] * unit[:, 0, 0]).expand(-1, joints).reshape(*shape[:-3], joints).to(tracks.dtype)
        for power in (model.white + model.lasting.mean(1), model.left)
    )
    return Denoised(
        (points * unit).reshape(shape).to(tracks.dtype),
        torch.where(outliers.reshape(weights.shape), torch.zeros_like(weights), weights),
        noise,
        outliers.reshape(weights.shape),
        left,
    )


class _Model:
    """The Gaussian of a clip's windows, (K, H, L, M) about the mean: K clips, H windows, L frames, M coordinates."""

    def __init__(self, length: int, like: Tensor, quick: int = 12) -> None:
        self.quick = quick
        self.basis = temporal_modes(length).to(like)
        edges = [*(b for b in _BANDS if b < length), length]
        self.bands = list(itertools.pairwise(edges))

    def fit(self, y: Tensor, x: Tensor, w: Tensor) -> None:
        """Estimate noise, spectrum and covariances from the measurements, filled by ``x`` where unseen."""
        windows, length, size = y.shape[1:]
        self.share = w.mean((1, 2, 3)).clamp_min(1e-3)[:, None, None, None]
        z = self.basis.mT @ (x + w * (y - x))
        each = w.mean(2)
        self.measured = white_power(z, each)
        self.noise = self.measured.clamp_min(_LEAST_NOISE**2)
        among = self.share.flatten()
        self.lasting = self._lasting(z, each)
        left = (self.noise[:, None] + self.lasting) * among[:, None]  # noise power in a mode
        order = torch.arange(1, length + 1, dtype=y.dtype, device=y.device)
        near = torch.exp(-0.5 * ((order.log()[:, None] - order.log()) / 0.15) ** 2)
        near = near / near.sum(1, keepdim=True)
        # Smoothed over neighbouring modes, relative to the i^-4 by which motion falls off.
        spectrum = (((z.square().mean((1, 3)) - left) * order**4) @ near.mT) / order**4
        spectrum = spectrum.clamp_min(1e-9 * left)
        trust = spectrum / (spectrum + left)  # (K, L)
        scaled = z * (trust / (spectrum + left)).sqrt()[:, None, :, None]
        scatter, count = [], []
        for a, b in self.bands:
            rows = scaled[:, :, a:b].flatten(1, 2)
            noise = windows * (trust * (1 - trust))[:, a:b].sum(1)
            scatter.append(rows.mT @ rows - noise[:, None, None] * torch.eye(size, dtype=y.dtype, device=y.device))
            count.append(windows * trust[:, a:b].square().sum(1)[:, None, None])
        self.axes, variances = [], []
        for j, (a, b) in enumerate(self.bands):
            share = [_NEIGHBOUR ** abs(k - j) for k in range(len(self.bands))]
            samples = sum((s * c for s, c in zip(share, count, strict=True)), torch.zeros_like(count[0]))
            both = sum((s * c for s, c in zip(share, scatter, strict=True)), torch.zeros_like(scatter[0]))
            alone = (both / samples.clamp_min(1e-9)).diagonal(dim1=-2, dim2=-1).clamp_min(0)
            alone = 0.9 * alone + 0.1 * alone.mean(-1, keepdim=True) + 1e-9
            both = (both + _PRIOR_SAMPLES * torch.diag_embed(alone)) / (samples + _PRIOR_SAMPLES)
            variance, axes = torch.linalg.eigh(both)
            variance = variance.clamp_min(1e-4 * alone.mean(-1, keepdim=True))
            variance = variance / variance.mean(-1, keepdim=True)
            self.axes.append(axes[:, None])
            variances.append(spectrum[:, a:b, None] * variance[:, None])
        motion = torch.cat(variances, 1).clamp_min(TINY)  # (K, L, M)
        white, lasting = self.noise[:, None, None], self.lasting[..., None]
        self.ratio = (white / (motion + lasting))[:, None]  # (K, 1, L, M)
        self.moving = (motion / (motion + lasting))[:, None]
        usual = w.sum((1, 2, 3)) / (w > 0).sum((1, 2, 3)).clamp_min(1)  # weight of what is seen
        self.white = self.measured / usual.clamp_min(1e-3)
        spoilt = self.white[:, None, None] + lasting
        self.left = (motion * spoilt / (motion + spoilt)).mean((1, 2))  # of the posterior

    def _lasting(self, z: Tensor, each: Tensor) -> Tensor:
        """Power (K, L) of noise in modes z (K, H, L, M) beyond white noise, of which each (K, H, M) is left.

        Quick modes tell it for slower ones, in which motion hides it.
        """
        white = level = self.measured
        out = []
        for a, b in reversed(self.bands):
            if a >= self.quick:
                part = z[:, :, a:b]
                own, surely = unshared(part, each)
                among = (surely * self.share.flatten() / part.square().mean((1, 2, 3)).clamp_min(TINY)).sqrt()
                noisy = ((among - _LASTS[0]) / (_LASTS[1] - _LASTS[0])).clamp(0, 1)
                known = torch.where(own.isfinite(), own, level)
                level = torch.lerp(torch.minimum(known, level), known, noisy)
            out.append((_MORE * (level - white).clamp_min(0))[:, None].expand(-1, b - a))
        return torch.cat(out[::-1], 1)

    def solve(self, y: Tensor, x: Tensor, w: Tensor, steps: int, tolerance: float = 1e-10) -> Tensor:
        """Minimise over x by preconditioned conjugate gradients, every window for itself, from the given x."""
        dot = lambda a, b: (a * b).sum((-1, -2), keepdim=True)  # noqa: E731
        apply = lambda v: w * v + self._from_modes(self.ratio * self._to_modes(v))  # noqa: E731
        even = lambda r: self._from_modes(self._to_modes(r) / (self.share + self.ratio))  # noqa: E731
        small = tolerance * dot(w * y, even(w * y)) + TINY
        rest = w * y - apply(x)
        towards = step = even(rest)
        energy = dot(rest, towards)
        for _ in range(steps):
            if bool((energy <= small).all()):
                break
            image = apply(step)
            # A window that has converged rests, so that what is beside it in the batch makes no difference.
            far = torch.where(energy > small, energy / dot(step, image).clamp_min(TINY**2), torch.zeros_like(energy))
            x, rest = x + far * step, rest - far * image
            towards = even(rest)
            before, energy = energy, dot(rest, towards)
            step = towards + energy / before.clamp_min(TINY**2) * step
        return x

    def still(self, x: Tensor) -> Tensor:
        """What of it is motion."""
        return self._from_modes(self.moving * self._to_modes(x)) if bool((self.lasting > 0).any()) else x

    def leverage(self) -> Tensor:
        """(K, N) mean weight of a joint's measurement in its own estimate."""
        gain = (1 / (1 + self.ratio))[:, 0]
        own = sum(
            (
                gain[:, a:b].sum(1, keepdim=True) @ v[:, 0].mT.square()
                for (a, b), v in zip(self.bands, self.axes, strict=True)
            ),
            torch.zeros_like(gain[:, :1]),
        )
        return own[:, 0].unflatten(-1, (-1, 2)).mean(-1) / gain.shape[1]

    def _to_modes(self, x: Tensor) -> Tensor:
        z = self.basis.mT @ x
        return torch.cat([z[:, :, a:b] @ v for (a, b), v in zip(self.bands, self.axes, strict=True)], 2)

    def _from_modes(self, z: Tensor) -> Tensor:
        x = torch.cat([z[:, :, a:b] @ v.mT for (a, b), v in zip(self.bands, self.axes, strict=True)], 2)
        return self.basis @ x


def _fill(values: Tensor, seen: Tensor) -> Tensor:
    """(K, T, N, 2) where to start in the gaps: joints go with the body, and about its centre with each other."""
    points = interpolate(values, seen)
    if bool(seen.all()):
        return points
    for _ in range(6):  # the centre is that of the filled joints
        centre = points.mean(2, keepdim=True)
        points = centre + interpolate(values - centre, seen)
    centre = points.mean(2, keepdim=True)
    return complete_tracks(values - centre, seen, num_steps=20) + centre
