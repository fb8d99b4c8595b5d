"""Follow people over frames, where a detector lists them in a different order in each frame.

Frame by frame, the detections are assigned to the people seen so far so that the sum of distances is least. A
person's pose is carried on at constant velocity, so that two who cross keep their names, and stays open for a while
after it was last seen, so that a gap does not make two people of one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["follow_people", "link_people", "longest_gap"]

Array = NDArray[np.float64]

# Costs are in sizes of the person, as distances are.
_REACH = 0.5  # farther off than this is somebody else
_NOBODY = 0.4  # cost of leaving somebody without a detection
_FARTHEST = 0.7  # a joint counts as no farther off: left and right confused do not make somebody else of a person
_RANK = 0.5  # gain where somebody well seen so far gets a well seen detection: keeps ghosts from taking over
_MEMORY = 0.95  # how slowly it fades how well somebody was seen
_NEW = 0.2  # what share of its confidence a first sight counts for: a ghost's is less than theirs who went missing
_SIZE = 0.2  # cost of a size that differs by a factor of e
_VELOCITY = 0.4  # share of the newest displacement in the running velocity
_SPEED_UP = 0.1  # sizes of the person by which the running velocity changes in a frame, at most
_COAST = 0.9  # the velocity fades by this factor with each frame of a gap
_MOST_OPEN = 200  # people who may be out of sight at a time; of more, those seen last


def longest_gap(fps: float | None) -> int:
    """Frames for which somebody may be out of sight: a second's, or 30 where the rate is not known."""
    return max(round(min(fps or 30.0, 1e6)), 1)


@dataclass
class _Person:
    """Somebody seen so far: pose at the last sight, and how it moves on."""

    pose: Array  # (N, 3) last seen place of each joint, and its confidence, which fades while it is unseen
    size: float
    frame: int  # when last seen
    velocity: Array  # (2,) of the whole body, per frame
    strength: float  # running mean of the confidence of all joints, 0 before the first sight and in frames without one
    seen: list[tuple[int, int]]  # (frame, index among its detections)


def link_people(detections: Sequence[Array], *, max_gap: int = 30) -> list[Array]:
    """Link the detections of each frame into one track a person.

    Args:
        detections: for each of T frames an array (P, N, 3) of P people's joints as (x, y, confidence); P may differ
            from frame to frame and be 0. Joints of confidence 0 are unseen.
        max_gap: frames after which somebody unseen who comes back counts as somebody new.

    Returns:
        One array (T, N, 3) a person, zero where unseen; the most seen (sum of confidences) first. Nothing is dropped:
        short-lived ghosts come last.

    >>> still, moving = np.array([[0.0, 0, 1], [0, 9, 1]]), np.array([[50.0, 0, 1], [50, 9, 1]])
    >>> step = np.array([1.0, 0, 0])
    >>> a, b = link_people([np.stack([still, moving]), np.stack([moving + step, still])])
    >>> a[:, 0, 0].tolist(), b[:, 0, 0].tolist()
    ([0.0, 0.0], [50.0, 51.0])
    """
    tracks = []
    for seen in follow_people(detections, max_gap=max_gap):
        track = np.zeros((len(detections), *detections[seen[0][0]].shape[1:]))
        for t, index in seen:
            track[t] = detections[t][index]
        tracks.append(track)
    return tracks


def follow_people(detections: Sequence[Array], *, max_gap: int = 30) -> list[list[tuple[int, int]]]:
    """Say who is who, as :func:`link_people`, which see: each person as (frame, index among its detections)."""
    people: list[_Person] = []
    open_people: list[_Person] = []
    for t, found in enumerate(detections):
        visible = np.flatnonzero((found[..., 2] > 0).any(-1)) if len(found) else np.zeros(0, int)
        open_people = [p for p in open_people if t - p.frame <= max_gap]
        if len(open_people) > _MOST_OPEN:
            open_people = sorted(open_people, key=lambda p: (p.frame, p.strength))[-_MOST_OPEN:]
        taken = _assign(open_people, found[visible], t) if len(visible) else {}
        for k, index in enumerate(visible):
            person = taken.get(k)
            if person is None:
                size, strength = float(_sizes(found[index][None])[0]), _NEW * float(found[index, :, 2].mean())
                person = _Person(found[index], size, t, np.zeros(2), strength, [(t, int(index))])
                people.append(person)
                open_people.append(person)
            else:
                _update(person, found[index], t)
                person.seen.append((t, int(index)))
    amounts = [sum(float(detections[t][i, :, 2].sum()) for t, i in p.seen) for p in people]
    order = sorted(range(len(people)), key=lambda k: -amounts[k])
    return [people[k].seen for k in order]


