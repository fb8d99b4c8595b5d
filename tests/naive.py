"""Naive twins of the fast parts: what one writes down first. Tests compare with them, scripts/speed.py measures them.

The twin of a method is the same iteration with the same number of steps, in which

- singular values are shrunk by an SVD of the whole matrix, where the method takes the smaller Gram matrix;
- the bone-length step solves 3N x 3N normal equations a frame, where the method solves B x B;
- windows are solved one after another, where the method solves them as one batch.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest import mock

import torch
from torch import Tensor

from kcs_torch import functional, solvers
from kcs_torch.nn import steps
from kcs_torch.solvers import pose

__all__ = ["fit_bones", "fit_bones_frame_by_frame", "fit_cameras_frame_by_frame", "naive", "svt", "window_by_window"]

BATCHED_CAMERAS = pose.fit_cameras


def svt(matrix: Tensor, threshold: Tensor | float, corner: Tensor | float = math.inf) -> Tensor:
    """U max(S - threshold / (1 + S / corner), 0) V^T of (..., M, N), as the formula says."""
    u, s, vh = torch.linalg.svd(matrix, full_matrices=False)
    level, bend = (torch.as_tensor(x, dtype=s.dtype)[..., None] for x in (threshold, corner))
    return (u * (s - level / (1 + s / bend)).clamp_min(0)[..., None, :]) @ vh


def fit_bones(
    points: Tensor,
    lengths: Tensor,
    bones: Tensor,
    *,
    stiffness: Tensor | float = 1.5,
    num_steps: int = 3,
    damping: float = 0.0,
) -> Tensor:
    """The textbook Levenberg-Marquardt on all 3N coordinates of a frame: as kcs_torch.solvers.fit_bones.

    Residuals sqrt(stiffness) (|b| - L) and A - points; points (..., N, 3), lengths (..., B).
    """
    joints, count = points.shape[-2], len(bones)
    row = torch.arange(count)
    eye = torch.eye(3 * joints, dtype=points.dtype)
    root = torch.as_tensor(stiffness, dtype=points.dtype).sqrt()
    current = points
    for _ in range(num_steps):
        vectors = current[..., bones[:, 1], :] - current[..., bones[:, 0], :]
        size = vectors.norm(dim=-1)
        unit = root[..., None] * vectors / size.clamp_min(torch.finfo(points.dtype).tiny)[..., None]
        jacobian = points.new_zeros(*points.shape[:-2], count, joints, 3)
        jacobian[..., row, bones[:, 0], :] -= unit
        jacobian[..., row, bones[:, 1], :] += unit
        jacobian = jacobian.flatten(-2)  # (..., B, 3N)
        gradient = (jacobian.mT @ (root * (size - lengths))[..., None]).squeeze(-1) + (current - points).flatten(-2)
        normal = jacobian.mT @ jacobian + (1 + damping) * eye
        current = current - torch.linalg.solve(normal, gradient).unflatten(-1, (joints, 3))
    return current


def fit_bones_frame_by_frame(
    points: Tensor, lengths: Tensor, bones: Tensor, *, stiffness: Tensor | float = 1.5, **options: Any
) -> Tensor:
    """The same with a Python loop over frames."""
    shape = (*points.shape[:-2], len(bones))
    beta = torch.as_tensor(stiffness, dtype=points.dtype)
    frames = zip(
        points.flatten(0, -3), lengths.expand(shape).flatten(0, -2), beta.expand(shape).flatten(0, -2), strict=True
    )
    return torch.stack([fit_bones(p, size, bones, stiffness=k, **options) for p, size, k in frames]).reshape(
        points.shape
    )


def fit_cameras_frame_by_frame(*arrays: Tensor, start: Tensor | None = None, **options: Any) -> pose.CameraFit:
    """As kcs_torch.solvers.pose.fit_cameras, whose arguments all have frames first, with a Python loop over frames."""
    frames = [[array[t : t + 1] for array in arrays] for t in range(len(arrays[0]))]
    starts = [None if start is None else start[t : t + 1] for t in range(len(frames))]
    fits = [BATCHED_CAMERAS(*frame, start=first, **options) for frame, first in zip(frames, starts, strict=True)]
    return pose.CameraFit(*(torch.cat([getattr(f, name) for f in fits], 1) for name in ("rotations", "scales", "cost")))


def window_by_window(step: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """A step of SfAM that takes the windows (W, T, N, 3) of one body, with a Python loop over them."""

    def looped(*batched: Tensor, corner: Tensor, **shared: Tensor) -> Tensor:
        own = zip(*batched, corner, strict=True)  # all of them are each window's own
        return torch.stack([step(*window, corner=bend, **shared) for *window, bend in own])

    return looped


@contextmanager
def naive(*, frame_by_frame: bool = False) -> Iterator[None]:
    """Within this context KCS and SfAM are their naive twins; with ``frame_by_frame`` also where frames are a batch."""
    with ExitStack() as stack:

        def swap(original: Callable[..., object], twin: Callable[..., object]) -> None:
            """Replace a function in every module that imports it."""
            for name, module in list(sys.modules.items()):
                for key, value in list(vars(module).items()) if name.startswith("kcs_torch.") else ():
                    if value is original:
                        stack.enter_context(mock.patch.object(module, key, twin))

        swap(functional.svt, svt)
        swap(solvers.fit_bones, fit_bones_frame_by_frame if frame_by_frame else fit_bones)
        swap(steps.shape_step, window_by_window(steps.shape_step))
        if frame_by_frame:
            swap(pose.fit_cameras, fit_cameras_frame_by_frame)
        yield
