"""What goes in: :class:`Tracks`. Past this point all numbers are finite."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from kcs_torch.errors import OptionError, ShapeError
from kcs_torch.skeleton import Skeleton, get_skeleton
from kcs_torch.types.intake import as_floats, as_number, choose_skeleton, joint_order

__all__ = ["Tracks"]


@dataclass(frozen=True, eq=False)
class Tracks:
    """2D joint tracks of one body. Build it with :meth:`from_arrays` or :func:`kcs_torch.load_tracks`.

    Attributes:
        points: (T, N, 2), x right, y down, in ``units``; finite, and 0 where unseen.
        weights: (T, N) in [0, 1]; 0 where unseen.
        skeleton: names and bones of the N joints.
        fps: frames per second, or None where unknown.
        units: of ``points``: "px", "mm", ...
        source: where the tracks come from (a file name), for messages.
        notes: what was changed or assumed on the way in, one sentence each.
    """

    points: Tensor
    weights: Tensor
    skeleton: Skeleton
    fps: float | None = None
    units: str = "px"
    source: str = "tracks"
    notes: tuple[str, ...] = ()

    @classmethod
    def from_arrays(
        cls,
        points: Any,
        confidence: Any = None,
        *,
        skeleton: str | Path | Skeleton | None = None,
        joint_names: Sequence[str] | None = None,
        edges: Any = None,
        fps: float | None = None,
        units: str = "px",
        threshold: float = 0.3,
        source: str = "tracks",
        notes: Sequence[str] = (),
    ) -> Tracks:
        """Check arrays of one body's tracks and wrap them.

        Args:
            points: (T, N, 2) array or tensor; NaN where unseen.
            confidence: (T, N), non-negative; 1 where None. Used as a soft weight.
            skeleton: a :class:`Skeleton`, a built-in name or a YAML/JSON file. If None it is built from
                ``edges`` and ``joint_names``; names that are exactly a built-in skeleton's select it where
                the edges are absent or not a tree. Without any of these the joints have no bones.
            joint_names: N names. With a skeleton they say which joint is which: joints are matched by name, whatever
                their order, and those that the skeleton has not are left out.
            edges: (B, 2) (parent, child) indices. Edges that are not a tree become a graph of rigid links.
            fps: frames per second; NaN and None mean unknown.
            units: of the points.
            threshold: a joint with less confidence counts as unseen.
            source: for messages.
            notes: sentences to carry along.

        Raises:
            ShapeError: wrong shapes, infinite values, negative confidences, nothing seen at all.
            OptionError: the threshold is no confidence.
            SkeletonError: the joint count does not fit the skeleton (the message says which one it fits).
        """
        remarks = list(notes)
        xy = as_floats(points, f"{source}: points", 3)
        if confidence is not None:
            confidence = as_floats(confidence, f"{source}: confidence", 2)
        if xy.shape[-1] != 2:
            raise ShapeError(f"{source}: points: expected shape (frames, joints, 2), got {tuple(xy.shape)}")
        num_frames, num_joints = xy.shape[:2]
        if num_frames < 1:
            raise ShapeError(f"{source}: expected at least 1 frame, got none")
        if num_joints < 2:
            raise ShapeError(f"{source}: expected at least 2 joints, got {num_joints}")
        rate = as_number(fps)
        if fps is not None and (rate is None or rate <= 0):
            raise ShapeError(f"{source}: fps: expected a positive number or None, got {fps!r}")
        if rate is not None and not math.isfinite(rate):
            rate = None
        least = as_number(threshold)
        if least is None or not 0 <= least <= 1:
            raise OptionError(f"{source}: threshold: expected a confidence within 0..1, got {threshold!r}")
        names = None if joint_names is None else [str(n) for n in joint_names]
        if names is not None and len(names) != num_joints:
            raise ShapeError(f"{source}: joint_names: expected {num_joints} names, got {len(names)}")
        if skeleton is not None and names is not None:
            order = joint_order(names, get_skeleton(skeleton), source, remarks)
            if order is not None:
                xy = xy[:, order]
                confidence = confidence if confidence is None else confidence[:, order]
        body = choose_skeleton(skeleton, names, edges, xy.shape[1], source, remarks)
        label = lambda t, n: f"frame {int(t)}, joint '{body.joints[int(n)]}'"  # noqa: E731
        infinite = torch.isinf(xy).any(-1)
        if infinite.any():
            raise ShapeError(
                f"{source}: points: {label(*infinite.nonzero()[0])} is infinite; write NaN where a joint is unseen"
            )
        seen = torch.isfinite(xy).all(-1)
        if confidence is None:
            weights = seen.to(xy.dtype)
        else:
            weights = confidence.to(xy)
            if weights.shape != seen.shape:
                raise ShapeError(
                    f"{source}: confidence: expected shape {tuple(seen.shape)}, got {tuple(weights.shape)}"
                )
            if torch.isinf(weights).any():
                raise ShapeError(
                    f"{source}: confidence: {label(*torch.isinf(weights).nonzero()[0])} is infinite; expected 0..1"
                )
            weights = torch.nan_to_num(weights, nan=0.0)
            if (weights < 0).any():
                raise ShapeError(
                    f"{source}: confidence: {label(*(weights < 0).nonzero()[0])} is negative; expected 0..1"
                )
            if (weights > 1).any():
                where = label(*(weights > 1).nonzero()[0])
                raise ShapeError(
                    f"{source}: confidence: {where} is {float(weights.max()):g} at most; expected 0..1: "
                    "divide by the largest"
                )
            weights = torch.where(seen & (weights >= threshold), weights, torch.zeros_like(weights))
        seen = weights > 0
        if not seen.any():
            raise ShapeError(
                f"{source}: no joint is seen in any frame (confidence threshold {threshold:g}): nothing to reconstruct"
            )
        xy = torch.where(seen[..., None], xy, torch.zeros_like(xy))
        xy, weights = body.complete(xy, weights)
        never = [body.joints[n] for n in (weights == 0).all(0).nonzero().flatten().tolist()]
        if never:
            remarks.append(f"never seen, so placed by the skeleton alone: {', '.join(never)}")
        blank = (weights == 0).all(1).nonzero().flatten().tolist()
        if blank:
            shown = ", ".join(map(str, blank[:8])) + (", ..." if len(blank) > 8 else "")
            remarks.append(f"{len(blank)} frames without any seen joint (frame {shown}): filled from their neighbours")
        return cls(xy, weights, body, rate, units, source, tuple(remarks))

    def __repr__(self) -> str:
        return (
            f"Tracks({self.source!r}: {self.num_frames} frames, {self.num_joints} joints of skeleton "
            f"'{self.skeleton.name}', fps {self.fps}, {self.units}, {100 * self.unseen_share:.1f} % unseen)"
        )

    @property
    def num_frames(self) -> int:
        return self.points.shape[0]

    @property
    def num_joints(self) -> int:
        return self.points.shape[1]

    @property
    def seen(self) -> Tensor:
        """(T, N), True where a joint is seen."""
        return self.weights > 0

    @property
    def unseen_share(self) -> float:
        """Share of observed joints that are unseen, 0..1."""
        return float(1 - self.seen[:, : self.skeleton.num_observed].double().mean())

    def to(self, *args: Any, **kwargs: Any) -> Tracks:
        """Move or cast the tensors, as ``Tensor.to``."""
        return replace(self, points=self.points.to(*args, **kwargs), weights=self.weights.to(*args, **kwargs))

    def frames(self, start: int, stop: int) -> Tracks:
        """A run of frames."""
        return replace(self, points=self.points[start:stop], weights=self.weights[start:stop])
