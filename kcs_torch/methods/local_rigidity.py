"""Local rigidity: short windows taken for rigid, then pairs of joints that keep their distance (Rehan et al. 2014)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from kcs_torch.functional.align import nearest_rotation
from kcs_torch.functional.camera import back_project, complete_rotation, factorize, project, rows_to_cameras
from kcs_torch.functional.guarded import or_one
from kcs_torch.functional.ranks import median
from kcs_torch.functional.rigidity import distance_spread
from kcs_torch.functional.rotation import running_products
from kcs_torch.methods.clips.cameras import most_shapes, still_cameras
from kcs_torch.methods.factorised import SETTLED, Factorised
from kcs_torch.solvers.ist import ist, metric_upgrade
from kcs_torch.solvers.iterate import Solution, iterate, relative_change
from kcs_torch.solvers.lm import fit_bones

__all__ = ["LocalRigidity", "rigid_pairs", "triangulation", "window_cameras"]

CHUNK = 256
"""Windows that are factorised at once: more would only take memory."""

BONES = 10.0
"""How much more than staying in place keeping a distance weighs, in a step of the second fit."""

BUMP = 0.3
"""Added to the relaxation's Q in every direction, a share of its size."""

RIDGE = 1e-3
"""Of a triangulation, a share of its trace: depth that the window does not show is taken for small."""


@dataclass(frozen=True)
class LocalRigidity(Factorised):
    """The body is rigid for a short time, and some pairs of its joints stay at one distance throughout.

    Every window of a few frames is factorised as a rigid body, and upgraded; neighbouring windows share all frames but
    two, which joins their mirror images and their rotations. A frame's shape is then the one that its window's tracks
    triangulate, sum_s g_ts |W_s - R_s S_t|^2 with g falling from the frame on. In these shapes the pairs of joints
    that vary least in distance are found, and the shapes are fitted anew, to the tracks of their own frame first of
    all, with these distances constant. The skeleton's bones are not looked at: the pairs take their place.

    Args:
        window: frames that are taken for rigid.
        pairs: rigid pairs, at most, as many times the number of joints.
        rigid_below: a pair whose distance varies by more than this share is not rigid.
        neighbours: weight of the window's other tracks in the second fit, that of the frame's own being 1.
        stiffness: of the pairs' distances.
        num_steps: steps of the second fit; 0 keeps the first.

    Raises:
        OptionError: a value is out of range.

    Rehan, Zaheer, Akhter, Saeed, Mahmood, Usmani, Khan: NRSfM using Local Rigidity, WACV 2014.
    """

    name: ClassVar[str] = "local_rigidity"
    window: int = 25
    pairs: float = 2.0
    rigid_below: float = 0.1
    neighbours: float = 0.1
    stiffness: float = 0.1
    num_steps: int = 40

    def __post_init__(self) -> None:
        super().__post_init__()
        self._expect(self.window >= 3, "window", "at least 3 frames")
        self._expect(0 <= self.pairs < math.inf, "pairs", "a number >= 0")
        self._expect(self.rigid_below > 0, "rigid_below", "a positive number")
        self._expect(0 < self.neighbours <= 1, "neighbours", "a share within (0, 1]")
        self._expect(0 < self.stiffness < math.inf, "stiffness", "a positive number")
        self._expect(self.num_steps >= 0, "num_steps", "a number >= 0")

    def find_cameras(self, tracks: Tensor) -> Tensor:
        """Rigid windows, joined; the identity for clips with too few frames or joints to tell."""
        *batch, frames, joints, _ = tracks.shape
        if most_shapes(tracks) < 1:
            return still_cameras(tracks)
        found = [window_cameras(one, min(self.window, frames)) for one in tracks.reshape(-1, frames, joints, 2)]
        return torch.stack(found).view(*batch, frames, 2, 3)

    def find_shape(self, tracks: Tensor, weights: Tensor, cameras: Tensor) -> Solution[Tensor]:
        """Triangulate, find rigid pairs, and fit the shapes with their distances constant."""
        window = min(self.window, len(tracks))
        normal, goal = triangulation(tracks, weights, cameras, window, 1.0)
        shape = _solve(normal, goal)
        bones, lengths = rigid_pairs(shape, round(self.pairs * tracks.shape[1]), self.rigid_below)
        if not len(bones) or self.num_steps == 0:
            return Solution(shape, True, 1)
        normal, goal = triangulation(tracks, weights, cameras, window, self.neighbours)
        eye = torch.eye(3, dtype=shape.dtype, device=shape.device)

        def step(now: Tensor, _: int) -> Tensor:
            held = fit_bones(now, lengths, bones, stiffness=BONES, num_steps=1)
            return _solve(normal + self.stiffness * eye, goal + self.stiffness * held)

        return iterate(
            step,
            shape,
            num_steps=self.num_steps,
            change=lambda old, new: relative_change(old.flatten(-2), new.flatten(-2)),
            tolerance=SETTLED,
        )


