"""What is said beside the best solution: other solutions, what the prior decided, and how sure depth is."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcs_torch.functional.chain import bone_vectors, chain_inverse, incidence
from kcs_torch.functional.ranks import kth_smallest
from kcs_torch.methods.clips.template import guessed
from kcs_torch.methods.pkc.hypotheses import Hypotheses
from kcs_torch.methods.pkc.objective import Objective, bone_noise
from kcs_torch.skeleton import Skeleton

__all__ = ["APART", "CLOSE", "angle_doubt", "depth_deviation", "guess_variance", "hardly_told", "told_by_prior"]

APART = 0.04
"""Root mean square depth by which solutions must differ to be told apart, a person being about 1.75 tall."""

CLOSE = 10.0
"""Objective by which another solution may be worse and still be a rival."""

ANGLE = 0.1
"""Standard deviation, in radians, of a bone's angle to the image plane where it is nearest to it: what postures, hinges
and proportions tell of a length that no crossing of the plane tells."""

FRONT, SIDE, ASIDE, BLURRED = 2.6, 0.5, 0.1, 0.75
"""How uncertain angles are, in ``ANGLE``, of a body that is seen exactly from the front or from behind, what is left of
that from the side, and the sine of the direction from which on it falls: a body that leans moves in the image only if
it is seen from aside. The square of that sine grows by so much of the image's noise, as a share of bones' lengths."""

TILT = 1.2
"""How uncertain angles are, in ``ANGLE``, for each unit of the slope at which the template's upright axis comes towards
the camera, as one that looks down sees it: all bones along it are foreshortened at once, and only proportions tell."""

USUAL = 0.12
"""Standard deviation of a length of which the image tells nothing, as a share: bodies differ by so much."""

LEAST = 0.05
"""Slope at which a bone counts that passes through the image plane: more moves its depth than what its length does."""

FLAT = 0.11
"""Share of its length below which a bone's depth is no better known for being small."""

STEEP = 0.98
"""Largest share of its length that counts as a bone's depth: its angle is no better known."""

NEAREST = 0.02
"""Share of the frames in which a bone may be nearer to the image plane than where it counts as nearest."""

LEVEL = 0.4
"""A bone in the image plane is as unsure in depth as the root of this share of noise times length: noise adds twice
that product at most to the square of its depth, of which neighbours make good the most, and other frames where the
viewpoint turns."""

POSTURE, STRANGE = 0.167, 1.5
"""Energy of usual postures, for each bone and frame that counts, and the power of a larger one that deviations go with:
the further postures stray, the less the template tells of them."""

ODDITY = 0.09
"""By how much a usual body's lengths stray from the template's. One of twice that is told by it half as well, and so
the viewpoint's turn tells as much where it is half as far."""

TURN, POWER = 48.0, 1.25
"""Degrees of the viewpoint's turn that tell as much as the template, and the power of the turn that deviations fall
with; those that noise leaves open in the image plane with half of it."""

SHORT, LEAST_FRAMES, AROUND = 8.0, 12, 240.0
"""Independent frames up to which angles are the less sure the fewer there are, up to three times; frames from which on,
as shorter clips are taken to be noisy, which says as much; and degrees of a turn that make good for it."""

RIVAL, COLD, HOT = 0.5, 6.0, 35.0
"""Odds of another solution that is no worse, objective by which they fall to a third, and the same of a detector's
joints, whose errors last, so that frames tell less than the objective takes them to."""

NEAR = 0.016
"""Standard deviation of a detector's joint, a standing person being about 1.75 tall, beyond what the objective allows
for: the camera is a few metres away, and joints are defined in another way than bones are."""

HEADING = 0.18
"""Standard deviation, in radians, of the direction from which a detector's joints are seen: without intrinsics nobody
knows how far from the image's middle that is, and what is nearer looks larger, as if the body leant."""

HINT = 1 / 3
"""Share of itself that a depth which rests on a guessed template may be off by before it is called a hint."""


def told_by_prior(found: Hypotheses, skeleton: Skeleton) -> list[str]:
    """Bones whose depth has another sign in a rival solution, for a good part of the clip."""
    rivals = found.energy - found.energy[0] < CLOSE
    dz = bone_vectors(found.depth[..., None], skeleton.bone_index(device=found.depth.device))[..., 0]  # (H, T, B)
    size = found.lengths[:1, None]
    flipped = (dz * dz[:1] < 0) & (torch.minimum(dz.abs(), dz[:1].abs()) > 0.15 * size)
    share = flipped.double().mean(1) * rivals[:, None]
    return [skeleton.bone_names[b] for b in (share.amax(0) > 0.3).nonzero().flatten().tolist()]


