"""Compare one motion with another: which joints and frames are compared, in which unit, after which alignment."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from kcs_torch.errors import OptionError, ShapeError, SkeletonError, counted, listed, unknown
from kcs_torch.functional import centre
from kcs_torch.metrics.align import ALIGNMENTS
from kcs_torch.metrics.errors import bone_deviation, e3d, mpjpe, pck
from kcs_torch.skeleton.mapping import map_joints
from kcs_torch.types import Motion
from kcs_torch.types.hints import is_a
from kcs_torch.types.size import METRES, unit_ratio

__all__ = ["Comparison", "compare"]

_FEWEST = 3
"""Joints of a frame that count, at least: a similarity takes fewer exactly onto any others."""

_ROOTED = ("root", "scale")  # alignments that take the root joint onto the truth's
_SIZED = ("scale", "similarity", "sequence")  # alignments that bring the unit along
_USUAL_PCK = 0.15  # metres
ODD_SIZE = 5.0
"""Times the truth's size, or the inverse of it, from which on the user is asked about the unit."""


@dataclass(frozen=True)
class Comparison:
    """What :func:`compare` found.

    Attributes:
        joints: (name in the prediction, name in the truth) of the joints that are compared.
        frames: how many frames are compared: those in which both show 3 joints.
        units: of the truth, and of ``mpjpe``.
        root: the truth's joint for the alignments ``root`` and ``scale``; None: the middle of the joints.
        mpjpe: mean distance by alignment; ``similarity`` is PA-MPJPE, ``scale`` N-MPJPE.
        mirrored: the same of the prediction's mirror image in depth.
        pck: share of joints within ``pck_within``, by alignment; nothing where the truth's unit is unknown.
        pck_within: in the truth's unit.
        e3d: normalised error of non-rigid structure from motion, one orthogonal matrix for the clip.
        bone_deviation: of the prediction's bones: the median of standard deviation over mean; NaN without bones.
        bone_deviation_truth: of the truth's.
        largest_deviation: of the prediction's bone that strays most from one length; NaN without bones.
        loosest_bone: the name of this bone; empty without bones.
        notes: sentences for the user.
    """

    joints: tuple[tuple[str, str], ...]
    frames: int
    units: str
    root: str | None
    mpjpe: dict[str, float]
    mirrored: dict[str, float]
    pck: dict[str, float]
    pck_within: float
    e3d: float
    bone_deviation: float
    bone_deviation_truth: float
    largest_deviation: float
    loosest_bone: str
    notes: tuple[str, ...] = field(default=())