def window_cameras(tracks: Tensor, window: int) -> Tensor:
    """Return camera rows (T, 2, 3) from windows that are rigid each.

    Args:
        tracks: (T, N, 2), complete and centred.
        window: frames of a window, at most T; neighbouring windows start one frame apart.
    """
    frames = len(tracks)
    parts = tracks.unfold(0, window, 1).permute(0, 3, 1, 2)  # (V, w, N, 2)
    rows, shapes, misses = (torch.cat(x) for x in zip(*(_factorise(part) for part in parts.split(CHUNK)), strict=True))
    # A window and its neighbour see the same depths, or one sees the mirror image.
    depth = complete_rotation(rows)[..., 2, :] @ shapes.mT  # (V, w, N)
    agree = (depth[:-1, 1:] * depth[1:, :-1]).sum((1, 2))
    one = torch.ones_like(misses)
    sign = torch.cat([one[:1], torch.where(agree < 0, -one[1:], one[1:])]).cumprod(0)
    flip = torch.stack([one, one, sign], -1)
    turned = complete_rotation(rows * flip[:, None, None])  # (V, w, 3, 3)
    between = nearest_rotation((turned[1:, :-1].mT @ turned[:-1, 1:]).sum(1))  # from the last window's world
    eye = torch.eye(3, dtype=tracks.dtype, device=tracks.device)[None]
    turned = turned @ nearest_rotation(running_products(torch.cat([eye, between])))[:, None]
    # Windows count the more, the more rigid they are, and the nearer a frame is to their middle.
    trust = 1 / (misses + RIDGE * misses.mean() + torch.finfo(misses.dtype).tiny)
    ramp = torch.arange(1, window + 1, dtype=tracks.dtype, device=tracks.device)
    share = (trust / trust.amax())[:, None] * torch.minimum(ramp, ramp.flip(0)).square()
    index = torch.arange(frames, device=tracks.device).unfold(0, window, 1)
    total = tracks.new_zeros(frames, 3, 3).index_add(
        0, index.flatten(), (turned * share[..., None, None]).flatten(0, 1)
    )
    return nearest_rotation(total)[:, :2]


def _factorise(parts: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Rigid factorisation of windows (V, w, N, 2): camera rows (V, w, 2, 3), shapes (V, N, 3), mean square miss (V)."""
    motion, _ = factorize(parts, 3)
    start = ist(motion)
    # Where the window deforms, the relaxation may be flat, and a flat start stays so.
    start = start + BUMP * torch.linalg.matrix_norm(start)[:, None, None] * torch.eye(3).to(start)
    q, _ = metric_upgrade(motion, start, evenness=1.0, num_steps=60, tolerance=1e-4)
    rows, _ = rows_to_cameras(motion @ q[:, None])
    shapes = _solve((rows.mT @ rows).sum(1), back_project(parts, rows).sum(1))
    miss = (project(shapes[:, None], rows) - parts).square().mean((1, 2, 3))
    return rows, shapes, miss


def triangulation(
    tracks: Tensor, weights: Tensor, cameras: Tensor, window: int, neighbours: float
) -> tuple[Tensor, Tensor]:
    """Normal equations A_t S_t = B_t of sum_s g_ts w_s |W_s - R_s S_t|^2, for each joint.

    Args:
        tracks: W (T, N, 2).
        weights: w (T, N).
        cameras: R (T, 2, 3).
        window: frames; g is a triangle over them.
        neighbours: g of the next frames, a share of the frame's own.

    Returns:
        A (T, N, 3, 3) and B (T, N, 3).
    """
    frames = len(tracks)
    half = max(window // 2, 1)
    away = torch.arange(-half, half + 1, dtype=tracks.dtype, device=tracks.device)
    share = (1 - away.abs() / (half + 1)) * torch.where(away == 0, torch.ones_like(away), neighbours)
    own = weights[..., None, None] * (cameras.mT @ cameras)[:, None]  # (T, N, 3, 3)
    seen = weights[..., None] * back_project(tracks, cameras)
    smooth = lambda x: torch.nn.functional.conv1d(  # noqa: E731
        x.reshape(frames, -1).mT[:, None], share[None, None], padding=half
    )[:, 0].mT.reshape(x.shape)
    return smooth(own), smooth(seen)


def rigid_pairs(points: Tensor, most: int, below: float) -> tuple[Tensor, Tensor]:
    """Return the pairs (B, 2) whose distance varies least over time, and their median distances (B,).

    Args:
        points: (T, N, 3).
        most: B, at most.
        below: no pair varies by more than this share of its mean.
    """
    joints = points.shape[1]
    mean, spread = distance_spread(points)
    row, column = torch.triu_indices(joints, joints, 1, device=points.device)
    size = mean[row, column]
    ratio = spread[row, column] / or_one(size)
    ratio = torch.where(size > 1e-6 * size.amax() if size.numel() else size > 0, ratio, math.inf)
    order = ratio.argsort(stable=True)[:most]
    order = order[ratio[order] < below]
    bones = torch.stack([row, column], -1)[order]
    return bones, median((points[:, bones[:, 0]] - points[:, bones[:, 1]]).norm(dim=-1), 0)


def _solve(normal: Tensor, goal: Tensor) -> Tensor:
    """Solve (..., 3, 3) systems for (..., N, 3) rows, or one system a row; what nothing shows stays small."""
    eye = torch.eye(3, dtype=goal.dtype, device=goal.device)
    size = normal.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    factor, _ = torch.linalg.cholesky_ex(normal + (RIDGE * size + torch.finfo(goal.dtype).tiny) * eye)
    if normal.ndim == goal.ndim:
        return torch.cholesky_solve(goal.mT, factor).mT
    return torch.cholesky_solve(goal[..., None], factor)[..., 0]
