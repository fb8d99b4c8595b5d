"""What goes in and what comes out: :class:`Tracks` and :class:`Reconstruction`.

Everything that a user passes is checked here, once; past this point all numbers are finite.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kcs_torch.errors import OptionError, ShapeError, SkeletonError
from kcs_torch.skeleton import SKELETONS, Skeleton, get_skeleton, guess_skeleton

__all__ = ["Diagnostics", "Reconstruction", "Tracks"]


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
            joint_names: N names.
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
        xy = as_floats(points, f"{source}: points", 3)
        if xy.shape[-1] != 2:
            raise ShapeError(f"{source}: points: expected shape (frames, joints, 2), got {tuple(xy.shape)}")
        num_frames, num_joints = xy.shape[:2]
        if num_frames < 1:
            raise ShapeError(f"{source}: expected at least 1 frame, got none")
        if num_joints < 2:
            raise ShapeError(f"{source}: expected at least 2 joints, got {num_joints}")
        rate = _number(fps)
        if fps is not None and (rate is None or rate <= 0):
            raise ShapeError(f"{source}: fps: expected a positive number or None, got {fps!r}")
        if rate is not None and not math.isfinite(rate):
            rate = None
        least = _number(threshold)
        if least is None or not 0 <= least <= 1:
            raise OptionError(f"{source}: threshold: expected a confidence within 0..1, got {threshold!r}")
        names = None if joint_names is None else [str(n) for n in joint_names]
        if names is not None and len(names) != num_joints:
            raise ShapeError(f"{source}: joint_names: expected {num_joints} names, got {len(names)}")
        remarks = list(notes)
        body = _choose_skeleton(skeleton, names, edges, num_joints, source, remarks)
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
            weights = as_floats(confidence, f"{source}: confidence", 2).to(xy)
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


@dataclass(frozen=True)
class Diagnostics:
    """What the tracks could tell, and how the iteration ended.

    Attributes:
        viewpoint_turn: degrees by which the camera turned about the body, largest angle between two frames.
            Depth is weakly determined below about 30 degrees.
        unseen_share: share of joints without a measurement.
        bone_variation: median over rigid bones of the length's standard deviation over its mean, per cent.
        reprojection_rms: root mean square of seen joints' reprojection error, in the tracks' units.
        converged: whether the stopping rule was met.
        iterations: how many steps were made.
        seconds: wall-clock time of the method.
        notes: sentences for the user.
    """

    viewpoint_turn: float
    unseen_share: float
    bone_variation: float
    reprojection_rms: float
    converged: bool
    iterations: int
    seconds: float = float("nan")
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """3D motion of one body, in the camera frame: x right, y down, z away from the camera.

    The sign of depth cannot be told from parallel rays (:meth:`mirrored` gives the other one), nor can
    the scale (:meth:`scaled`). Depth is relative to the body; x and y follow the image.

    Attributes:
        points: (T, N, 3) joint positions in ``units``.
        cameras: (T, 2, 3) first two rows of each frame's world-to-camera rotation.
        scales: (T,) weak-perspective scale of each frame; image = scale * points up to a shift.
        lengths: (B,) bone lengths, in ``units``.
        tracks: what it was made from.
        method: the method's name.
        diagnostics: see :class:`Diagnostics`.
        uncertainty: (T, N) standard deviation of depth, or None where the method has none.
        units: of the 3D.
    """

    points: Tensor
    cameras: Tensor
    scales: Tensor
    lengths: Tensor
    tracks: Tracks
    method: str
    diagnostics: Diagnostics
    uncertainty: Tensor | None = None
    units: str = field(default="")

    def __post_init__(self) -> None:
        if not self.units:
            object.__setattr__(self, "units", self.tracks.units)

    @property
    def skeleton(self) -> Skeleton:
        return self.tracks.skeleton

    @property
    def fps(self) -> float | None:
        return self.tracks.fps

    @property
    def observed(self) -> Tensor:
        """(T, num_observed, 3): the joints of the tracks as they were given, without the virtual ones."""
        return self.points[:, : self.skeleton.num_observed]

    def mirrored(self) -> Reconstruction:
        """The other solution that parallel rays admit: depth with the opposite sign."""
        flip = torch.tensor([1.0, 1.0, -1.0]).to(self.points)
        return replace(self, points=self.points * flip, cameras=self.cameras * flip)

    def scaled(self, *, units: str, factor: float | None = None, **sizes: float) -> Reconstruction:
        """The same motion in another unit.

        Args:
            units: name of the new unit.
            factor: new units per old unit; or instead one size by name:
            **sizes: ``height=1.75`` (head to foot of the straightened body, along the bones) or
                ``length=0.43, `` given as ``{"left_knee-left_ankle": 0.43}`` through ``**``.

        Raises:
            OptionError: not exactly one of ``factor`` and a size is given, or it is not positive.
        """
        if (factor is None) == (len(sizes) != 1):
            raise OptionError("scaled: expected either factor=... or exactly one size, such as height=1.75")
        if factor is None:
            (name, size), *_ = sizes.items()
            if name == "height":
                own = self._height()
            elif name in self.skeleton.bone_names:
                own = float(self.lengths[self.skeleton.bone_names.index(name)])
            else:
                raise OptionError(
                    f"scaled: unknown size {name!r}: expected 'height' or a bone, "
                    f"one of {', '.join(self.skeleton.bone_names)}"
                )
            if not own > 0:
                raise OptionError(f"scaled: {name} is zero in this reconstruction")
            factor = size / own
        if not (factor > 0 and np.isfinite(factor)):
            raise OptionError(f"scaled: expected a positive factor, got {factor}")
        spread = None if self.uncertainty is None else self.uncertainty * factor
        return replace(
            self,
            points=self.points * factor,
            scales=self.scales / factor,
            lengths=self.lengths * factor,
            uncertainty=spread,
            units=units,
        )

    def save(self, path: str | Path) -> Path:
        """Write to a file; its suffix chooses the format (.npz, .csv, .html, .png).

        Raises:
            OutputError: the suffix is unknown or the file cannot be written; nothing is left half-written.
        """
        from kcs_torch.io import save

        return save(self, path)

    def _height(self) -> float:
        """Longest path through the bones: head to foot of the straightened body."""
        neighbours: dict[int, list[tuple[int, float]]] = {i: [] for i in range(self.skeleton.num_joints)}
        for (a, b), length in zip(self.skeleton.bones, self.lengths.tolist(), strict=True):
            neighbours[a].append((b, length))
            neighbours[b].append((a, length))
        names = list(self.skeleton.joints)
        tops = [i for i, n in enumerate(names) if "head" in n.lower() or "nose" in n.lower()]
        feet = [i for i, n in enumerate(names) if any(w in n.lower() for w in ("ankle", "heel", "foot"))]
        if not tops or not feet:
            raise OptionError(
                "scaled: height needs a head and a foot among the joints; "
                f"skeleton '{self.skeleton.name}' has none: give a bone"
            )
        best = 0.0
        for top in tops:
            reach = {top: 0.0}
            stack = [top]
            while stack:
                i = stack.pop()
                for j, length in neighbours[i]:
                    if j not in reach:
                        reach[j] = reach[i] + length
                        stack.append(j)
            best = max([best, *(reach[f] for f in feet if f in reach)])
        return best


def as_floats(value: Any, what: str, ndim: int) -> Tensor:
    """An array-like as a floating tensor of ``ndim`` dimensions; tensors keep their device and single precision.

    Raises:
        ShapeError: it is no array of real numbers, or has another number of dimensions.
    """
    if not isinstance(value, Tensor):
        try:
            array = np.asarray(value)
            value = torch.as_tensor(array if np.iscomplexobj(array) else array.astype(np.float64))
        except (TypeError, ValueError):
            raise ShapeError(f"{what}: expected an array of numbers, got {type(value).__name__}") from None
    if value.is_complex():
        raise ShapeError(f"{what}: expected real numbers, got {str(value.dtype).removeprefix('torch.')}")
    if value.ndim != ndim:
        raise ShapeError(f"{what}: expected {ndim} dimensions, got shape {tuple(value.shape)}")
    if value.dtype in (torch.float16, torch.bfloat16):
        return value.float()  # no factorisation takes half precision
    return value if value.is_floating_point() else value.double()


def _number(value: Any) -> float | None:
    return float(value) if isinstance(value, Real) else None


def _choose_skeleton(
    skeleton: str | Path | Skeleton | None,
    names: Sequence[str] | None,
    edges: Any,
    num_joints: int,
    source: str,
    notes: list[str],
) -> Skeleton:
    """The skeleton that fits what the user gave; says so in ``notes`` where it had to choose."""
    if skeleton is not None:
        body = get_skeleton(skeleton)
        if body.num_observed != num_joints:
            fits = [s.name for s in SKELETONS.values() if s.num_observed == num_joints]
            hint = f"; {num_joints} joints fit {', '.join(fits)}" if fits else ""
            raise SkeletonError(
                f"{source}: expected the {body.num_observed} joints of skeleton '{body.name}', got {num_joints}{hint}"
            )
        return body
    known = guess_skeleton(names) if names is not None else None
    if edges is None:
        if known is not None:
            return known
        return Skeleton.from_edges([], names or num_joints, name="points", tree=False)
    try:
        try:
            pairs = np.asarray(edges)
        except ValueError:
            raise ShapeError(f"{source}: edges: expected pairs of joint indices, got rows of unequal length") from None
        if pairs.size == 0:
            pairs = pairs.reshape(0, 2)
        if pairs.ndim != 2 or pairs.shape[1] != 2 or not np.issubdtype(pairs.dtype, np.number):
            raise ShapeError(
                f"{source}: edges: expected shape (bones, 2) of joint indices, got {pairs.shape} of {pairs.dtype}"
            )
        graph = Skeleton.from_edges(pairs.tolist(), names or num_joints, name=Path(source).stem, tree=False)
    except SkeletonError as error:
        raise SkeletonError(f"{source}: edges: {error}") from None
    if graph.is_tree:
        return replace(graph, tree=True)
    if known is not None:
        notes.append(
            f"the file's edges are not a tree; used the built-in skeleton '{known.name}', whose joint names it has"
        )
        return known
    reason = "close a chain" if graph.cycle() else f"fall into {len(graph.pieces())} pieces"
    notes.append(f"the edges {reason}: used as a graph of rigid links, not as a tree")
    return graph