def compare(
    pred: Motion,
    truth: Motion,
    *,
    align: str | Iterable[str] | None = None,
    root: str | None = None,
    mirror: bool = False,
    within: float | None = None,
) -> Comparison:
    """Compare a motion with the truth: joints by name, frames by number or by time.

    Nothing is mirrored unless asked; ``mirrored`` tells whether the mirror image in depth would be nearer.

    Args:
        pred: of any skeleton and unit.
        truth: of any skeleton and unit; joints that it does not see do not count.
        align: one or more names in :data:`~kcs_torch.metrics.ALIGNMENTS`; all that make sense if None: those without a
            scale need a known size of both, ``none`` has to be asked for.
        root: name of the truth's root joint; a pelvis, if None and one is seen in half of the frames. Frames without it
            do not count for ``root`` and ``scale``; a note says so.
        mirror: compare the prediction's mirror image in depth.
        within: distance for PCK in the truth's unit; 150 mm if None.

    Raises:
        SkeletonError: fewer than 3 joints have counterparts, or there is no such root.
        ShapeError: the frames do not fit each other.
        OptionError: something is not Motion, an alignment is unknown or needs a size that is not known, or ``within``
            is not positive.
    """
    given: dict[str, object] = {"pred": pred, "truth": truth}
    for name, one in given.items():
        if not isinstance(one, Motion):
            hint = "Motion.of(result) makes it of a result"
            raise OptionError(f"compare: {name}: expected Motion, got {type(one).__name__}; {hint}")
    if within is not None and not (is_a(within, float) and 0 < within < math.inf):
        raise OptionError(f"within (--within): expected a positive distance, got {within!r}")
    notes: list[str] = []
    names = _joints(pred, truth, notes)
    pred, truth = _same_frames(pred, truth, notes)
    ratio = unit_ratio(pred.units, truth.units) if pred.units in METRES and truth.units in METRES else None
    if ratio is None and pred.units and pred.units == truth.units:
        ratio = 1.0
    chosen = _alignments(align, ratio, pred, truth)
    ours = [pred.skeleton.index(name) for name, _ in names]
    theirs = [truth.skeleton.index(name) for _, name in names]
    points = (ratio or 1.0) * pred.points[:, ours].to(truth.points)
    target = truth.points[:, theirs]
    gone = ~pred.seen[:, ours].to(target.device)
    if bool(gone.any()):
        notes.append(f"{100 * float(gone.double().mean()):.1f} % of the prediction's joints are missing: not compared")
    weights = (truth.seen[:, theirs] & ~gone).to(target)
    enough = (weights > 0).sum(1) >= _FEWEST
    frames = int(enough.sum())
    if not frames:
        raise ShapeError(f"compare: expected a frame in which {_FEWEST} joints of both are seen, got none")
    if frames < len(weights):
        fewer = f"fewer than {_FEWEST} joints of both are seen"
        notes.append(f"{len(weights) - frames} of {counted(len(weights), 'frame')}, in which {fewer}: not compared")
    weights = weights * enough[:, None]
    if ratio is not None:
        notes += _odd_size(points, target, weights, pred.units)
    at = _root(root, [name for _, name in names], weights)
    rooted = [how for how in chosen if how in _ROOTED]
    if at is not None and rooted and (without := frames - int((weights[:, at] > 0).sum())):
        words = f"the root {names[at][1]} is not seen in {without} of {counted(frames, 'compared frame')}"
        notes.append(f"{words}, which do not count for {' and '.join(rooted)}")
    flip = points * points.new_tensor([1.0, 1.0, -1.0])
    if mirror:
        points, flip = flip, points
    figure = lambda p, how: float(mpjpe(p, target, align=how, weights=weights, root=at))  # noqa: E731
    limit = within if within is not None else _USUAL_PCK / METRES[truth.units] if truth.units in METRES else math.nan
    variation = pred.variation
    return Comparison(
        joints=tuple(names),
        frames=frames,
        units=truth.units,
        root=None if at is None else names[at][1],
        mpjpe={how: figure(points, how) for how in chosen},
        mirrored={how: figure(flip, how) for how in chosen},
        pck={
            how: float(pck(points, target, limit, align=how, weights=weights, root=at))
            for how in (chosen if math.isfinite(limit) else ())
        },
        pck_within=limit,
        e3d=float(e3d(points, target, weights=weights)) if ratio is not None else math.nan,
        bone_deviation=_deviation(pred),
        bone_deviation_truth=_deviation(truth),
        largest_deviation=variation.largest / 100,
        loosest_bone=variation.bone,
        notes=tuple(notes),
    )


def _odd_size(points: Tensor, target: Tensor, weights: Tensor, units: str) -> list[str]:
    """What to say of points (T, N, 3) far smaller or larger than the target's: metres taken for millimetres, say."""
    ours, theirs = (
        float((centre(torch.where(weights[..., None] > 0, p, 0), weights)[0] * weights[..., None]).norm())
        for p in (points, target)
    )
    if theirs == 0 or 1 / ODD_SIZE < ours / theirs < ODD_SIZE:
        return []
    return [f"the prediction is {ours / theirs:.2g} times as large as the truth: is '{units}' its unit?"]


def _joints(pred: Motion, truth: Motion, notes: list[str]) -> list[tuple[str, str]]:
    """Names of the joints that mean the same."""
    ours, theirs = pred.skeleton.joints, truth.skeleton.joints
    found = map_joints(ours, theirs)
    names = [(ours[i], name) for i, name in zip(found, theirs, strict=True) if i is not None]
    if len(names) < 3:
        raise SkeletonError(
            f"expected at least 3 joints that mean the same by their names, got {len(names)}: {pred.source} has "
            f"{listed(ours, 12)}; {truth.source} has {listed(theirs, 12)}"
        )
    for motion, used in ((pred, {a for a, _ in names}), (truth, {b for _, b in names})):
        spare = [joint for joint in motion.skeleton.joints if joint not in used]
        if spare:
            notes.append(f"not compared, only in {motion.source}: {', '.join(spare)}")
    return names


