"""KCS's shape step as a layer: the same functions as :class:`kcs_torch.KCS`."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from kcs_torch.errors import OptionError, ShapeError
from kcs_torch.functional.chain import bone_lengths, bone_vectors, chain_inverse, incidence
from kcs_torch.functional.guarded import or_one
from kcs_torch.functional.precision import full_precision, narrow, wide
from kcs_torch.functional.shapes import broadcast_shapes
from kcs_torch.functional.weights import known
from kcs_torch.nn.deviation import (
    Arrangement,
    deviation_goal,
    deviation_scale,
    deviation_step,
    frame_scales,
    template_scale,
    told_scales,
)
from kcs_torch.nn.masks import clear_padding
from kcs_torch.nn.reprojection import centred_residual
from kcs_torch.nn.steps import continuation
from kcs_torch.nn.unrolled.base import Gradient, Unrolled, row_length
from kcs_torch.skeleton import Skeleton, get_skeleton
from kcs_torch.solvers.iterate import Solution
from kcs_torch.solvers.pose import CameraFit, fit_cameras, steady_cameras

__all__ = ["UnrolledKCS"]


class UnrolledKCS(Unrolled):
    """``num_steps`` steps of KCS's shape: a template's bones plus a deviation of least nuclear norm.

    Args:
        skeleton: a :class:`Skeleton`, a built-in name or a file.
        num_steps: steps; each has its own step size and threshold.
        template: rest pose, N positions (x right, y down, z away), any unit; the skeleton's if None.
        links: extra rigid links as pairs of joint names; they may close chains.
        arrangement: "stacked" (3T x B, as printed) or "frames" (T x 3B), as in :class:`kcs_torch.KCS`.
        mu: first threshold, a share of the data's largest singular value.
        final: last threshold; between them they fall geometrically.
        tau: step size.
        momentum: as in :class:`UnrolledFPC`; the method has none.
        scale_range: factor by which a frame's scale may leave the clip's, where scales are not given; the bounds that
            follow are constants of the derivative.
        lengths: relative bone lengths that the template's bones are brought to; the template's own if None.
        learnable: as in :class:`UnrolledFPC`.
        learnable_lengths: the relative lengths of the template's bones are parameters, too.
        grad_steps: as in :class:`UnrolledFPC`.
        gradient: as in :class:`UnrolledFPC`.

    Raises:
        OptionError: a number is out of range.
        ShapeError: the template does not fit the skeleton.
        SkeletonError: the skeleton is unknown, or there is no template.

    Wandt, Ackermann, Rosenhahn 2018, Algorithm 1.

    >>> layer = UnrolledKCS("h36m17", num_steps=5)
    >>> tracks = torch.randn(20, 17, 2)
    >>> cameras, scales = layer.find_cameras(tracks)
    >>> layer(tracks, cameras, scales=scales).shape
    torch.Size([20, 17, 3])
    """

    raw_threshold: Tensor
    raw_step: Tensor
    rest: Tensor
    bones: Tensor
    rigid: Tensor
    matrix: Tensor
    inverse: Tensor

    def __init__(
        self,
        skeleton: str | Path | Skeleton,
        num_steps: int = 10,
        *,
        template: Sequence[Sequence[float]] | Tensor | None = None,
        links: Iterable[tuple[str, str]] = (),
        arrangement: Arrangement = "stacked",
        mu: float = 0.5,
        final: float = 3e-5,
        tau: float = 1.0,
        momentum: float = 0.0,
        scale_range: float = 1.1,
        lengths: Sequence[float] | None = None,
        learnable: bool = True,
        learnable_lengths: bool = False,
        grad_steps: int | None = None,
        gradient: Gradient = "unrolled",
    ) -> None:
        super().__init__(
            num_steps, momentum=momentum, learnable=learnable, grad_steps=grad_steps, gradient=gradient,
            mu=mu, final=final, tau=tau, scale_range=scale_range,
        )  # fmt: skip
        if not 0 < tau < math.inf or not scale_range >= 1 or arrangement not in ("stacked", "frames"):
            raise OptionError(
                "UnrolledKCS: expected tau > 0 (finite), scale_range >= 1 and arrangement 'stacked' or 'frames', "
                f"got {tau}, {scale_range} and {arrangement!r}"
            )
        self.skeleton = get_skeleton(skeleton)
        body = (self.skeleton.with_links(links) if links else self.skeleton).connected()
        self.arrangement, self.scale_range = arrangement, scale_range
        rest, bones = self._rest_pose(template), body.bone_index()
        matrix = incidence(bones, body.num_joints, dtype=torch.float64)
        buffers = {
            "rest": rest - rest.mean(0),
            "bones": bones,
            "rigid": self.skeleton.bone_index()[list(self.skeleton.rigid)],
            "matrix": matrix,
            "inverse": chain_inverse(matrix),
        }
        for name, value in buffers.items():
            self.register_buffer(name, value, persistent=False)
        self._positive("threshold", continuation(num_steps, mu, final))
        self._positive("step", [tau] * num_steps)
        own = bone_lengths(rest, bones).clamp_min(1e-12).tolist()
        self._hold_lengths(body, own if lengths is None and learnable_lengths else lengths, learnable_lengths)

    def _rest_pose(self, template: Sequence[Sequence[float]] | Tensor | None) -> Tensor:
        """The template (N, 3) as it is given, or the skeleton's."""
        if template is None:
            rest = self.skeleton.template_points(dtype=torch.float64)
        else:
            rest = torch.as_tensor(template, dtype=torch.float64)
        if rest.shape != (self.skeleton.num_joints, 3) or not bool(rest.isfinite().all()):
            raise ShapeError(
                f"UnrolledKCS: template: expected {self.skeleton.num_joints} finite positions (x, y, z) for skeleton "
                f"'{self.skeleton.name}', got shape {tuple(rest.shape)}"
            )
        return rest

    def template(self, like: Tensor) -> Tensor:
        """The rest pose (N, 3), centred, with the module's bone lengths, in the dtype of ``like``."""
        rest = self.rest.to(like)
        if not self.has_lengths:
            return rest
        vectors = bone_vectors(rest, self.bones)
        own = vectors.norm(dim=-1)
        factor = self._lengths(like) * own.mean() / or_one(own)
        return self.inverse.to(like) @ (factor[:, None] * vectors)

    def find_cameras(
        self,
        tracks: Tensor,
        *,
        weights: Tensor | None = None,
        inside: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Fit cameras to the template seen in each frame, as :class:`kcs_torch.KCS` does in its first round.

        Args:
            tracks: (..., T, N, 2), NaN where unseen.
            weights: (..., T, N), 0 where unseen.
            inside: (..., T), False in padding, as of :meth:`UnrolledFPC.forward`.

        Returns:
            Camera rows (..., T, 2, 3) and scales (..., T), constants for autograd; 0 in padding.

        Raises:
            ShapeError: the shapes do not fit.
        """
        weights = self._check(tracks, None, weights, None, self.skeleton, seek=True, inside=inside)
        with torch.no_grad(), full_precision(tracks):
            points, share = self._centred(wide(tracks), wide(weights))
            rest = self.template(points)
            low, high = self._bounds(points, share, rest, inside)
            frames = low.numel()  # each is a problem of its own
            flat = points.flatten(0, -3), rest.expand(frames, -1, -1), share.flatten(0, -2)
            fit = fit_cameras(*flat, low.flatten(), high.flatten())
            parts = (x.unflatten(1, low.shape) for x in (fit.rotations, fit.scales, fit.cost))
            rotations, scales = steady_cameras(CameraFit(*parts), inside=inside)
            rows, scales = clear_padding(rotations[..., :2, :], inside), clear_padding(scales, inside, 0)
            return rows.to(tracks.dtype), narrow(scales, tracks)

    def forward(
        self,
        tracks: Tensor,
        cameras: Tensor,
        *,
        scales: Tensor | None = None,
        weights: Tensor | None = None,
        start: Tensor | None = None,
        inside: Tensor | None = None,
    ) -> Tensor:
        """Return the shape in the world frame of the cameras, which is the template's.

        Args:
            tracks: (..., T, N, 2), NaN where unseen.
            cameras: (..., T, 2, 3), from :meth:`find_cameras`, say.
            scales: (..., T) image length of the template's unit; by least squares if None.
            weights: (..., T, N), 0 where unseen.
            start: (..., T, N, 3), in the unit of the tracks; the template if None.
            inside: (..., T), False in padding, as of :meth:`UnrolledFPC.forward`. Under ``torch.compile`` and
                ``torch.func.vmap`` give ``scales`` with it.

        Returns:
            (..., T, N, 3), in the unit of the tracks at the clip's mean scale.

        Raises:
            ShapeError: the shapes do not fit.

        Warns:
            ConvergenceWarning: with the implicit gradient, in the backward pass.
        """
        return self.solve(
            tracks, cameras, scales=scales, weights=weights, start=start, inside=inside, measure=False
        ).value

    def solve(
        self,
        tracks: Tensor,
        cameras: Tensor,
        *,
        scales: Tensor | None = None,
        weights: Tensor | None = None,
        start: Tensor | None = None,
        inside: Tensor | None = None,
        measure: bool = True,
    ) -> Solution[Tensor]:
        """As :meth:`forward`, as a :class:`kcs_torch.solvers.Solution`.

        With ``measure`` it tells whether the last step stood still, which waits for the device.
        """
        weights = self._check(tracks, cameras, weights, start, self.skeleton, scales=scales, inside=inside)
        with full_precision(tracks):
            points, share = self._centred(wide(tracks), wide(weights))
            rows, rest = clear_padding(wide(cameras), inside), self.template(points)
            length = row_length(rows, of_clip=True)
            points, rows = points / length, rows / length
            share = share.expand(points.shape[:-1])
            threshold, step = self._values("threshold", points), self._step_sizes(share, rows)
            matrix, inverse = self.matrix.to(points), self.inverse.to(points)
            scales, size = self._scales(scales, points, rows, share, rest, inside)
            given = (deviation_goal(rest, points / or_one(scales)[..., None, None], rows, share), rows, share)
            top = deviation_scale(*given, matrix=matrix, arrangement=self.arrangement)
            if start is None:
                batch = broadcast_shapes(points.shape[:-3], rows.shape[:-3], scales.shape[:-1])
                begin = points.new_zeros(*batch, points.shape[-3], 3, len(self.bones))
            else:
                start = clear_padding(start, inside).to(points.dtype)
                begin = clear_padding(bone_vectors(start / or_one(size) - rest, self.bones).mT, inside)
            solution = self._run(
                lambda state, k: deviation_step(
                    state, *given, threshold[k] * top, step[k],
                    matrix=matrix, inverse=inverse, arrangement=self.arrangement,
                ),
                begin,
                measure=measure,
                depends_on=(tracks, cameras, weights, scales),
            )  # fmt: skip
            value = clear_padding(size * (rest + (solution.value @ inverse.mT).mT), inside)
        return Solution(narrow(value, tracks), solution.converged, solution.iterations)

    def _scales(
        self, scales: Tensor | None, points: Tensor, rows: Tensor, weights: Tensor, rest: Tensor, inside: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Scales (..., T), those given or the best, and their mean (..., 1, 1, 1)."""
        if scales is None:
            with torch.no_grad():
                low, high = self._bounds(points, weights, rest, inside)
            scales = told_scales(frame_scales(rest, points, rows, weights, low, high), weights)
        scales = scales.to(points.dtype)
        if inside is None:
            size = scales.mean(-1)
        else:
            scales = clear_padding(scales, inside, 0)
            size = scales.sum(-1) / inside.sum(-1).clamp_min(1)
        return scales, size[..., None, None, None]

    def _centred(self, tracks: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
        """Tracks about the seen joints' middle, 0 where unseen, and weights (..., T, N)."""
        points = known(tracks, weights)
        points = known(-centred_residual(torch.zeros_like(points), points, weights), weights)
        return points, weights.expand(points.shape[:-1])

    def _bounds(
        self, points: Tensor, weights: Tensor, rest: Tensor, inside: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Least and greatest scale (..., T)."""
        if inside is None:
            scale = template_scale(points, weights, rest, self.rigid)
        else:
            scale = torch.ones_like(weights[..., 0])
            for at in _clips(weights, inside):
                if len(points[at]):
                    scale[at] = template_scale(points[at], weights[at], rest, self.rigid)
        if self.scale_range == math.inf:
            return torch.zeros_like(scale), torch.full_like(scale, math.inf)
        return scale / self.scale_range, scale * self.scale_range


def _clips(weights: Tensor, inside: Tensor | None) -> Iterator[tuple[Any, ...]]:
    """What takes the frames of each clip from what has weights (..., T, N), one clip after another."""
    real = None if inside is None else inside.expand(weights.shape[:-1])
    for clip in itertools.product(*map(range, weights.shape[:-2])):
        yield (*clip, slice(None) if real is None else real[clip])
