"""What comes out: :class:`Reconstruction` with its :class:`Diagnostics`."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from kcs_torch.errors import KcsWarning, OptionError
from kcs_torch.functional import bone_lengths
from kcs_torch.functional.ranks import nanmedian
from kcs_torch.skeleton import Skeleton
from kcs_torch.types.angles import JointAngles, Joints, angles_of
from kcs_torch.types.hints import is_a
from kcs_torch.types.intrinsics import Intrinsics
from kcs_torch.types.size import short_unit, size_factor
from kcs_torch.types.tracks import Tracks
from kcs_torch.types.variation import BoneVariation, bone_variation

__all__ = ["Diagnostics", "Reconstruction"]

LOOSE_MIRROR = "in the mirror image before this camera bones do not keep their length"
"""How the note begins that says so."""


@dataclass(frozen=True)
class Diagnostics:
    """What the tracks could tell, and how the iteration ended.

    Attributes:
        viewpoint_turn: degrees by which the camera turned about the body, largest angle between two frames.
            Depth is weakly determined below about 30 degrees.
        unseen_share: share of joints without a measurement.
        bone_variation: median over rigid bones of the length's standard deviation over its mean, per cent; bones whose
            ends no frame shows do not count.
        reprojection_rms: root mean square of seen joints' reprojection error, in the tracks' units.
        converged: whether the stopping rule was met.
        iterations: how many steps were made.
        seconds: wall-clock time of the method.
        notes: sentences for the user.
        doubt: the one of the notes that says why depth is hardly to be believed, or nothing.
        largest_bone_variation: that of the rigid bone whose length varies most, per cent; NaN where it is not known.
        loosest_bone: the name of this bone; empty where it is not known.
    """

    viewpoint_turn: float
    unseen_share: float
    bone_variation: float
    reprojection_rms: float
    converged: bool
    iterations: int
    seconds: float = float("nan")
    notes: tuple[str, ...] = ()
    doubt: str = ""
    largest_bone_variation: float = float("nan")
    loosest_bone: str = ""

    @property
    def brief_doubt(self) -> str:
        """The doubt without its reasons, which follow a colon."""
        return self.doubt.partition(":")[0]

    @property
    def variation(self) -> BoneVariation:
        """What the three fields say of bones' lengths; ``str`` makes words of it."""
        return BoneVariation(self.bone_variation, self.largest_bone_variation, self.loosest_bone)


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
        uncertainty: (T, N) standard deviation of depth alone, or None where the method has none. x and y of joints that
            are unseen may be off by more.
        units: of the 3D.
        objective: by which the method ranks solutions of this clip, lower is better; NaN where it has none.
        root_depth: (T,) depth of the body relative to the first frame, or None where nothing tells it.
        alternatives: further solutions of the same tracks, best first: the mirror image, limbs flipped in depth.
        distance: (T,) depth of the body's middle before a camera of known intrinsics, or None. Then x and y are the
            camera's, and :meth:`in_space` projects onto the image; the unit is one pixel at the mean distance.
        intrinsics: of this camera, as they were given or found.
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
    objective: float = float("nan")
    root_depth: Tensor | None = None
    alternatives: tuple[Reconstruction, ...] = ()
    distance: Tensor | None = None
    intrinsics: Intrinsics | None = None

    def __post_init__(self) -> None:
        if not self.units:
            object.__setattr__(self, "units", self.tracks.units)

    def __repr__(self) -> str:
        found = self.diagnostics
        return (
            f"Reconstruction({self.method} of {self.tracks.source!r}: points {tuple(self.points.shape)}, {self.units}, "
            f"viewpoint turn {found.viewpoint_turn:.0f} degrees, bone variation {found.variation}, "
            f"{'converged' if found.converged else 'not converged'}"
            f"{', ' if found.doubt else ''}{found.brief_doubt})"
        )

    @property
    def skeleton(self) -> Skeleton:
        return self.tracks.skeleton

    @property
    def fps(self) -> float | None:
        return self.tracks.fps

    @property
    def observed(self) -> Tensor:
        """The joints (T, num_observed, 3) of the tracks as they were given, without the virtual ones."""
        return self.points[:, : self.skeleton.num_observed]

    def to(self, *args: Any, **kwargs: Any) -> Reconstruction:
        """Move or cast the tensors, those of the tracks and of the alternatives too, as ``Tensor.to``."""
        return self.moved(lambda x: x.to(*args, **kwargs), self.tracks.to(*args, **kwargs))

    def moved(self, move: Callable[[Tensor], Tensor], tracks: Tracks) -> Reconstruction:
        """The same with ``move`` of its tensors, and made from these tracks."""
        held = {name: move(value) for name, value in vars(self).items() if isinstance(value, Tensor)}
        others = tuple(other.moved(move, tracks) for other in self.alternatives)
        return replace(self, **held, tracks=tracks, alternatives=others)  # type: ignore[arg-type]

    def mirrored(self) -> Reconstruction:
        """The other solution that parallel rays admit: depth with the opposite sign.

        Before a camera of known intrinsics each joint moves along its ray: the mirror image has the same image, but its
        bones do not keep their length, which a note tells. The alternatives are turned over as well, and no objective
        is known.
        """
        flip = torch.tensor([1.0, 1.0, -1.0]).to(self.points)
        others = tuple(other.mirrored() for other in self.alternatives)
        turned = replace(self, cameras=self.cameras * flip, objective=math.nan, alternatives=others)
        if self.distance is not None:
            far, depth = self.distance[:, None], self.points[..., 2]
            near = torch.maximum(far - depth, 0.01 * far)
            points = self.points * (near / (far + depth))[..., None]
            points = torch.cat([points[..., :2], (near - far)[..., None]], -1)
            return replace(turned, points=points).remeasured()._told_of_bones(self.diagnostics.bone_variation)
        root = None if self.root_depth is None else -self.root_depth
        return replace(turned, points=self.points * flip, root_depth=root)

    def _told_of_bones(self, before: float) -> Reconstruction:
        """A mirror image before a camera, with the note on its bones if they vary by more than before, else without."""
        facts = self.diagnostics
        notes = [note for note in facts.notes if not note.startswith(LOOSE_MIRROR)]
        if facts.bone_variation > before:
            notes.append(
                f"{LOOSE_MIRROR} (they vary by {facts.bone_variation:.1f} %): choose among the alternatives "
                "(kcs-torch: --solution), or mirror what parallel rays show (intrinsics='parallel')"
            )
        return replace(self, diagnostics=replace(facts, notes=tuple(notes)))

    def remeasured(self) -> Reconstruction:
        """The same with the lengths that the bones of its points have, and with how much these vary."""
        bones = bone_lengths(self.points, self.skeleton.bone_index(device=self.points.device))
        variation = bone_variation(bones, self.skeleton, self.tracks.seen.any(0))
        facts = replace(
            self.diagnostics,
            bone_variation=variation.median,
            largest_bone_variation=variation.largest,
            loosest_bone=variation.bone,
        )
        return replace(self, lengths=nanmedian(bones, 0), diagnostics=facts)

    def solution(self, number: int) -> Reconstruction:
        """The solution of this number, with all the others as its alternatives: 1 is this one, 2 the first alternative.

        What makes this one doubtful makes the others doubtful.

        Raises:
            OptionError: there is none.
        """
        if not is_a(number, int) or not 1 <= number <= 1 + len(self.alternatives):
            count = len(self.alternatives) + 1
            raise OptionError(
                f"{self.tracks.source}: solution: expected a number from 1 to {count}, got {number!r}"
                + (": this method or clip has one solution only" if count == 1 else "")
            )
        every = (replace(self, alternatives=()), *self.alternatives)
        chosen, doubt = every[number - 1], self.diagnostics.doubt
        if doubt and not chosen.diagnostics.doubt:
            facts = chosen.diagnostics
            chosen = replace(chosen, diagnostics=replace(facts, notes=(*facts.notes, doubt), doubt=doubt))
        return replace(chosen, alternatives=(*every[: number - 1], *every[number:]))

    def in_space(self) -> Tensor:
        """(T, N, 3): the points with the root's depth path added, so that a walking body moves through space.

        The path begins at depth 0; where intrinsics were given or found it is the distance, and the camera is the
        origin. The unit of a result that has not been :meth:`scaled` is one pixel at its own mean distance, which is
        then the focal length: of several people before one camera only the directions compare, until each has a size.

        Raises:
            OptionError: the root's depth is not known.
        """
        path = self.root_depth if self.distance is None else self.distance
        if path is None:
            raise OptionError(
                "in_space: the root's depth is not known: it takes the camera's intrinsics, or a fixed camera, a "
                "skeleton with contact points and feet that stand still now and then; see diagnostics.notes"
            )
        return self.points + torch.nn.functional.pad(path[:, None, None], (2, 0))

    def angles(self, joints: Joints | None = None) -> JointAngles:
        """How joints bend over time: the flexion of hinges (knees, elbows, ankles, fingers), or of other joints.

        0 is a straight limb: the child lies in line with parent and joint. A hinge's angle grows as it bends its way,
        and hyperextension is negative, but not at the elbows of people: the upper arm turns about itself, so that
        nothing tells which way they bend. An ankle bends from the shank to the toes: about 60 in upright standing, more
        in dorsiflexion.

        Deviations follow from ``uncertainty`` alone: depths of joints are taken as independent of each other, and x and
        y as exact. Errors that neighbouring joints share make them too large, errors of the tracks too small. Beyond
        the first order, curvature counts: a leg that bends within the image, as in a gait seen from the side, is less
        certain than its slope in depth tells. They are None where the method has no uncertainty.

        Args:
            joints: names of hinges, and triples of names (parent, joint, child) for other joints, whose angles are 0 to
                180 without a sign; all hinges of the skeleton if None. Names may be spelt in any usual way.

        Returns:
            Degrees by name: that of the joint for a hinge, ``parent-joint-child`` for a triple. ``seen`` tells the
            frames whose joints were all seen; in others the angle rests on how the method filled them in.

        Raises:
            SkeletonError: there is no such joint.
            OptionError: the skeleton has no hinges, or not this one; a triple is none.
        """
        return angles_of(
            self.points,
            self.tracks.seen.to(self.points.device),
            self.skeleton,
            joints,
            filled_in=True,
            uncertainty=self.uncertainty,
            fps=self.fps,
            source=self.tracks.source,
        )

    def scaled(self, *, units: str, factor: float | None = None, **sizes: float) -> Reconstruction:
        """The same motion in another unit.

        Args:
            units: name of the new unit; lengths may be spelt out, "metres".
            factor: new units per old unit; or instead one size by name:
            **sizes: ``height=1.75``, the person's stature, or the length of a bone, given as
                ``**{"left_knee-left_ankle": 0.43}``. The stature is that of the straightened body from the topmost
                joint of the head to the heels or ankles, enlarged by what usually lies above and below these: a nose is
                8.6 % of the stature below the top of the head, a joint named head 5 % (where the skull turns, in motion
                capture, 12.6 %), an ankle 4 % above the floor. Individuals differ by some per cent; a bone that has
                been measured is more exact. Before a camera whose intrinsics were given or found each alternative gets
                this size by its own lengths; under parallel rays all share one factor.

        Raises:
            OptionError: the unit has no name, not exactly one of ``factor`` and a size is given, it is no positive
                number, or the skeleton has no head or no leg to tell a stature from.

        Warns:
            KcsWarning: nobody is so tall: 1.75 mm, or 175 m.
        """
        units = short_unit(units)
        own = factor is None and self.distance is not None
        factor = size_factor(self.skeleton, self.lengths, factor, sizes, units=units)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", KcsWarning)  # of a size that this one was told of
            others = tuple(
                other.scaled(units=units, **sizes) if own else other.scaled(units=units, factor=factor)
                for other in self.alternatives
            )
        spread = None if self.uncertainty is None else self.uncertainty * factor
        return replace(
            self,
            points=self.points * factor,
            scales=self.scales / factor,
            lengths=self.lengths * factor,
            uncertainty=spread,
            units=units,
            root_depth=None if self.root_depth is None else self.root_depth * factor,
            distance=None if self.distance is None else self.distance * factor,
            alternatives=others,
        )

    def save(self, path: str | Path) -> Path:
        """Write to a file; its suffix chooses the format (.npz, .csv, .html, .png).

        Raises:
            OutputError: the suffix is unknown or the file cannot be written; nothing is left half-written.
        """
        from kcs_torch.io import save

        return save(self, path)