def _same_frames(pred: Motion, truth: Motion, notes: list[str]) -> tuple[Motion, Motion]:
    """The frames that belong together: all, or every so many of the faster one.

    Raises:
        ShapeError: neither their number nor their rates tell.
    """
    counts = pred.num_frames, truth.num_frames
    if counts[0] == counts[1]:
        if pred.fps and truth.fps and abs(pred.fps / truth.fps - 1) > 0.01:
            notes.append(
                f"both have {counts[0]} frames, compared by number, though at {pred.fps:g} and {truth.fps:g} a second"
            )
        return pred, truth
    if pred.fps and truth.fps:
        fast, slow = (pred, truth) if pred.fps > truth.fps else (truth, pred)
        assert fast.fps is not None and slow.fps is not None
        step = round(fast.fps / slow.fps)
        thinned = fast.frames(0, fast.num_frames, step)
        if abs(fast.fps / slow.fps - step) < 0.01 * step and abs(thinned.num_frames - slow.num_frames) <= 1:
            count = min(thinned.num_frames, slow.num_frames)
            which = "frames" if step == 1 else f"every {step} frames"
            notes.append(f"{which} of {fast.source} are compared with {slow.source}, the first {count}")
            thinned, slow = thinned.frames(0, count), slow.frames(0, count)
            return (thinned, slow) if fast is pred else (slow, thinned)
    if pred.fps and truth.fps and abs(pred.fps / truth.fps - 1) < 0.01:
        raise ShapeError(
            f"expected as many frames in both, which have the same rate, got {pred.num_frames} in {pred.source} and "
            f"{truth.num_frames} in {truth.source}: cut the longer one, by its frames(start, stop) or "
            "by --pred-frames or --truth-frames A:B of kcs-torch score"
        )
    rates = [f"{m.num_frames} frames at {f'{m.fps:g} a second' if m.fps else 'an unknown rate'}" for m in (pred, truth)]
    raise ShapeError(
        f"expected as many frames in both, or rates that are multiples of each other, got {rates[0]} in {pred.source} "
        f"and {rates[1]} in {truth.source}: cut or resample one, or say the rates with fps"
    )


def _alignments(align: str | Iterable[str] | None, ratio: float | None, pred: Motion, truth: Motion) -> list[str]:
    if align is None:
        return [how for how in ALIGNMENTS if how in _SIZED or (ratio is not None and how != "none")]
    names = list(align) if isinstance(align, Iterable) and not isinstance(align, str) else [align]
    for how in names:
        if not isinstance(how, str) or how not in ALIGNMENTS:
            raise unknown("alignment", how, ALIGNMENTS)
        if ratio is None and how not in _SIZED:
            raise OptionError(
                f"alignment '{how}' keeps sizes, but the prediction is in {pred.units or 'an unknown unit'} and the "
                f"truth in {truth.units or 'an unknown unit'}: set the size with scaled() or --scale, or use "
                f"{', '.join(_SIZED)}"
            )
    return list(dict.fromkeys(names))


def _root(name: str | None, shared: Sequence[str], weights: Tensor) -> int | None:
    """Where the root is among the compared joints, of weights (T, N): as named, or a pelvis.

    One that is seen in fewer than half of the frames that count is none: figures would rest on the others.
    """
    if name is not None:
        if name not in shared:
            raise unknown("root among the compared joints", name, shared, SkeletonError)
        return shared.index(name)
    seen = weights > 0
    often = (2 * seen.sum(0) >= seen.any(1).sum()).tolist()
    found = [map_joints(shared, [pelvis])[0] for pelvis in ("pelvis", "mid_hip")]
    return next((at for at in found if at is not None and often[at]), None)


def _deviation(motion: Motion) -> float:
    body = motion.skeleton
    if not body.rigid:
        return math.nan
    bones: Tensor = body.bone_index(device=motion.points.device)[torch.tensor(body.rigid)]
    return float(bone_deviation(motion.points, bones, weights=motion.weights))
