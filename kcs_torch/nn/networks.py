"""Lifting networks for any skeleton: a residual MLP, temporal convolutions, and a camera head.

All see the same input and answer in the same form. A frame is centred on its seen joints, and a clip divided by the
root mean square of what is seen in it; unseen joints are 0, and the mask is an input of its own. So a network commutes
with translation and scale of the image by construction. Its answer is a correction of the tracks in x and y, and the
depth, both in the unit of the clip and nearly 0 before training.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from numbers import Integral
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from kcs_torch.errors import OptionError, ShapeError
from kcs_torch.functional.precision import narrow
from kcs_torch.nn.checks import check_beside, check_joints, check_points, check_tensor, check_whole
from kcs_torch.nn.layers import SkeletonModule
from kcs_torch.nn.normalise import NormalisedTracks, neighbours, normalise_tracks
from kcs_torch.skeleton import Skeleton
from kcs_torch.types.hints import is_a

__all__ = ["CameraHead", "MLPLifter", "TemporalLifter"]

QUIET = 0.01
"""Root mean square of what an untrained network adds to the tracks, in units of the clip: not 0, as the depth 0 of all
joints is a point where losses on bone lengths have no gradient."""

LOG_RANGE = 4.0
"""Largest logarithm of a camera's scale over the clip's."""


class _Residual(nn.Module):
    """x + W2 act(W1 norm(x and its neighbours in time))."""

    def __init__(self, width: int, dropout: float, dilation: int = 0) -> None:
        super().__init__()
        self.steps = (-dilation, 0, dilation) if dilation else (0,)
        self.norm = nn.LayerNorm(width)
        self.first = nn.Linear(len(self.steps) * width, width)
        self.second = nn.Linear(width, width)
        self.dropout = nn.Dropout(dropout)

    def forward(self, x: Tensor) -> Tensor:
        hidden = nn.functional.gelu(self.first(neighbours(self.norm(x), self.steps)))
        return x + self.dropout(self.second(self.dropout(hidden)))


class _Network(SkeletonModule):
    """Normalised frames and their neighbours, residual blocks, and ``outputs`` numbers a frame."""

    _options: dict[str, Any]

    def __init__(
        self,
        skeleton: str | Path | Skeleton,
        *,
        width: int,
        dropout: float,
        window: int,
        dilations: Sequence[int],
        outputs: int | None = None,
    ) -> None:
        super().__init__(skeleton)
        kind = type(self).__name__
        check_whole(self, 1, window=window)
        if not (is_a(dropout, float) and 0 <= dropout < 1):
            raise OptionError(f"{kind}: dropout: expected a share within [0, 1), got {dropout!r}")
        if window % 2 == 0:
            raise OptionError(
                f"{kind}: window: expected an odd number of frames, the middle one is lifted, got {window}"
            )
        joints = self.skeleton.num_joints
        half = window // 2
        self.steps = tuple(range(-half, half + 1))
        self.enter = nn.Linear(3 * joints * window, width)
        self.blocks = nn.Sequential(*(_Residual(width, dropout, d) for d in dilations))
        self.norm = nn.LayerNorm(width)
        self.leave = nn.Linear(width, 3 * joints if outputs is None else outputs)
        nn.init.normal_(self.leave.weight, std=QUIET / math.sqrt(width))
        nn.init.zeros_(self.leave.bias)
        self._reach = half + sum(dilations)

    @property
    def receptive_field(self) -> int:
        """How many frames, the middle one included, an answer depends on, apart from the scale of the clip."""
        return 2 * self._reach + 1

    @property
    def options(self) -> dict[str, Any]:
        """What the constructor takes besides the skeleton, as plain values."""
        return dict(self._options)

    def extra_repr(self) -> str:
        return ", ".join([super().extra_repr(), *(f"{k}={v}" for k, v in self.options.items())])

    def run(
        self, tracks: Tensor, weights: Tensor | None, scale: Tensor | None = None
    ) -> tuple[Tensor, NormalisedTracks]:
        """The ``outputs`` numbers of each frame (..., T, outputs), and what they were made from, both widened."""
        check_points(tracks, self, "tracks")
        check_joints(self, self.skeleton, tracks, "tracks (..., T, {}, 2)")
        if weights is not None:
            check_tensor(weights, "weights", self)
        if tracks.shape[-1] != 2:
            raise ShapeError(f"{type(self).__name__}: expected tracks (..., T, N, 2), got {tuple(tracks.shape)}")
        if weights is not None and weights.shape != tracks.shape[:-1]:
            raise ShapeError(
                f"{type(self).__name__}: weights: expected {tuple(tracks.shape[:-1])}, got {tuple(weights.shape)}"
            )
        check_beside(scale, "scale", (1, 1, 1), tracks, self, "tracks")
        if tracks.shape[-3] == 0:
            raise ShapeError(f"{type(self).__name__}: expected at least 1 frame, got none")
        known = normalise_tracks(tracks, weights, scale)
        frames = torch.cat([known.local.flatten(-2), known.seen], -1).to(self.enter.weight.dtype)
        hidden = self.blocks(self.enter(neighbours(frames, self.steps)))
        return self.leave(self.norm(hidden)).to(known.local.dtype), known


class _Lifter(_Network):
    """A network that answers with points."""

    def forward(self, tracks: Tensor, weights: Tensor | None = None, *, scale: Tensor | None = None) -> Tensor:
        """Lift tracks.

        Args:
            tracks: (..., T, N, 2), virtual joints included; anything, NaN too, where unseen.
            weights: (..., T, N), 0 where unseen; all finite tracks are seen if None.
            scale: (..., 1, 1, 1) size to divide by, where the frames are a part of a longer clip; found if None.

        Returns:
            (..., T, N, 3) in the camera frame and the unit of the tracks, in their dtype; depth is about 0.

        Raises:
            ShapeError: the tracks are not of this skeleton.
        """
        answer, known = self.run(tracks, weights, scale)
        answer = answer.unflatten(-1, (-1, 3))
        image = (known.local + answer[..., :2]) * known.scale + known.middle
        return narrow(torch.cat([image, answer[..., 2:] * known.scale], -1), tracks)


class MLPLifter(_Lifter):
    """Residual MLP on each frame, or on a small window of frames about it.

    Args:
        skeleton: a :class:`Skeleton`, a built-in name or a file.
        width: of the hidden layers.
        num_blocks: residual blocks of two layers each.
        dropout: share of hidden values that are left out in training.
        window: frames, an odd number, that the middle one is lifted from.

    Raises:
        OptionError: a number is out of range.

    >>> network = MLPLifter("h36m17")
    >>> network(torch.rand(8, 27, 17, 2)).shape
    torch.Size([8, 27, 17, 3])
    """

    def __init__(
        self,
        skeleton: str | Path | Skeleton,
        *,
        width: int = 256,
        num_blocks: int = 2,
        dropout: float = 0.1,
        window: int = 1,
    ) -> None:
        check_whole(self, 0, num_blocks=num_blocks)
        check_whole(self, 1, width=width)
        super().__init__(skeleton, width=width, dropout=dropout, window=window, dilations=(0,) * num_blocks)
        self._options = {"width": width, "num_blocks": num_blocks, "dropout": dropout, "window": window}


class TemporalLifter(_Lifter):
    """Residual temporal convolutions of three frames each, ever farther apart; for clips of any length.

    Every frame has an answer: beyond the ends of a clip each layer sees the first or the last frame again.

    Args:
        skeleton: a :class:`Skeleton`, a built-in name or a file.
        channels: of the hidden layers.
        dilations: of each block: it sees the frames so many steps before and after.
        dropout: share of hidden values that are left out in training.

    Raises:
        OptionError: a number is out of range.

    >>> network = TemporalLifter("h36m17")
    >>> network.receptive_field, network(torch.rand(50, 17, 2)).shape
    (27, torch.Size([50, 17, 3]))
    """

    def __init__(
        self,
        skeleton: str | Path | Skeleton,
        *,
        channels: int = 128,
        dilations: Sequence[int] = (1, 3, 9),
        dropout: float = 0.1,
    ) -> None:
        given: Any = tuple(dilations) if isinstance(dilations, Iterable) else None  # what iterates once, too
        if given is None or not all(isinstance(d, Integral) and int(d) >= 1 for d in given):
            raise OptionError(f"TemporalLifter: dilations: expected whole numbers from 1, got {dilations!r}")
        dilations = tuple(int(d) for d in given)
        check_whole(self, 1, channels=channels)
        super().__init__(skeleton, width=channels, dropout=dropout, window=1, dilations=dilations)
        self._options = {"channels": channels, "dilations": list(dilations), "dropout": dropout}


class CameraHead(_Network):
    """Weak-perspective camera of each frame from its tracks, as a network of its own.

    For a pose X (N, 3) that a frame shows in axes of the body or of the world: image = scale * X rows^T + shift.

    Args:
        skeleton: a :class:`Skeleton`, a built-in name or a file.
        width: of the hidden layers.
        num_blocks: residual blocks of two layers each.
        dropout: share of hidden values that are left out in training.
        window: frames, an odd number, that the middle one's camera is told from.

    Raises:
        OptionError: a number is out of range.

    >>> rows, scale = CameraHead("h36m17")(torch.rand(8, 27, 17, 2))
    >>> rows.shape, scale.shape
    (torch.Size([8, 27, 2, 3]), torch.Size([8, 27]))
    """

    def __init__(
        self,
        skeleton: str | Path | Skeleton,
        *,
        width: int = 128,
        num_blocks: int = 2,
        dropout: float = 0.1,
        window: int = 1,
    ) -> None:
        check_whole(self, 0, num_blocks=num_blocks)
        check_whole(self, 1, width=width)
        super().__init__(skeleton, width=width, dropout=dropout, window=window, dilations=(0,) * num_blocks, outputs=7)
        self._options = {"width": width, "num_blocks": num_blocks, "dropout": dropout, "window": window}

    def forward(self, tracks: Tensor, weights: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Tell the cameras of tracks.

        Args:
            tracks: (..., T, N, 2), virtual joints included; anything, NaN too, where unseen.
            weights: (..., T, N), 0 where unseen; all finite tracks are seen if None.

        Returns:
            rows (..., T, 2, 3), orthonormal, about the first two of the identity before training; and scale (..., T),
            positive, in the unit of the tracks, the clip's root mean square before training; 0 where all joints lie at
            one point.

        Raises:
            ShapeError: the tracks are not of this skeleton.
        """
        answer, known = self.run(tracks, weights)
        rows = answer[..., :6].unflatten(-1, (2, 3)) + torch.eye(3, dtype=answer.dtype, device=answer.device)[:2]
        scale = known.scale[..., 0, 0] * answer[..., 6].clamp(-LOG_RANGE, LOG_RANGE).exp()
        return orthonormal_rows(rows).to(tracks.dtype), narrow(scale, tracks)


def orthonormal_rows(rows: Tensor) -> Tensor:
    """Make two rows (..., 2, 3) orthonormal, the first one's direction kept; any where they do not tell.

    >>> orthonormal_rows(torch.tensor([[2.0, 0, 0], [5, 3, 0]])).tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    """
    x, y = rows.unbind(-2)
    eye = torch.eye(3, dtype=rows.dtype, device=rows.device)
    x = _unit(x, eye[0].expand_as(x))
    spare = eye[(x.abs()).argmin(-1)]  # the axis farthest from x, so that a part across it is left
    across = lambda v: v - (v * x).sum(-1, keepdim=True) * x  # noqa: E731
    return torch.stack([x, _unit(across(y), _unit(across(spare), spare))], -2)


def _unit(vectors: Tensor, spare: Tensor) -> Tensor:
    """Vectors (..., 3) of length 1; the spare ones where they are too short to have a direction."""
    square = vectors.square().sum(-1, keepdim=True)
    clear = square > 1e-8
    vectors = torch.where(clear, vectors, spare)
    return vectors / torch.where(clear, square, torch.ones_like(square)).sqrt()
