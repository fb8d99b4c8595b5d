"""A walking person, by forward kinematics.

Joint angles over a stride follow the usual curves of level walking (J. Perry, "Gait analysis", 1992; D. Winter,
"Biomechanics and motor control of human movement", 1990), in whole degrees at every tenth of the stride, which are
changed by a few degrees so that the standing foot stays where it is.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from kcs_torch.anatomy import places_by_names

__all__ = ["STRIDE_METRES", "STRIDE_SECONDS", "joint_segments", "outer", "rank", "segment_rotations", "walking_path"]

STRIDE_SECONDS = 1.1
STRIDE_METRES = 1.34
# Degrees at 0, 10, ... 90 per cent of the stride, which begins as the heel touches the ground.
_THIGH = (21, 17, 6, -4, -12, -20, -11, 10, 29, 26)  # forwards of the vertical
_KNEE = (3, 11, 6, 3, 5, 5, 35, 60, 40, 6)  # flexion
_ANKLE = (-6, -4, 2, 9, 18, 12, -7, -7, 2, 5)  # toes up
_ARM_SWING, _ELBOW_FLEXION = 17.0, 11.0
_PELVIS_TURN, _PELVIS_DROP, _TRUNK_LEAN = 6.0, 3.0, 4.0
_HIP_HEIGHT, _BOB, _SWAY = 0.884, 0.018, 0.02  # metres

_SEGMENTS = {
    "pelvis": "midhip sacrum hip hip_inner",
    "trunk": "spine_low spine_sixth spine spine1 spine2 spine3 chest thorax neck clavicle shoulder",
    "head": "neck1 upperneck neck2 head headtop nose mouth chin eye eyeinner eyeouter ear",
    "arm": "elbow",
    "forearm": "radius wrist hand fingers fingerbase thumb index pinky",
    "thigh": "knee",
    "shank": "ankle",
    "foot": "heel ball bigtoe smalltoe toetip",
}
_SEGMENT_OF = {place: segment for segment, places in _SEGMENTS.items() for place in places.split()}
_ORDER = ("pelvis", "trunk", "head", "thigh", "arm", "shank", "forearm", "foot")  # inner ones first


def joint_segments(names: Sequence[str]) -> list[str]:
    """Return the name of the body segment whose rotation moves each joint, such as "shank left" for an ankle.

    Raises:
        SkeletonError: a name is not known as part of a human.

    >>> joint_segments(["pelvis", "LKnee", "RAnkle"])
    ['pelvis', 'thigh left', 'shank right']
    """
    out = []
    for side, place in places_by_names(names):
        segment = _SEGMENT_OF.get(place, "forearm")  # the rest are fingers
        out.append(segment if segment in ("pelvis", "trunk", "head") else f"{segment} {side}")
    return out


def outer(first: str, second: str) -> str:
    """Return that one of two segments which a bone between their joints belongs to."""
    return max(first, second, key=rank)


def rank(segment: str) -> int:
    """Return how far out a segment is: 0 for the pelvis."""
    return _ORDER.index(segment.split()[0])


def segment_rotations(phase: Tensor) -> dict[str, Tensor]:
    """Return the rotation of every body segment against the template, in the template's axes.

    Args:
        phase: (T,) strides since the left heel touched the ground.

    Returns:
        ``{segment: (T, 3, 3)}``.
    """
    wave = torch.cos(2 * torch.pi * phase)  # 1 as the left leg is foremost, -1 as the right one is
    double = torch.sin(4 * torch.pi * phase)
    turn = _about("y", _PELVIS_TURN * wave)
    sway = torch.sin(2 * torch.pi * phase)
    lean = _about("x", -_TRUNK_LEAN + 0.8 * double)
    out = {
        "pelvis": turn @ _about("z", -_PELVIS_DROP * sway),
        "trunk": _about("y", -0.8 * _PELVIS_TURN * wave) @ lean @ _about("z", 1.5 * sway),
        "head": _about("y", -0.2 * _PELVIS_TURN * wave) @ _about("x", -2.0 + 0.8 * double),
    }
    for side, start, ahead in (("left", 0.0, -wave), ("right", 0.5, wave)):
        own = phase + start
        thigh = _curve(_THIGH, own)
        shank = thigh - _curve(_KNEE, own)
        arm = _ARM_SWING * ahead - 2
        for segment, angle in (
            ("thigh", thigh),
            ("shank", shank),
            ("foot", shank + _curve(_ANKLE, own)),
            ("arm", arm),
            ("forearm", arm + _ELBOW_FLEXION * (1.2 + ahead)),
        ):
            out[f"{segment} {side}"] = _about("x", angle)
    return out


def walking_path(phase: Tensor) -> Tensor:
    """Return where the middle of the hips is; the standing foot then neither sinks nor slides by a centimetre.

    Args:
        phase: (T,) strides since the left heel touched the ground.

    Returns:
        (T, 3) in metres above the floor and along the way, for a stature of 1.75 m.
    """
    over = _SWAY * torch.sin(2 * torch.pi * phase)  # the standing foot
    height = _HIP_HEIGHT - _BOB * torch.cos(4 * torch.pi * phase)  # lowest when both feet stand
    return torch.stack([over, -height, -STRIDE_METRES * phase], -1)


def _curve(table: Sequence[float], phase: Tensor) -> Tensor:
    """The smooth periodic curve through a table, (T,): its trigonometric interpolation."""
    values = torch.tensor(table, dtype=phase.dtype, device=phase.device)
    count = len(table)
    factors = torch.fft.rfft(values) / count
    order = torch.arange(len(factors), dtype=phase.dtype, device=phase.device)
    weight = torch.where((order == 0) | (2 * order == count), 1.0, 2.0)
    angle = 2 * torch.pi * phase[:, None] * order
    return (weight * (factors.real * angle.cos() - factors.imag * angle.sin())).sum(-1)


def _about(axis: str, degrees: Tensor) -> Tensor:
    """Rotations (T, 3, 3) about an axis of the template (x to the person's left, y down, z backwards).

    Positive angles swing what hangs down forwards (x), the left side forwards (y), the left side down (z).
    """
    angle = torch.deg2rad(degrees)
    c, s, o, i = angle.cos(), angle.sin(), torch.zeros_like(angle), torch.ones_like(angle)
    rows = {
        "x": ((i, o, o), (o, c, s), (o, -s, c)),
        "y": ((c, o, s), (o, i, o), (-s, o, c)),
        "z": ((c, -s, o), (s, c, o), (o, o, i)),
    }[axis]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)
