"""A frame as it comes in: checked, and its unseen joints placed."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from kcs_torch.errors import ShapeError
from kcs_torch.functional.chain import bone_vectors
from kcs_torch.functional.ranks import median
from kcs_torch.methods.clips.unseen import place_unseen
from kcs_torch.skeleton import Skeleton
from kcs_torch.types.image_size import are_shares
from kcs_torch.types.intake import as_floats, as_weights, at_one_point, at_the_corner, check_places

__all__ = ["Sight", "take_frame"]

FASTEST, LONG = 6.0, 1.2
"""Least speed at which a joint jumps, a second, a person being 1.75 tall; and least image of one of its bones over the
bone's length. Both show an error of the detector."""

FEW = 3
"""Of so many joints one may jump; where more do, the frame shows something else, or the body goes on elsewhere."""

NEAR, HOLD = 0.2, 0.1
"""Least jump of many joints that no body makes, a person being 1.75 tall; and seconds of such frames that count as
unseen before they are believed."""


def take_frame(
    body: Skeleton, number: int, xy: Any, confidence: Any, threshold: float, size: tuple[int, int] | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Check a frame of observed joints, and append the virtual ones.

    Args:
        body: the skeleton.
        number: of the frame, for messages.
        xy: (num_observed, 2); NaN where unseen. Without confidences, joints exactly at (0, 0) or (-1, -1) are unseen,
            too, if others lie to the right of (0, 0) and below it (one in ten may not), or if there are none. Three
            or more joints that all lie at one point are unseen.
        confidence: (num_observed,) in 0..1; 1 where None.
        threshold: a joint with less confidence counts as unseen.
        size: width and height of the image, of which coordinates from 0 to 1 are shares; None where unknown.

    Returns:
        Points (N, 2), 0 where unseen, and weights (N,), on the CPU in double precision; and ``xy`` as a tensor of the
        dtype that poses have.

    Raises:
        ShapeError: the shape is wrong or a value infinite or out of range.
    """
    where = f"frame {number}"
    given = as_floats(xy, f"{where}: xy", 2)
    count = body.num_observed
    if given.shape != (count, 2):
        expected = f"({count}, 2) for skeleton '{body.name}'"
        raise ShapeError(f"{where}: xy: expected shape {expected}, got {tuple(given.shape)}")
    points = given.detach().to("cpu", torch.float64)
    if isinstance(xy, np.ndarray) and xy.dtype.kind == "f" and xy.dtype.itemsize <= 4:
        given = given.float()  # as of tensors: arrays were made double
    check_places(points, f"{where}: xy", body.joints)
    seen = torch.isfinite(points).all(-1)
    if confidence is None:
        weights = (seen & ~at_the_corner(points, seen, [], alone=True)).double()
    else:
        told = as_floats(confidence, f"{where}: confidence", 1).detach().to("cpu", torch.float64)
        weights = as_weights(told, seen, threshold, f"{where}: confidence", body.joints)
    weights = weights.masked_fill(at_one_point(points, weights > 0), 0.0)
    points = torch.where(weights[:, None] > 0, points, 0.0)
    if size is not None and are_shares(points[weights > 0].numpy()):
        points = points * points.new_tensor(size)
    return *body.complete(points, weights), given


class Sight:
    """What has been seen of a body so far.

    Attributes:
        age: (N,) frames since each joint was seen.
        met: (N,) bool, whether it ever was.
        held: frames up to now, without a break, in which many joints jumped.
    """

    def __init__(self, body: Skeleton, fps: float) -> None:
        self.body, self.fps, self.held = body, fps, 0
        self.rigid = list(body.rigid)
        self.bones = body.bone_index()[self.rigid]
        self.age = torch.zeros(body.num_joints, dtype=torch.float64)
        self.met = torch.zeros(body.num_joints, dtype=torch.bool)

    def trusted(
        self, points: Tensor, weights: Tensor, last: Tensor, lengths: Tensor, unit: float
    ) -> tuple[Tensor, Tensor]:
        """A frame's points and weights without the joints that jump away for a moment.

        Few are wrong where their bones would be too long. Where many jump, none counts as seen until the frames that
        follow have shown for :data:`HOLD` seconds that the body is not where it was.

        Args:
            points: (N, 2), 0 where unseen.
            weights: (N,), 0 where unseen.
            last: (N, 2) the frame before, complete.
            lengths: (B,) of the bones, in the points' units.
            unit: of the template, in the points' units.
        """
        seen = weights > 0
        if not bool(seen.any()):
            return points, weights
        moved = points - last
        moved = torch.where(seen & self.met, (moved - median(moved[seen], 0)).norm(dim=-1), 0.0) / unit
        reach = FASTEST / self.fps
        many = moved > (reach * (1 + self.age - self.held)).clamp_min(NEAR)
        if FEW * int(many.sum()) > int(seen.sum()) and self.held < HOLD * self.fps:
            self.held += 1
            return torch.zeros_like(points), torch.zeros_like(weights)
        self.held = 0
        far = moved > reach * (1 + self.age)
        if not bool(far.any()):
            return points, weights
        both = seen[self.bones].all(-1)
        loose = self.bones[both & (bone_vectors(points, self.bones).norm(dim=-1) > LONG * lengths[self.rigid])]
        wrong = far & torch.zeros_like(far).index_fill(0, loose.flatten(), True)
        wrong[self.body.num_observed :] = False
        if not bool(wrong.any()) or FEW * int(wrong.sum()) > int(seen.sum()):
            return points, weights
        observed = slice(self.body.num_observed)
        weights = weights.masked_fill(wrong, 0.0)[observed]
        return self.body.complete(torch.where(weights[:, None] > 0, points[observed], 0.0), weights)

    def complete(self, points: Tensor, seen: Tensor, last: Tensor | None) -> Tensor:
        """Take a frame, and place its unseen joints where they were, moved as most of the seen ones moved.

        Args:
            points: (N, 2).
            seen: (N,) bool.
            last: (N, 2) the frame before, complete; None if there is none.
        """
        self.age = torch.where(seen, 0.0, self.age + 1)
        self.met = self.met | seen
        if bool(seen.all()):
            return points
        if last is not None:
            shift = median((points - last)[seen], 0) if bool(seen.any()) else points.new_zeros(2)
            points = torch.where(seen[:, None], points, last + shift)
        if not bool(self.met.all()) and bool(self.met.any()):
            flat = torch.nn.functional.pad(points, (0, 1))[None]
            points = place_unseen(flat, self.met, self.body)[0, :, :2]
        return points
