"""What goes in: :class:`Tracks`. Past this point all numbers are finite."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

from torch import Tensor

from kcs_torch.errors import counted
from kcs_torch.skeleton import Skeleton
from kcs_torch.types.bodies import no_bones
from kcs_torch.types.image_size import are_shares, as_image_size, fitting_size
from kcs_torch.types.intake import take_in
from kcs_torch.types.size import short_unit
from kcs_torch.types.trajectories import Trajectories

__all__ = ["Tracks", "never_seen", "unseen_notes"]


@dataclass(frozen=True, eq=False, repr=False)
class Tracks(Trajectories):
    """2D joint tracks of one body. Build it with :meth:`from_arrays` or :func:`kcs_torch.load_tracks`.

    Attributes:
        points: (T, N, 2), x right, y down, in ``units``; finite, and 0 where unseen.
        weights: (T, N) in [0, 1]; 0 where unseen.
        skeleton: names and bones of the N joints.
        fps: frames per second, or None where unknown.
        units: of ``points``: "px", "mm", ...
        source: where the tracks come from (a file name), for messages.
        notes: what was changed or assumed on the way in, one sentence each.
        detector: whether a detector found the joints, so that errors last for many frames; None where nobody said so.
        image_size: width and height of the image in pixels, or None where unknown. A camera that nobody has calibrated
            looks at its middle, and its focal length is likely to be about as long as its longer side.
        image_guess: width and height that the image is taken to have where nobody says them, as everybody in it tells:
            the smallest usual ones that hold them all, (0, 0) if none do. None where these tracks alone tell.
    """

    units: str = "px"
    source: str = "tracks"
    detector: bool | None = None
    image_size: tuple[int, int] | None = None
    image_guess: tuple[int, int] | None = None

    @property
    def rate(self) -> float:
        """Frames per second, taken to be 30 where unknown."""
        return self.fps or 30.0

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
        image_size: tuple[int, int] | None = None,
        source: str = "tracks",
        notes: Sequence[str] = (),
    ) -> Tracks:
        """Check arrays of one body's tracks and wrap them.

        Args:
            points: (T, N, 2) array or tensor; NaN where unseen. Frames whose joints, three or more, lie at one point
                are unseen, too, where others show a body.
            confidence: (T, N), non-negative; 1 where None. Used as a soft weight.
            skeleton: a :class:`Skeleton`, a built-in name or a YAML/JSON file. If None it is built from
                ``edges`` and ``joint_names``; names that are exactly a built-in skeleton's select it where
                the edges are absent (then in any order: the joints are put into the skeleton's) or not a
                tree. Of a person's names in another spelling or order, a tree is made in the same cases
                (:func:`kcs_torch.skeleton.person_by_names`). Without any of these the joints have no bones.
            joint_names: N names. With a skeleton they say which joint is which: joints are matched by name, whatever
                their order, and those that the skeleton has not are left out.
            edges: (B, 2) (parent, child) indices. A person's that lead past the middle of the trunk, from hip to hip
                or shoulder, give way to ones through a virtual pelvis and neck. Without names, those of a built-in
                skeleton select it. Others that are not a tree become a graph of rigid links.
            fps: frames per second; NaN and None mean unknown.
            units: of the points.
            threshold: a joint with less confidence counts as unseen.
            image_size: width and height of the image in pixels, where points are pixels of it, or shares of it, 0 to 1,
                which become pixels; left out, which a note tells, where most of them lie elsewhere. A note also tells
                where they seem to be the wrong way round.
            source: for messages.
            notes: sentences to carry along.

        Raises:
            ShapeError: wrong shapes, infinite values, negative confidences, nothing seen at all.
            OptionError: the threshold is no confidence; the image's size is none, or the tracks are not in pixels.
            SkeletonError: the joint count does not fit the skeleton (the message says which one it fits).
        """
        taken = take_in(
            points,
            confidence,
            dims=2,
            skeleton=skeleton,
            joint_names=joint_names,
            edges=edges,
            fps=fps,
            threshold=threshold,
            source=source,
            notes=notes,
        )
        body, remarks = taken.skeleton, taken.notes
        if skeleton is None and not body.bones:
            remarks.append(no_bones(body))
        unit, xy = short_unit(units), taken.points
        size = as_image_size(image_size, unit, source)
        if size is not None and are_shares(xy[taken.weights > 0].numpy(force=True)):
            remarks.append(f"coordinates are shares of the image: multiplied by its {size[0]} x {size[1]} pixels")
            xy = xy * xy.new_tensor(size)
        xy, weights = body.complete(xy, taken.weights)
        remarks += unseen_notes(weights, body)
        if size is not None:
            size = fitting_size(xy[weights > 0], size, remarks)
        return cls(xy, weights, body, taken.fps, unit, source, tuple(remarks), image_size=size)

    def frames(self, start: int, stop: int, step: int = 1) -> Self:
        """A run of frames, with notes on what they do not show; with a step, every so many, at the slower rate."""
        return super().frames(start, stop, step).noted_anew(self.weights)

    def noted_anew(self, old: Tensor) -> Self:
        """The same tracks, whose notes tell of their weights what they told of the ``old`` ones (T, N)."""
        stale = unseen_notes(old, self.skeleton)
        kept = [note for note in self.notes if note not in stale]
        return replace(self, notes=(*kept, *unseen_notes(self.weights, self.skeleton)))


def never_seen(weights: Tensor, body: Skeleton) -> list[str]:
    """What to say of joints that no frame of weights (T, N) shows; nothing where there is none."""
    never = [body.joints[n] for n in (weights == 0).all(0).nonzero().flatten().tolist()] if len(weights) else []
    where = "beside their neighbours, as there is no template" if body.template is None else "by the skeleton alone"
    return [f"never seen, so placed {where}: {', '.join(never)}"] if never else []


def unseen_notes(weights: Tensor, body: Skeleton) -> list[str]:
    """What to say of joints and frames of weights (T, N) that show nothing."""
    notes = never_seen(weights, body)
    blank = (weights == 0).all(1).nonzero().flatten().tolist()
    if blank:
        shown = ", ".join(map(str, blank[:8])) + (", ..." if len(blank) > 8 else "")
        frames = counted(len(blank), "frame")
        whose = "its" if len(blank) == 1 else "their"
        notes.append(f"{frames} without any seen joint (frame {shown}): filled from {whose} neighbours")
    return notes
