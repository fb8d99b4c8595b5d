"""What tells that a solution is not the tracks' body, for the user."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from kcs_torch.errors import counted
from kcs_torch.functional.align import centre
from kcs_torch.functional.chain import bone_lengths
from kcs_torch.functional.ranks import median, nanmedian
from kcs_torch.functional.weights import rms
from kcs_torch.methods.clips.template import guessed
from kcs_torch.nn.lengths import oddity
from kcs_torch.skeleton import Skeleton
from kcs_torch.types import Tracks
from kcs_torch.types.variation import bone_shares

if TYPE_CHECKING:
    from kcs_torch.methods.base import Method

__all__ = ["LOOSE", "WHY_LOOSE", "loose_bones", "what_is_wrong"]

LOOSE = 5.0
"""Per cent of bone variation from which on the tracks are hardly those of a body of this skeleton."""

PART = 2.0
"""Per cent of the body's size by which a bone's length has to vary as well to be told by name: short bones vary."""

ODD, DEEP = 0.4, 1.0
"""Root mean square of the logarithms of lengths over the skeleton's, and depth over the size in the image, beyond which
a body is another: people in odd postures, seen by detectors, come to .4 and .5."""

OTHER = 0.6
"""The former, beyond which it is another whatever its depth, unless a guess at an animal is all that is known of it."""

AWAY, OFTEN = 0.25, 0.1
"""Share of the body's size by which a joint is away from its tracks in most of the frames that show it, and the share
of frames that have to show it, from which on it is another joint; or most joints in this share of the frames, which are
another body's. Noise of 40 mm comes to .1 of the size."""

POINT = 1e-6
"""Size in the image, over the depth, up to which a body is a point."""

NAMED = 3
"""Joints or bones that are told by name, at most."""

WHY_LOOSE = (
    "joints may be wrong, swapped or in another order, the skeleton may be another, parts of the body may bend, or the "
    "camera may be so near that its intrinsics matter"
)


def what_is_wrong(
    method: Method, points: Tensor, images: Tensor, tracks: Tracks, settled: bool, lengths: Tensor | None = None
) -> list[str]:
    """What about points (T, N, 3) and their images (T, N, 2) tells that they are not the body's, and why that may be.

    Lengths that vary are no news of a solution that did not settle, and none of bones whose ends the tracks never show;
    a body unlike any is why it does not settle.
    """
    body = tracks.skeleton
    told = [loose_bones(points, body, lengths, tracks.seen.any(0)) if method.keeps_lengths and settled else ""]
    told.append(odd_body(points, body, lengths) if method.knows_template(body) else "")
    told.append(far_joints(images, tracks) if method.keeps_lengths else "")
    return [f"{sentence}: {WHY_LOOSE}" for sentence in told if sentence]


def far_joints(images: Tensor, tracks: Tracks) -> str:
    """Which joints' images (T, N, 2) are away from their tracks in most frames, or most joints' in which frames.

    A sentence for the user; empty where none is.
    """
    seen = tracks.seen
    joints = (seen.to(images.dtype).mean(0) >= OFTEN).nonzero().flatten().tolist() if len(seen) else []
    size = float(rms(centre(tracks.points, tracks.weights)[0], seen.to(images.dtype))) if joints else 0.0
    if not size > 0:
        return ""
    away = torch.where(seen, ((images - tracks.points) / size).norm(dim=-1), torch.nan)[:, joints]
    off = nanmedian(away, 0)
    found = (off > AWAY).nonzero().flatten()
    named = [f"{tracks.skeleton.joints[joints[i]]} by {100 * float(off[i]):.0f} %" for i in found.tolist()]
    if named:
        by = _the_worst(named, off[found])
        return f"joints are away from their tracks in most frames that show them, {by} of the body's size"
    off = nanmedian(away, 1)
    frames = (off > AWAY).nonzero().flatten()
    if len(frames) < OFTEN * len(seen):
        return ""
    return (
        f"in {len(frames)} of {counted(len(seen), 'frame')}, from frame {int(frames[0])} on, most joints are away from "
        f"their tracks, by up to {100 * float(off[frames].amax()):.0f} % of the body's size"
    )


def _the_worst(named: Sequence[str], by: Tensor, kind: str = "joint") -> str:
    """The worst of what is ``named``, ``by`` (K,) so much, and how many more there are."""
    shown, more = [named[i] for i in by.argsort(descending=True).tolist()], len(named) - NAMED
    return ", ".join(shown[:NAMED]) + (f" and {counted(more, f'more {kind}')}" if more > 0 else "")


def loose_bones(points: Tensor, body: Skeleton, lengths: Tensor | None = None, seen: Tensor | None = None) -> str:
    """Which rigid bones of points (T, N, 3), of lengths (T, B), change theirs, for the user; empty where none does.

    Only bones between joints that are ``seen`` (N,) count.
    """
    ever = [True] * body.num_joints if seen is None else seen.tolist()
    rigid = [b for b in body.rigid if all(ever[joint] for joint in body.bones[b])]
    if not rigid or not len(points):
        return ""
    bones = (bone_lengths(points, body.bone_index(device=points.device)) if lengths is None else lengths)[:, rigid]
    spread, share = bones.std(0, correction=0), 100 * bone_shares(bones)
    if float(share.median()) > LOOSE:
        return f"bone lengths vary by {float(share.median()):.1f} %"
    if not body.is_tree:  # links between markers, say, of which some bend
        return ""
    size = (points - points.mean(1, keepdim=True)).square().sum(-1).mean().sqrt()
    found = ((share > LOOSE) & (100 * spread > PART * size)).nonzero().flatten().tolist()
    if not found:
        return ""
    named = [f"{body.bone_names[rigid[b]]} by {float(share[b]):.0f} %" for b in found]
    return f"lengths of rigid bones vary: {_the_worst(named, share[found], 'bone')}"


def odd_body(points: Tensor, body: Skeleton, lengths: Tensor | None = None) -> str:
    """How points (T, N, 3) are unlike any body of the skeleton, for the user; empty where they are not."""
    usual = body.relative_lengths(dtype=points.dtype, device=points.device)
    rigid = list(body.rigid)
    if usual is None or not rigid or not len(points):
        return ""
    own = median(bone_lengths(points, body.bone_index(device=points.device)) if lengths is None else lengths, 0)
    odd = oddity(own[rigid], usual[rigid])
    middle = points - points.mean(1, keepdim=True)
    wide, far = float(middle[..., :2].norm()), float(middle[..., 2].norm())
    deep = far > DEEP * wide
    if odd <= ODD or not (deep or (odd > OTHER and not guessed(body))) or wide <= POINT * far:
        return ""  # a point in the image shows no body
    also = f", and it is {far / wide:.1f} times as deep as it is large in the image" if deep else ""
    return (
        f"this is hardly a body of skeleton '{body.name}': bones are {math.exp(odd):.1f} times as long or as short as "
        f"usual{also}"
    )
