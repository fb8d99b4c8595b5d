"""Structure from motion by Procrustes alignment in bone space: the moving viewpoint.

The bones of each frame, turned back by a rotation of that frame, follow one Gaussian, and so do their changes from
frame to frame; rigid bones keep their length. With the covariances at their maximum likelihood this is

    F = sum_m w_m T/2 log det(A_m^T A_m / T + eps_m I)              A_0: aligned bones, A_1: their changes in time
      + sum_b s_b T/2 log((v_b + d^2) / (v_b + 9 d^2))              v_b: variance over time of a bone's length
      + sum_tn u_tn c^2/2 log(1 + |x_tn - y_tn|^2 / (c noise)^2)    where the tracks are noisy or incomplete

over depths (and x, y), and rotations. A log-determinant is the tighter surrogate of rank; the term in the lengths stops
pulling on bones that vary by more than three times the slack d. All scales fall from stage to stage.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from kcs_torch.errors import ShapeError
from kcs_torch.functional.align import nearest_rotation
from kcs_torch.functional.chain import bone_vectors
from kcs_torch.functional.guarded import safe_norm
from kcs_torch.functional.precision import widened
from kcs_torch.functional.scatter import scatter_log_det
from kcs_torch.functional.weights import known
from kcs_torch.solvers.curvature import CHANGE, REACH, Levels, shown, whitening
from kcs_torch.solvers.lbfgs import lbfgs
from kcs_torch.solvers.memory import give_back
from kcs_torch.solvers.procrustean_descent import Descent

__all__ = [
    "COARSE",
    "FINE",
    "Pose",
    "Stage",
    "align_rotations",
    "depth_deviation",
    "length_energy",
    "motion_energy",
    "procrustean",
    "steadiness",
    "track_energy",
]


@dataclass(frozen=True)
class Stage:
    """Weights and scales of one stage of the descent, relative to tracks of root mean square 1.

    Attributes:
        eps: variance that the log-determinants do not look below; a tenth of it for the changes.
        num_steps: L-BFGS steps.
        still: weight of the aligned bones' log-determinant.
        moving: weight of that of their changes from frame to frame.
        slack: standard deviation of a rigid bone's length.
    """

    eps: float
    num_steps: int
    still: float
    moving: float
    slack: float


COARSE = (Stage(1e-2, 15, 1.0, 0.0, 0.1), Stage(1e-3, 25, 1.0, 0.0, 0.03), Stage(1e-4, 30, 1.0, 0.0, 0.01))
"""Stages that find the basin: frames in any order, so that far starts travel."""

FINE = (Stage(1e-4, 30, 0.01, 1.0, 0.01), Stage(1e-5, 40, 0.01, 1.0, 0.01), Stage(1e-5, 40, 0.01, 1.0, 0.003))
"""Stages that refine: the changes in time tell more than the poses, but slow modes move little."""

TELLING = Stage(1e-4, 0, 1.0, 0.0, 0.03)
"""Scales at which the curvature tells how sure depths are."""

CONSTANT, SURE, UNSURE = 0.0043, 0.15, 1.3
"""Standard deviation of rigid lengths at which depths are as sure as the curvature tells, and the least and largest
factors, which go with its root: a model that holds so well is hardly wrong."""

FULL, LITTLE, MOST = 250.0, 0.005, 0.5
"""Degrees at which depths are as sure as the curvature tells, if the directions of view are spread over all sides; the
least variance of these directions; and the largest deviation."""


@dataclass(frozen=True)
class Pose:
    """What :func:`procrustean` finds for H hypotheses.

    Attributes:
        points: (H, T, N, 3) in the camera frame.
        rotations: (H, T, 3, 3), world to camera: ``points @ rotations`` are the aligned poses.
        objective: (H,) at the last stage's scales; the lowest is best.
        moved: (H,) root mean square change of the points in the last ten steps.
    """

    points: Tensor
    rotations: Tensor
    objective: Tensor
    moved: Tensor

    def __getitem__(self, index: Tensor | slice) -> Pose:
        """Some of the hypotheses."""
        return Pose(self.points[index], self.rotations[index], self.objective[index], self.moved[index])

    def exchanged(self, other: Pose, some: Tensor) -> Pose:
        """The hypotheses, but those of another where ``some`` (H,) is true."""
        every = some[:, None, None, None]
        return Pose(
            torch.where(every, other.points, self.points),
            torch.where(every, other.rotations, self.rotations),
            torch.where(some, other.objective, self.objective),
            torch.where(some, other.moved, self.moved),
        )


@widened
def procrustean(
    tracks: Tensor,
    points: Tensor,
    rotations: Tensor,
    bones: Tensor,
    *,
    weights: Tensor | None = None,
    rigid: Tensor | None = None,
    stiffness: Tensor | float = 1.0,
    noise: float = 0.0,
    stages: Sequence[Stage] = COARSE + FINE,
    counts: Tensor | None = None,
    anchor: Tensor | float = 0.0,
    held: Tensor | None = None,
) -> Pose:
    """Descend F from H starts at once, by L-BFGS in coordinates that whiten each frame's curvature.

    Args:
        tracks: (T, N, 2), centred, of root mean square near 1; where unseen, any value.
        points: (H, T, N, 3) starts in the camera frame; x and y stay as they are unless ``noise`` is positive.
        rotations: (H, T, 3, 3) starts, world to camera.
        bones: (B, 2) joint pairs that span the joints.
        weights: (T, N) confidences, 0 where unseen; needed only with ``noise``. All 1 where None.
        rigid: (P, 2) joint pairs that keep their distance; ``bones`` where None.
        stiffness: (P,) or a number, weight of each pair's length.
        noise: standard deviation of the tracks, as a share of their size. 0 takes them as exact and complete, which
            leaves one unknown a joint; else there are three.
        stages: scales and weights, in order.
        counts: (H,) frames of each start, of clips that are padded with zeros to T; not with ``noise``. All if None.
        anchor: (H,) or a number, weight of half the squared distance of each depth from its start, or from ``held``.
        held: (H, T, N) depths, where those that are held are not the starts'.

    Returns:
        The :class:`Pose` of each start; of tracks in half precision, in single.

    Raises:
        ShapeError: the shapes do not fit, or clips of several lengths are noisy.
    """
    _check(tracks, points, rotations, bones)
    if counts is not None and noise > 0:
        raise ShapeError("procrustean: counts: expected exact tracks (noise=0) of clips that are padded")
    hypotheses, frames, joints, _ = points.shape
    rigid = bones if rigid is None else rigid
    stiff = torch.as_tensor(stiffness, dtype=points.dtype, device=points.device).expand(len(rigid))
    share = tracks.new_ones(frames, joints) if weights is None else weights
    tracks = known(tracks, weights)
    zero = points.new_zeros(hypotheses)
    pose = Pose(points, rotations, zero, zero)
    weight = torch.as_tensor(anchor, dtype=points.dtype, device=points.device).expand(hypotheses)
    pull = (points[..., 2] if held is None else held, weight) if isinstance(anchor, Tensor) or anchor > 0 else None
    for stage in stages:
        pose = _descend(pose, tracks, bones, rigid, stiff, stage, share, noise, counts, pull)
    return pose


def _descend(
    pose: Pose,
    tracks: Tensor,
    bones: Tensor,
    rigid: Tensor,
    stiffness: Tensor,
    stage: Stage,
    weights: Tensor,
    noise: float,
    counts: Tensor | None,
    anchor: tuple[Tensor, Tensor] | None,
) -> Pose:
    """One stage, of which nothing large is left behind."""
    give_back(tracks.shape[0])
    points, rotations = pose.points, pose.rotations
    levels = aligned_levels(points, rotations, bones, stage, counts)
    precision = _precision(points, tracks, weights, noise) if noise > 0 else None
    roots = whitening(
        points, rotations, bones, levels, 3 if noise > 0 else 1, rigid, stiffness, stage.slack,
        precision, counts, anchor[1] if anchor else None,
    )  # fmt: skip
    del levels
    descent = Descent(
        points, rotations, roots, bones, rigid, stiffness, stage,
        tracks=tracks, weights=weights, noise=noise, counts=counts, anchor=anchor,
    )  # fmt: skip
    start = points.new_zeros(len(points), roots[0, ..., 0].numel())
    solution = lbfgs(
        descent, start, num_steps=stage.num_steps, first_step=1.0, tolerance=1e-8, slopes=True, part=descent.rows
    )
    assert solution.before is not None and solution.energy is not None
    points, rotations = descent.moved(solution.value)
    moved = (points - descent.moved(solution.before)[0]).square().sum(-1).mean(-1).sum(-1)
    moved = (moved / (points.shape[1] if counts is None else counts)).sqrt()
    return Pose(points, nearest_rotation(rotations), solution.energy, moved)  # rounding would add up


@widened
def depth_deviation(
    points: Tensor,
    rotations: Tensor,
    bones: Tensor,
    *,
    views: Tensor,
    rigid: Tensor | None = None,
    stiffness: Tensor | float = 1.0,
) -> Tensor:
    """Estimate the standard deviation of depths from the objective's curvature, and from how far the viewpoint turned.

    The curvature in each frame says which joints the others hold: a tip less than a hip. It does not know of errors
    that all frames share, a depth stretched as a whole above all, which only a turning viewpoint rules out: their size
    goes about with the power -0.6 of how far it turned in all, to and fro, and with the power -0.75 of the variance of
    its directions, 1 minus the square of their mean's length. Both were fitted to 91 views of people, dogs and hands
    from cameras that sway by 10 to 35 degrees or go round by 45 to 360; they hold for markers that turned by 5,500.
    How constant lengths come out tells how well the model holds, and deviations go with the root of that. They stay
    below MOST, which is what a guess is off by.

    Args:
        points: (H, T, N, 3), of root mean square near 1.
        rotations: (H, T, 3, 3).
        bones: (B, 2).
        views: (H, T, 3) unit vectors, the directions of view in the world.
        rigid: (P, 2) pairs that keep their distance; ``bones`` where None.
        stiffness: as in :func:`procrustean`.

    Returns:
        (H, T, N), in the unit of the points.
    """
    rigid = bones if rigid is None else rigid
    stiff = torch.as_tensor(stiffness, dtype=points.dtype, device=points.device).expand(len(rigid))
    levels = aligned_levels(points, rotations, bones, TELLING)
    roots = whitening(points, rotations, bones, levels, 1, rigid, stiff, TELLING.slack)
    local = roots[..., :-3, :].norm(dim=-1)
    angle = torch.rad2deg((views[:, 1:] * views[:, :-1]).sum(-1).clamp(-1, 1).arccos().sum(-1)).clamp_min(1.0)
    variance = (1 - views.mean(1).square().sum(-1)).clamp(LITTLE, 1)
    scale = (FULL / angle).pow(0.6) * variance.pow(-0.75)
    if len(rigid):
        spread = bone_vectors(points, rigid).norm(dim=-1).var(-2, unbiased=False).mean(-1).sqrt()
        scale = scale * (spread / CONSTANT).sqrt().clamp(SURE, UNSURE)
    return (1 / (local * scale[:, None, None]).clamp_min(torch.finfo(local.dtype).tiny).square() + MOST**-2).rsqrt()


def aligned_levels(
    points: Tensor, rotations: Tensor, bones: Tensor, stage: Stage, counts: Tensor | None = None
) -> Levels:
    """The rows whose scatter counts: (weight, rows (H, T', 3B), eps, frames that a row links).

    Rows of clips of fewer frames are larger, so that the mean square over all T' is theirs.
    """
    aligned = (bone_vectors(points, bones) @ rotations).flatten(-2)
    frames = aligned.shape[-2]
    if counts is None:
        aligned = aligned - aligned.mean(-2, keepdim=True)
        changes = aligned.diff(dim=-2)
        poses = aligned
    else:
        within = shown(counts, frames)[..., None]
        many = counts[:, None, None]
        aligned = (aligned - aligned.sum(-2, keepdim=True) / many) * within
        changes = aligned.diff(dim=-2) * within[:, 1:] * ((frames - 1) / (many - 1).clamp_min(1)).sqrt()
        poses = aligned * (frames / many).sqrt()
    levels: Levels = []
    if stage.still > 0:
        levels.append((stage.still, poses, stage.eps, 1))
    if stage.moving > 0 and frames > 2:
        levels.append((stage.moving, changes, CHANGE * stage.eps, 2))
    return levels


def motion_energy(points: Tensor, rotations: Tensor, bones: Tensor, stage: Stage) -> Tensor:
    """sum_m w_m T/2 log det of the scatter of aligned bones and of their changes, (...)."""
    total = points.new_zeros(points.shape[:-3])
    for weight, rows, eps, _ in aligned_levels(points, rotations, bones, stage):
        total = total + weight * scatter_log_det(rows, eps)
    return total


def length_energy(points: Tensor, rigid: Tensor, stiffness: Tensor, slack: float) -> Tensor:
    """sum_p s_p T/2 log((v_p + d^2) / (v_p + 9 d^2)), v_p the variance of a length over time, (...)."""
    if len(rigid) == 0:
        return points.new_zeros(points.shape[:-3])
    spread = safe_norm(bone_vectors(points, rigid)).var(-2, unbiased=False)
    return (stiffness * steadiness(spread, points.shape[-3], slack)).sum(-1)


def steadiness(spread: Tensor, frames: int, slack: float) -> Tensor:
    """T/2 log((v + d^2) / (v + 9 d^2)) of variances v over time (...): the less, the steadier."""
    return frames / 2 * ((spread + slack**2) / (spread + (REACH * slack) ** 2)).log()


def track_energy(points: Tensor, tracks: Tensor, weights: Tensor, noise: float) -> Tensor:
    """sum_tn u_tn c^2/2 log(1 + |x_tn - y_tn|^2 / (c noise)^2): Cauchy's, so that outliers do not pull, (...)."""
    square = (points[..., :2] - tracks).square().sum(-1) / (REACH * noise) ** 2
    return REACH**2 / 2 * (weights * square.log1p()).sum((-2, -1))


def align_rotations(points: Tensor, rotations: Tensor, bones: Tensor, *, num_steps: int = 10) -> Tensor:
    """Turn each frame's bones onto their common mean (generalised Procrustes, without scale).

    Args:
        points: (..., T, N, 3) in the camera frame.
        rotations: (..., T, 3, 3) to start from, world to camera.
        bones: (B, 2).
        num_steps: rounds of mean and alignment.

    Returns:
        (..., T, 3, 3).
    """
    vectors = bone_vectors(points, bones)
    for _ in range(num_steps):
        rotations = nearest_rotation(vectors.mT @ (vectors @ rotations).mean(-3, keepdim=True))
    return rotations


def _precision(points: Tensor, tracks: Tensor, weights: Tensor, noise: float) -> Tensor:
    """Curvature (H, T, N) of :func:`track_energy`, its robust weights held."""
    square = (points[..., :2] - tracks).square().sum(-1) / (REACH * noise) ** 2
    return weights / noise**2 / (1 + square)


def _check(tracks: Tensor, points: Tensor, rotations: Tensor, bones: Tensor) -> None:
    if points.ndim != 4 or points.shape[-1] != 3 or tracks.shape != (*points.shape[1:3], 2):
        raise ShapeError(
            "procrustean: expected points (H, T, N, 3) and tracks (T, N, 2), "
            f"got {tuple(points.shape)} and {tuple(tracks.shape)}"
        )
    if rotations.shape != (*points.shape[:2], 3, 3):
        expected = f"{tuple(points.shape[:2])} + (3, 3)"
        raise ShapeError(f"procrustean: expected rotations {expected}, got {tuple(rotations.shape)}")
    if bones.ndim != 2 or bones.shape[-1] != 2 or len(bones) == 0:
        raise ShapeError(f"procrustean: expected bones (B, 2), at least one, got {tuple(bones.shape)}")
