"""Where to draw joints on paper: turned, and a skeleton's, (N, 2), so that no two hide each other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kcs_torch.skeleton import Skeleton

__all__ = ["flat_layout", "turned"]

YAWS, PITCHES = (0.0, 25.0, 50.0, 75.0), (0.0, 15.0, 30.0)
ROUNDS = 300
Array = NDArray[np.float64]


def flat_layout(skeleton: Skeleton) -> Array:
    """Place the joints: the template from where its joints are best told apart, or as far apart as bones lie between.

    Returns:
        (N, 2), x right, y down, any unit.

    >>> chain = Skeleton.from_edges([(0, 1), (1, 2)], 3)
    >>> x = flat_layout(chain)
    >>> steps = np.linalg.norm(np.diff(x, axis=0), axis=1)
    >>> bool(abs(steps[0] / steps[1] - 1) < 0.01)
    True
    """
    if skeleton.template is None:
        return _spread(skeleton)
    rest = np.array(skeleton.template)
    views = [turned(rest, -yaw, pitch)[:, :2] for pitch in PITCHES for yaw in YAWS]
    return max(views, key=_clarity)  # of equally clear ones the first, from the front


def turned(points: Array, yaw: float, pitch: float = 0.0) -> Array:
    """Points (..., 3) right, down and away as seen from the right by ``yaw`` degrees and from above by ``pitch``."""
    a, b = np.radians([yaw, pitch])
    x, y, z = np.moveaxis(points, -1, 0)
    with np.errstate(invalid="ignore"):  # infinite ones
        right, away = x * np.cos(a) + z * np.sin(a), z * np.cos(a) - x * np.sin(a)
        return np.stack([right, y * np.cos(b) - away * np.sin(b), away * np.cos(b) + y * np.sin(b)], -1)


def _clarity(places: Array) -> float:
    """Mean logarithm of joints' distances to the nearest other; coarse, so that nearly as clear is as clear."""
    size = max(float(np.ptp(places, axis=0).max()), 1e-12)
    gaps = np.linalg.norm(places[:, None] - places, axis=-1) / size
    np.fill_diagonal(gaps, np.inf)
    return round(5 * float(np.log(np.clip(gaps.min(1), 0.005, 0.05)).mean())) / 5


def _spread(skeleton: Skeleton) -> Array:
    """Distances on paper like distances along the bones (stress majorisation); left joints at the right."""
    count = skeleton.num_joints
    lengths = np.array(skeleton.proportions) if skeleton.proportions is not None else np.ones(skeleton.num_bones)
    lengths = lengths / lengths.mean() if len(lengths) else lengths
    gaps = np.full((count, count), np.inf)
    np.fill_diagonal(gaps, 0)
    for (a, b), length in zip(skeleton.bones, lengths, strict=True):
        gaps[a, b] = gaps[b, a] = max(length, 0.2)
    for k in range(count):  # shortest ways
        gaps = np.minimum(gaps, gaps[:, k, None] + gaps[k])
    far = gaps[np.isfinite(gaps)].max(initial=1.0)
    gaps = np.where(np.isfinite(gaps), gaps, far + 1)  # separate pieces beside each other
    weights = 1 / np.maximum(gaps, 1e-9) ** 2
    np.fill_diagonal(weights, 0)
    sides = np.array([{"left": 1.0, "right": -1.0}.get(skeleton.side(j), 0.0) for j in range(count)])
    angle = 2.4 * np.arange(count)  # no two joints begin at one place
    start = np.stack([sides, gaps[0] / far], -1) * far / 2
    places = start + 0.05 * far * np.stack([np.cos(angle), np.sin(angle)], -1)
    inverse = np.linalg.pinv(np.diag(weights.sum(1)) - weights)
    for _ in range(ROUNDS):
        apart = np.linalg.norm(places[:, None] - places, axis=-1)
        pull = -weights * gaps / np.maximum(apart, 1e-9)
        np.fill_diagonal(pull, 0)
        np.fill_diagonal(pull, -pull.sum(1))
        places = inverse @ (pull @ places)
    return places
