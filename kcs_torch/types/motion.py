"""3D motion from elsewhere, or on its way out: :class:`Motion`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from kcs_torch.errors import OptionError, ShapeError
from kcs_torch.functional import interpolate, orbit
from kcs_torch.skeleton import SKELETONS, Skeleton, get_skeleton
from kcs_torch.types.angles import JointAngles, Joints, angles_of
from kcs_torch.types.axes import check_pitch, from_y_up, to_y_up
from kcs_torch.types.hints import is_a
from kcs_torch.types.intake import as_floats, as_number, as_weights, check_places, take_in
from kcs_torch.types.intrinsics import Intrinsics
from kcs_torch.types.reconstruction import Reconstruction
from kcs_torch.types.size import short_unit, size_factor
from kcs_torch.types.tracks import Tracks
from kcs_torch.types.trajectories import Trajectories
from kcs_torch.types.variation import BoneVariation, bone_variation

__all__ = ["Motion"]


@dataclass(frozen=True, eq=False, repr=False)
class Motion(Trajectories):
    """3D motion of one body in a world of right-handed axes with y up.

    Seen from a camera on the z axis, x points right and z towards the viewer; a body that faces +z has its left at +x.
    Build it with :meth:`from_arrays`, :meth:`of` (from a result) or :func:`kcs_torch.load_motion`.

    Attributes:
        points: (T, N, 3) in ``units``; finite, and 0 where unseen.
        weights: (T, N) in [0, 1]; 0 where unseen.
        skeleton: names and bones of the N joints (markers have no bones).
        fps: frames per second, or None where unknown.
        units: of ``points``: "m", "cm", "mm"; empty where unknown.
        source: where the motion comes from (a file name), for messages.
        notes: what was changed or assumed on the way in, one sentence each.
    """

    source: str = "motion"

    @classmethod
    def from_arrays(
        cls,
        points: Any,
        confidence: Any = None,
        *,
        up: str = "y",
        skeleton: str | Path | Skeleton | None = None,
        joint_names: Sequence[str] | None = None,
        edges: Any = None,
        fps: float | None = None,
        units: str = "",
        source: str = "motion",
        notes: Sequence[str] = (),
    ) -> Motion:
        """Check arrays of one body's motion and wrap them.

        Args:
            points: (T, N, 3) array or tensor; NaN where unseen.
            confidence: (T, N) within 0..1, 0 where unseen; 1 where None.
            up: which axis of ``points`` points up: y, z, x, -y (the camera's axes: x right, y down, z away) or -z.
            skeleton: as of :meth:`Tracks.from_arrays`; joints are matched by name. Virtual joints that are not among
                the points are the mean of their sources.
            joint_names: N names.
            edges: (B, 2) (parent, child) indices.
            fps: frames per second; NaN and None mean unknown.
            units: of the points.
            source: for messages.
            notes: sentences to carry along.

        Raises:
            ShapeError: wrong shapes, infinite values, nothing seen at all.
            SkeletonError: the joint count does not fit the skeleton.
            OptionError: there is no such axis.

        >>> walk = Motion.from_arrays(torch.rand(10, 17, 3), up="z", skeleton="h36m17", units="m")
        >>> walk
        Motion('motion': 10 frames, 17 joints of skeleton 'h36m17', fps None, m, 0.0 % unseen)
        """
        names = None if joint_names is None else [str(n) for n in joint_names]
        if skeleton is None and names is not None:
            skeleton = _same(names, edges)
            edges = None if skeleton is not None else edges
        own: list[tuple[str, Tensor, Tensor]] = []  # the file's own virtual joints go before the means
        if names is not None and skeleton is not None:
            body = get_skeleton(skeleton)
            extra = set(body.joints[body.num_observed :])
            if extra & set(names) and set(body.joints[: body.num_observed]) <= set(names):
                points, confidence, names, own = _apart(points, confidence, names, extra, source)
        taken = take_in(
            points,
            confidence,
            dims=3,
            skeleton=skeleton,
            joint_names=names,
            edges=edges,
            fps=fps,
            threshold=0.0,
            source=source,
            notes=notes,
        )
        body = taken.skeleton
        xyz, weights = body.complete(taken.points, taken.weights)
        for name, place, weight in own:
            at = body.index(name)
            xyz[:, at] = torch.where((weight > 0)[:, None], place, 0.0).to(xyz)
            weights[:, at] = weight.to(weights)
        return cls(
            to_y_up(xyz, up), weights, body, taken.fps, short_unit(units), source, tuple(dict.fromkeys(taken.notes))
        )

    @classmethod
    def of(cls, result: Reconstruction, *, pitch: float = 0.0) -> Motion:
        """Turn a result so that y points up, and let the body move through space where that is known.

        Up is the camera's up, so that before a camera that looks down bodies lean towards it, unless ``pitch`` levels
        them. Where the distance to the camera is known, the camera is the origin. Elsewhere the origin lies at the
        lowest point of the clip, below the middle of the first frame.

        Args:
            result: of a method; ``scaled()`` before if sizes matter. Joints that are NaN are unseen.
            pitch: degrees by which the camera looked down; below 0 where it looked up.

        Raises:
            OptionError: the pitch is not within -90 to 90, or the result is something else.
        """
        given: object = result
        if not isinstance(given, Reconstruction):
            raise OptionError(f"Motion.of: expected a result of reconstruct(), got {type(given).__name__}")
        degrees = check_pitch(pitch)
        notes = [*result.tracks.notes, *result.diagnostics.notes]
        known = result.distance is not None or result.root_depth is not None
        points = result.in_space() if known else result.points
        if degrees:
            points = points @ orbit(points.new_zeros(()), degrees)
        points = to_y_up(points, "-y")
        if not known:
            notes.append("how far the body walks towards or away from the camera is not known: it stays at one depth")
        there = torch.isfinite(points).all(-1)
        if result.distance is None and bool(there.any()):
            low, middle = points[there][:, 1].amin(), points[0, there[0]].mean(0).nan_to_num(0.0)
            points = points - torch.stack([middle[0], low, middle[2]])
        return cls(
            torch.where(there[..., None], points, 0.0),
            there.to(points),
            result.skeleton,
            result.fps,
            result.units,
            result.tracks.source,
            tuple(dict.fromkeys(notes)),
        )

    @property
    def lengths(self) -> Tensor:
        """(B,) mean bone lengths over the frames in which both ends are seen; NaN where there is none."""
        return self._lengths().nanmean(0)

    @property
    def variation(self) -> BoneVariation:
        """How much rigid bones change their length, in per cent; of the median bone and of the worst."""
        return bone_variation(self._lengths(), self.skeleton)

    def filled(self) -> Tensor:
        """(T, N, 3): gaps are filled linearly in time; a joint that is never seen lies on its neighbour by a bone."""
        points, there = interpolate(self.points, self.seen), self.seen.any(0).tolist()
        reach = [i for i, seen in enumerate(there) if seen]
        for here in reach:  # grows
            for bone in self.skeleton.bones:
                other = sum(bone) - here
                if here in bone and not there[other]:
                    points[:, other], there[other] = points[:, here], True
                    reach.append(other)
        return points

    def _lengths(self) -> Tensor:
        """(T, B) bone lengths; NaN where an end is unseen."""
        a, b = self.skeleton.bone_index(device=self.points.device).unbind(-1)
        both = self.seen[:, a] & self.seen[:, b]
        length = (self.points[:, b] - self.points[:, a]).norm(dim=-1)
        return torch.where(both, length, torch.full_like(length, math.nan))

    def scaled(self, *, units: str, factor: float | None = None, **sizes: float) -> Motion:
        """The same motion in another unit; arguments and errors as of :meth:`Reconstruction.scaled`."""
        units = short_unit(units)
        factor = size_factor(self.skeleton, self.lengths, factor, sizes, units=units)
        return replace(self, points=self.points * factor, units=units)

    def angles(self, joints: Joints | None = None) -> JointAngles:
        """How joints bend over time; arguments and errors as of :meth:`Reconstruction.angles`, without deviations.

        An angle is NaN where one of its joints is unseen. Where an end of a hinge's axis is, the axis lies between
        those before and after; if it never is seen, the angle has no sign.

        >>> walk = Motion.from_arrays(torch.rand(10, 17, 3), skeleton="h36m17", units="m")
        >>> walk.angles(["left_knee", ("thorax", "neck", "head")])
        JointAngles('motion': 10 frames of left_knee, thorax-neck-head)
        """
        return angles_of(self.points, self.seen, self.skeleton, joints, fps=self.fps, source=self.source)

    def in_camera(self, *, yaw: float = 0.0, pitch: float = 0.0, turn: float = 0.0) -> Tensor:
        """See the motion from a camera that looks at the middle of it all.

        Args:
            yaw: degrees by which the camera stands to the side in the first frame: 0 on the z axis, 90 on the x axis.
            pitch: degrees by which it looks down.
            turn: degrees by which it walks on around the body until the last frame.

        Returns:
            (T, N, 3): x right, y down, z away from the camera, from the middle of the seen joints' bounding box.

        Raises:
            OptionError: an angle is no finite number.
            ShapeError: there are no frames.
        """
        if not self.num_frames:
            raise ShapeError(f"{self.source}: expected at least 1 frame, got none")
        for name, angle in (("yaw", yaw), ("pitch", pitch), ("turn", turn)):
            if (degrees := as_number(angle)) is None or not math.isfinite(degrees):
                raise OptionError(f"{name}: expected a finite number of degrees, got {angle!r}")
        steps = torch.linspace(0, 1, self.num_frames, dtype=self.points.dtype, device=self.points.device)
        cameras = orbit(yaw + turn * steps, pitch)
        far = torch.full_like(self.points, math.inf)
        seen = self.seen[..., None]
        low, high = torch.where(seen, self.points, far).amin((0, 1)), torch.where(seen, self.points, -far).amax((0, 1))
        points = from_y_up(self.points - (low + high) / 2, "-y") @ cameras.mT
        return torch.where(seen, points, torch.zeros_like(points))

    def tracks(
        self,
        *,
        yaw: float = 0.0,
        pitch: float = 0.0,
        turn: float = 0.0,
        intrinsics: Any = None,
        distance: float | None = None,
        noise: float = 0.0,
        generator: torch.Generator | None = None,
    ) -> Tracks:
        """Film the motion: 2D tracks to try a method on, or to train with; :meth:`in_camera` is their truth.

        Args:
            yaw: as of :meth:`in_camera`.
            pitch: as of :meth:`in_camera`.
            turn: as of :meth:`in_camera`.
            intrinsics: of a pinhole camera, (fx, fy, cx, cy) or a matrix K; tracks are then in pixels. None: parallel
                rays, and tracks in the motion's own units.
            distance: from the pinhole to the middle of the motion, in the motion's units; so far that all is in the
                image if None. Parallel rays have none.
            noise: standard deviation of the tracks, in their unit.
            generator: for the noise.

        Raises:
            OptionError: a number is out of range, the camera would stand within the motion, or a distance comes without
                intrinsics.
            ShapeError: there are no frames.

        >>> walk = Motion.from_arrays(torch.rand(10, 17, 3), skeleton="h36m17", units="m")
        >>> walk.tracks(yaw=45, intrinsics=(1000, 1000, 640, 360)).units
        'px'
        """
        if not (is_a(noise, float) and math.isfinite(noise) and noise >= 0):
            raise OptionError(f"noise: expected a number not below 0, got {noise!r}")
        points = self.in_camera(yaw=yaw, pitch=pitch, turn=turn)
        if intrinsics is None:
            if distance is not None:
                raise OptionError(f"distance: expected it with intrinsics=(fx, fy, cx, cy), got {distance!r} alone")
            image, units = points[..., :2].clone(), self.units or "px"
        else:
            lens = Intrinsics.of(intrinsics)
            far = _distance(points, lens, distance)
            image, units = lens.project(points + points.new_tensor([0.0, 0.0, far])), "px"
        if noise:
            draw = torch.randn(image.shape, generator=generator, dtype=image.dtype, device=image.device)
            image = image + noise * draw
        count = self.skeleton.num_observed
        made = Tracks.from_arrays(
            torch.where(self.seen[..., None], image, torch.full_like(image, math.nan))[:, :count],
            self.weights[:, :count],
            skeleton=self.skeleton,
            fps=self.fps,
            units=units,
            threshold=0.0,
            source=self.source,
            notes=self.notes,
        )
        return replace(made, detector=False)

    def save(self, path: str | Path) -> Path:
        """Write to a file; its suffix chooses the format (.npz, .bvh, .c3d, .csv, .trc). See :func:`kcs_torch.save`.

        Raises:
            OutputError: the suffix is unknown or the file cannot be written; nothing is left half-written.
        """
        from kcs_torch.io import save

        return save(self, path)


def _same(names: Sequence[str], edges: Any) -> Skeleton | None:
    """The built-in skeleton with just these joints, in any order and with its virtual ones, and just these bones."""
    for body in SKELETONS.values():
        if len(names) == body.num_joints and set(names) == set(body.joints):
            if edges is None:
                return body
            try:
                pairs = {frozenset((names[int(a)], names[int(b)])) for a, b in edges}
            except (TypeError, ValueError, IndexError):
                return None
            if pairs == {frozenset((body.joints[a], body.joints[b])) for a, b in body.bones}:
                return body
    return None


def _apart(
    points: Any, confidence: Any, names: list[str], extra: set[str], source: str
) -> tuple[Tensor, Tensor, list[str], list[tuple[str, Tensor, Tensor]]]:
    """Places, confidences and names without the ``extra`` joints, and name, place and confidence of each of these."""
    points = as_floats(points, f"{source}: points", 3)
    sure = points.new_ones(points.shape[:2]) if confidence is None else confidence
    sure = as_floats(sure, f"{source}: confidence (frames, joints)", 2)
    if points.shape[1] != len(names):
        raise ShapeError(f"{source}: joint_names: expected {points.shape[1]} names, got {len(names)}")
    check_places(points, f"{source}: points", names)
    sure = as_weights(sure.to(points), torch.isfinite(points).all(-1), 0.0, f"{source}: confidence", names)
    keep = [i for i, n in enumerate(names) if n not in extra]
    own = [(n, points[:, i], sure[:, i]) for i, n in enumerate(names) if n in extra]
    return points[:, keep], sure[:, keep], [names[i] for i in keep], own


def _distance(points: Tensor, lens: Intrinsics, distance: float | None) -> float:
    """How far a camera stands from the middle of points (T, N, 3): as given, or so that all is in the image."""
    if distance is None:  # of a ball around it all that fits into the nearer half of the image
        half = min(lens.cx, lens.cy)
        if not half > 0:
            raise OptionError(
                "distance: expected a number, as a principal point at the image's edge does not tell how large "
                f"the image is, got {distance!r}"
            )
        distance = float(points.norm(dim=-1).max()) * (1 + lens.focal / half)
    if not is_a(distance, float):
        raise OptionError(f"distance: expected a number, got {distance!r}")
    if not (math.isfinite(distance) and distance > 0 and float(points[..., 2].min()) + distance > 0):
        least = -float(points[..., 2].min())
        raise OptionError(f"distance: expected more than {least:g}, before all joints, got {distance}")
    return distance