def _assign(people: list[_Person], found: Array, frame: int) -> dict[int, _Person]:
    """Who each detection (P, N, 3) is; those who are nobody known are left out."""
    if not people:
        return {}
    gap = np.array([frame - p.frame for p in people], float)
    drift = np.array([p.velocity for p in people]) * ((1 - _COAST**gap) / (1 - _COAST))[:, None]
    poses = np.array([p.pose for p in people])
    where = poses[..., :2] + drift[:, None]  # (K, N, 2)
    size = np.array([p.size for p in people])
    own = _sizes(found)
    scale = np.maximum(size[:, None], own[None])  # (K, P)

    joint = np.linalg.norm(where[:, None] - found[None, ..., :2], axis=-1) / scale[..., None]  # (K, P, N)
    weight = np.minimum(poses[:, None, :, 2], found[None, ..., 2])
    total = weight.sum(-1)
    distance = (np.minimum(joint, _FARTHEST) * weight).sum(-1) / np.maximum(total, 1e-9)
    apart = np.linalg.norm(_centres(poses)[:, None] + drift[:, None] - _centres(found)[None], axis=-1) / scale
    distance = np.where(total > 0, distance, apart)
    cost = distance + _SIZE * np.minimum(np.abs(np.log(size[:, None] / own[None])), 1)
    strength = np.array([p.strength for p in people]) * _MEMORY ** (gap - 1)
    gain = _RANK * strength[:, None] * found[None, ..., 2].mean(-1)
    cost = np.where(cost < _REACH, np.minimum(cost - gain, _NOBODY), _NOBODY)
    if cost.shape == (1, 1):
        pairs = [(0, 0)]
    else:
        from scipy.optimize import linear_sum_assignment

        pairs = list(zip(*linear_sum_assignment(cost), strict=True))
    return {int(p): people[int(k)] for k, p in pairs if cost[k, p] < _NOBODY}


def _update(person: _Person, found: Array, frame: int) -> None:
    """Move somebody to where they were found."""
    seen = found[:, 2] > 0
    gap = frame - person.frame
    both = np.minimum(person.pose[:, 2], found[:, 2])
    if both.sum() > 0:
        step = ((found[:, :2] - person.pose[:, :2]) * both[:, None]).sum(0) / both.sum() / gap
        most = _SPEED_UP * person.size  # so that one wrong detection does not send the prediction away
        person.velocity = person.velocity + np.clip(_VELOCITY * (step - person.velocity), -most, most)
    moved = person.pose[:, :2] + person.velocity * gap  # a joint that is unseen now moves with the body ...
    less = person.pose[:, 2] * 0.9**gap  # ... and counts less and less
    person.pose = np.where(seen[:, None], found, np.column_stack([moved, less]))
    person.size = 0.8 * person.size + 0.2 * _sizes(found[None])[0] if seen.sum() > 1 else person.size
    faded = _MEMORY ** (gap - 1) * person.strength
    rate = max(1 - _MEMORY, 1 / (len(person.seen) + 1))
    person.strength = faded + rate * (float(found[:, 2].mean()) - faded)
    person.frame = frame


def _centres(poses: Array) -> Array:
    """Weighted mean of the joints: (K, N, 3) -> (K, 2)."""
    weight = poses[..., 2:]
    return (poses[..., :2] * weight).sum(1) / np.maximum(weight.sum(1), 1e-9)


def _sizes(poses: Array) -> Array:
    """Diagonal of the box around the seen joints: (K, N, 3) -> (K,), at least 1e-6."""
    seen = poses[..., 2:] > 0
    high = np.where(seen, poses[..., :2], -np.inf).max(1)
    low = np.where(seen, poses[..., :2], np.inf).min(1)
    return np.maximum(np.linalg.norm(high - low, axis=-1), 1e-6)
