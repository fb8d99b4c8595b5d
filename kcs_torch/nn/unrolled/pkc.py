"""PKC's energy of a moving viewpoint as a layer: majorise-minimise steps from given cameras."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor

from kcs_torch.errors import OptionError
from kcs_torch.functional.camera import complete_rotation
from kcs_torch.functional.guarded import or_one
from kcs_torch.functional.precision import full_precision, narrow
from kcs_torch.functional.shapes import broadcast_shapes
from kcs_torch.functional.weights import known
from kcs_torch.nn.majorise import majorise_step, turn_onto_mean
from kcs_torch.nn.masks import clear_padding
from kcs_torch.nn.reprojection import centred_residual
from kcs_torch.nn.steps import aimed_lengths, continuation, start_shape
from kcs_torch.nn.unrolled.base import Gradient, Unrolled, row_length
from kcs_torch.skeleton import Skeleton, get_skeleton
from kcs_torch.solvers.iterate import Solution

__all__ = ["UnrolledPKC"]


class UnrolledPKC(Unrolled):
    """``num_steps`` steps down PKC's energy: low-rank motion of aligned bones of constant length.

    :class:`kcs_torch.PKC` descends by L-BFGS with line searches, from many starts, which no layer can unroll. This one
    descends the same kind of energy from one start by majorise-minimise steps, one linear solve a frame each
    (:func:`kcs_torch.nn.majorise.majorise_step`), so it is not that method step by step; it needs cameras or a start
    that are roughly right.

    Args:
        skeleton: a :class:`Skeleton`, a built-in name or a file.
        num_steps: steps; each has its own scales.
        eps: first variance that the log-determinant does not look below, relative to tracks of root mean square 1.
        final: last variance; between them they fall geometrically.
        slack: standard deviation of a rigid bone's length, a share of the root of each step's ``eps``.
        noise: standard deviation of the tracks, relative to their root mean square.
        realign_from: share of the steps after which each frame, and its camera with it, is turned onto the mean pose,
            so that a body that turns costs nothing; 1 is none.
        lengths: as in :class:`UnrolledSfAM`.
        learnable: the scales of each step are parameters (positive through a softplus); else constants.
        learnable_lengths: as in :class:`UnrolledSfAM`.
        grad_steps: as in :class:`UnrolledFPC`.
        gradient: as in :class:`UnrolledFPC`.

    Raises:
        OptionError: a number is out of range.
        SkeletonError: the skeleton is unknown, or has no lengths where they are to be learned.

    >>> layer = UnrolledPKC("h36m17", num_steps=3)
    >>> cameras = torch.eye(3)[:2].expand(20, 2, 3)
    >>> layer(torch.randn(20, 17, 2), cameras, start=torch.randn(20, 17, 3)).shape
    torch.Size([20, 17, 3])
    """

    bones: Tensor
    rigid: Tensor
    raw_eps: Tensor
    raw_slack: Tensor
    raw_noise: Tensor

    def __init__(
        self,
        skeleton: str | Path | Skeleton,
        num_steps: int = 10,
        *,
        eps: float = 1e-1,
        final: float = 1e-5,
        slack: float = 1.0,
        noise: float = 0.01,
        realign_from: float = 0.5,
        lengths: Sequence[float] | None = None,
        learnable: bool = True,
        learnable_lengths: bool = False,
        grad_steps: int | None = None,
        gradient: Gradient = "unrolled",
    ) -> None:
        super().__init__(
            num_steps, momentum=0.0, learnable=learnable, grad_steps=grad_steps, gradient=gradient,
            eps=eps, final=final, slack=slack, noise=noise, realign_from=realign_from,
        )  # fmt: skip
        if not (slack > 0 and noise > 0) or not 0 <= realign_from <= 1:
            raise OptionError(
                f"UnrolledPKC: expected slack and noise > 0 and realign_from in 0..1, got {slack}, {noise} and "
                f"{realign_from}"
            )
        self.skeleton = get_skeleton(skeleton)
        self.indices = list(self.skeleton.rigid)
        bones = self.skeleton.bone_index()
        self.register_buffer("bones", bones, persistent=False)
        self.register_buffer("rigid", bones[self.indices], persistent=False)
        self.first = round(realign_from * num_steps)
        levels = continuation(num_steps, eps, final)
        self._positive("eps", levels)
        self._positive("slack", [slack * level**0.5 for level in levels])
        self._positive("noise", [noise] * num_steps)
        self._hold_lengths(self.skeleton, lengths, learnable_lengths)

    def forward(
        self,
        tracks: Tensor,
        cameras: Tensor,
        *,
        weights: Tensor | None = None,
        start: Tensor | None = None,
        lengths: Tensor | None = None,
        inside: Tensor | None = None,
    ) -> Tensor:
        """Return the shape in the world frame of the cameras, held but for what ``realign_from`` says.

        Args:
            tracks: (..., T, N, 2), NaN where unseen.
            cameras: (..., T, 2, 3).
            weights: (..., T, N), 0 where unseen.
            start: (..., T, N, 3), a network's output, say; the back-projected tracks if None.
            lengths: (..., B) bone lengths in the unit of the tracks, instead of the module's.
            inside: (..., T), False in padding, as of :meth:`UnrolledFPC.forward`.

        Returns:
            (..., T, N, 3).

        Raises:
            ShapeError: the shapes do not fit.

        Warns:
            ConvergenceWarning: with the implicit gradient, in the backward pass.
        """
        return self.solve(
            tracks, cameras, weights=weights, start=start, lengths=lengths, inside=inside, measure=False
        ).value

    def solve(
        self,
        tracks: Tensor,
        cameras: Tensor,
        *,
        weights: Tensor | None = None,
        start: Tensor | None = None,
        lengths: Tensor | None = None,
        inside: Tensor | None = None,
        measure: bool = True,
    ) -> Solution[Tensor]:
        """As :meth:`forward`, as a :class:`kcs_torch.solvers.Solution`.

        With ``measure`` it tells whether the last step stood still, which waits for the device.
        """
        weights = self._check(tracks, cameras, weights, start, self.skeleton, lengths=lengths, inside=inside)
        depends_on = (tracks, cameras, weights, start, lengths)
        with full_precision(tracks):
            # Factorisations of covariances: in double precision, as for singular values.
            wide = torch.float32 if tracks.device.type == "mps" else torch.float64
            rows = cameras.to(wide)
            if inside is not None:  # any rotation will do
                rows = torch.where(inside[..., None, None], rows, torch.eye(3, dtype=wide, device=rows.device)[:2])
            length = row_length(rows, of_clip=False)
            rows, flat = rows / length, known(tracks, weights).to(wide) / length
            flat, share, size = _normalised(flat, weights.to(wide))
            begin = start_shape(flat, rows, share) if start is None else clear_padding(start, inside).to(wide) / size
            begin = clear_padding(begin - begin.mean(-2, keepdim=True), inside)
            step = self._descent(flat, share, None if lengths is None else lengths.to(wide) / size[..., 0, 0], inside)
            batch = () if lengths is None else lengths.shape[:-1]
            begin = begin.expand(*broadcast_shapes(begin.shape[:-3], rows.shape[:-3], batch), *begin.shape[-3:])
            world = complete_rotation(rows).expand(*begin.shape[:-2], 3, 3)

            # The state: points, and below them the rotations of frames that are turned.
            joints, turns = self.skeleton.num_joints, self.first < self.num_steps
            split = lambda state: (state[..., :joints, :], state[..., joints:, :] if turns else world)  # noqa: E731

            def advance(state: Tensor, k: int) -> Tensor:
                points, turned = step(*split(state), k)
                return torch.cat([points, turned], -2) if turns else points

            begin = torch.cat([begin, world], -2) if turns else begin
            solution = self._run(advance, begin, measure=measure, depends_on=depends_on)
            points, turned = split(solution.value)
            value = size * (points @ turned.mT @ world)
        return Solution(narrow(value, tracks), solution.converged, solution.iterations)

    def _descent(
        self, flat: Tensor, weights: Tensor, lengths: Tensor | None, inside: Tensor | None
    ) -> Callable[[Tensor, Tensor, int], tuple[Tensor, Tensor]]:
        """What makes step k of points (..., T, N, 3) and rotations (..., T, 3, 3), of normalised tracks and lengths."""
        own = self._lengths(flat) if lengths is None and self.has_lengths else lengths
        # Floors far below any useful value: what is learned may run away, the factorisations must not fail.
        eps, slack, noise = (
            self._values(name, flat).clamp_min(least)
            for name, least in (("eps", 1e-7), ("slack", 1e-3), ("noise", 1e-3))
        )
        relative, graded = lengths is None, not self.skeleton.tree

        def step(points: Tensor, turned: Tensor, k: int) -> tuple[Tensor, Tensor]:
            part = None if own is None else own[..., self.indices]
            aims, rigidity = aimed_lengths(
                points, self.rigid, weights, part, relative=relative, graded=graded, inside=inside
            )
            points = majorise_step(
                points, flat, turned[..., :2, :], weights, aims, bones=self.bones, rigid=self.rigid,
                eps=eps[k], slack=slack[k] * rigidity.clamp_min(1e-4).rsqrt()[..., None, :], noise=noise[k],
                inside=inside,
            )  # fmt: skip
            return turn_onto_mean(points, turned, self.bones) if k >= self.first else (points, turned)

        return step


def _normalised(tracks: Tensor, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Tracks (..., T, N, 2) about the seen joints' middle, of root mean square 1; weights; and the unit (..., 1, 1, 1).

    The unit is 1 where all seen joints lie at one point.
    """
    weights = weights.expand(tracks.shape[:-1])
    flat = known(-centred_residual(torch.zeros_like(tracks), tracks, weights), weights)
    seen = (weights > 0).to(flat.dtype)
    square = (flat.square().sum(-1) * seen).sum((-2, -1)) / seen.sum((-2, -1)).clamp_min(1)
    size = or_one(square).sqrt()[..., None, None, None]
    return flat / size, weights, size