@torch.no_grad()
def angle_doubt(objective: Objective, depth: Tensor, lengths: Tensor, turn: float) -> float:
    """How uncertain angles of a solution (T, N), (B,) are, over those of usual postures before a camera at rest.

    More where postures stray from the template, the body is seen from the front, from above or in a short clip, and
    less where it is seen from aside, the more so the less noise there is, or the viewpoint turned by ``turn`` degrees.
    """
    posture = objective.posture
    points = torch.cat([objective.image, depth[..., None]], -1)
    counted = (len(depth) / posture.correlation + posture.strength) * len(lengths)
    strange = float(posture(points[None], lengths[None])) / counted / POSTURE
    odd = max(1.0, objective.oddity(lengths) / ODDITY)
    upright, forward = posture.frame(points)[:, 2, 1:].square().unbind(-1)  # of its axes towards the camera
    level = (1 - upright).clamp_min(torch.finfo(points.dtype).eps)
    aside = float((1 - forward / level).mean())  # however the image is turned
    tilt = float(upright.mean())
    blur = objective.usual_noise / max(float(lengths.mean()), 1e-9)
    view = FRONT**2 / (1 + aside / (ASIDE**2 + BLURRED * blur)) + SIDE**2 + TILT**2 * tilt / max(1 - tilt, 1 - STEEP**2)
    told = 1 / view + (odd * turn / TURN) ** (2 * POWER)
    frames = len(depth)
    few = SHORT * posture.correlation / frames if frames >= LEAST_FRAMES else 1.0
    short = 1 + (min(max(few, 1.0), 3.0) - 1) * max(0.0, 1 - turn / AROUND)
    return short * odd * max(1.0, strange) ** STRANGE / math.sqrt(told)


def guess_variance(skeleton: Skeleton, lengths: Tensor, turn: float) -> Tensor:
    """Variance of the depths (B,) of bones of these lengths for the template's being a guess; 0 if it is none.

    An animal's build and stance stray from the guess as poses stray from each other, but for the whole clip, and no
    camera that stands still sees it. Half of the square of a bone's stray goes in depth. The viewpoint's ``turn``, in
    degrees, tells as it does of angles.
    """
    if not guessed(skeleton) or skeleton.spread is None:
        return torch.zeros_like(lengths)
    stray = torch.deg2rad(lengths.new_tensor(skeleton.spread)).sin()
    return (lengths * stray).square() / 2 / (1 + (turn / TURN) ** (2 * POWER))


def hardly_told(depth: Tensor, deviation: Tensor, skeleton: Skeleton, turn: float) -> str:
    """Why depths (T, N) that rest on a guessed template are little more than a hint; empty where they are more.

    They do where the viewpoint turns by less than what tells as much, ``turn`` in degrees.
    """
    off, deep = (float(x.square().mean().sqrt()) for x in (deviation, depth - depth.mean(-1, keepdim=True)))
    if turn >= TURN or off <= HINT * deep or not guessed(skeleton):
        return ""
    return (
        "depth is a hint rather than a measurement: it rests on a guessed template of an animal on four legs, and may "
        f"well be off by {100 * off / max(off, deep):.0f} % of itself. A viewpoint that turns, or a template of this "
        "animal, tells more"
    )


def depth_deviation(
    found: Hypotheses,
    noise: Tensor,
    skeleton: Skeleton,
    *,
    doubt: float = 1.0,
    turn: float = 0.0,
    image: Tensor | None = None,
    guess: Tensor | None = None,
) -> Tensor:
    """Standard deviation of the best solution's depths, (T, N).

    A bone's depth dz = sqrt(L^2 - |xy|^2) is off by L dL / |dz|: little where it points at the camera, much where it is
    nearly parallel to the image. Its length is told best where it is nearest to the image plane: off by an angle a
    there, L is off by tan(a) da, so hardly where it passes through the plane. These add up along the chain to the
    body's middle; rival solutions add their distance.

    Args:
        found: solutions, best first.
        noise: (T, N) standard deviation of the joints' images.
        skeleton: of the N joints.
        doubt: of angles, see :func:`angle_doubt`.
        turn: degrees by which the viewpoint turned.
        image: (T, N, 2) of a detector's joints, or None: these may be off in many ways that their noise does not tell.
        guess: (B,) variance of the bones' depths besides, see :func:`guess_variance`.
    """
    bones = skeleton.bone_index(device=noise.device)
    dz = bone_vectors(found.depth[0][..., None], bones)[..., 0]  # (T, B)
    length = found.lengths[0].clamp_min(1e-9)
    steep = (dz.abs() / length).clamp_max(STEEP)
    nearest = kth_smallest(steep, 1 + int(NEAREST * (len(steep) - 1)), 0).square()
    told = (nearest / (1 - nearest) + LEAST**2) * (doubt * ANGLE) ** 2  # tan(a)^2 da^2
    told = told * USUAL**2 / (told + USUAL**2)
    if image is not None:
        noise = noise.square().add(NEAR**2).sqrt()
    blur, level = bone_noise(noise, bones), LEVEL * length / (1 + (turn / TURN) ** POWER)
    wrong = length.square() * told / (steep.square() + FLAT**2)
    wrong = wrong + level * blur.square() / (level * steep.square() + blur).clamp_min(1e-12)
    tree = chain_inverse(incidence(bones, skeleton.num_joints, dtype=noise.dtype))  # (N, B)
    variance = (wrong if guess is None else wrong + guess) @ tree.square().mT
    if image is not None:
        variance = variance + HEADING**2 * (image - image.mean(-2, keepdim=True)).square().sum(-1)
    if len(found.energy) > 1:
        odds = RIVAL * torch.exp(-(found.energy - found.energy[0]) / (COLD if image is None else HOT))
        odds = torch.cat([torch.ones_like(odds[:1]), odds[1:]])
        variance = variance + torch.einsum("h,htn->tn", odds / odds.sum(), (found.depth - found.depth[0]).square())
    return variance.sqrt()
