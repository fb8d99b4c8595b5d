"""The skeleton of an articulated body."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from numbers import Integral
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from kcs_torch.anatomy import UNKNOWN_SPREAD, Hinge
from kcs_torch.errors import FormatError, SkeletonError, unknown
from kcs_torch.skeleton.check import SAME, as_tuples, check_facts, check_observed, check_tree
from kcs_torch.skeleton.files import as_mapping, check_mapping, read_mapping
from kcs_torch.skeleton.graph import find_cycle, find_pieces, find_twins
from kcs_torch.skeleton.mapping import map_joints
from kcs_torch.skeleton.parse import arguments, facts_by_names, index_pairs, listed

__all__ = ["Skeleton"]

Pair = tuple[int, int]
Point = tuple[float, float, float]

FOUND = "found"
"""Name of skeletons whose bones were found from motion: who gives one another name takes it at its word."""


@dataclass(frozen=True)
class Skeleton:
    """Which joints exist, which bones join them, and what is known of the body's shape.

    A skeleton is immutable and hashable. Bones run (parent, child). By default they must form one tree;
    ``tree=False`` admits any graph of rigid links: closed chains (two hands on one sword), separate
    pieces and loose joints.

    Args:
        joints: joint names, observed ones first, virtual ones last.
        bones: (parent, child) joint indices.
        name: what to call it.
        mirror: (left, right) pairs of joint indices.
        virtual: ``(joint, sources)`` for each joint that no detector reports: it is the mean of its sources.
        template: a rest pose, one (x right, y down, z away from the viewer) per joint, any unit; or None.
        proportions: relative bone lengths, one per bone, any unit; taken from the template if None.
        flexible: indices of bones that may change their length (a spine drawn as one stick, say).
        hinges: joints that bend one way only (:class:`Hinge`).
        contacts: indices of the joints that touch the ground: heels and toes, paws, or ankles.
        spread: how far each bone strays from the template, root mean square in degrees once the trunk is turned onto
            the template's; or None where nothing is known.
        tree: False admits cycles and separate pieces.

    Raises:
        SkeletonError: a name is doubled, an index is out of range, a bone joins a joint to itself or is
            given twice, or the bones are not one tree (the message names the cycle or the loose joint).

    >>> arm = Skeleton.from_names(["shoulder", "elbow", "wrist"], [("shoulder", "elbow"), ("elbow", "wrist")])
    >>> arm.num_joints, arm.num_bones, arm.bone_names
    (3, 2, ('shoulder-elbow', 'elbow-wrist'))
    """

    joints: tuple[str, ...]
    bones: tuple[Pair, ...]
    name: str = "custom"
    mirror: tuple[Pair, ...] = ()
    virtual: tuple[tuple[int, tuple[int, ...]], ...] = ()
    template: tuple[Point, ...] | None = None
    proportions: tuple[float, ...] | None = None
    flexible: tuple[int, ...] = ()
    tree: bool = True
    hinges: tuple[Hinge, ...] = ()
    contacts: tuple[int, ...] = ()
    spread: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        for field, value in as_tuples(self).items():
            object.__setattr__(self, field, value)
        check_facts(self)
        if self.tree:
            self.validate()

    # ------------------------------------------------------------------ constructors

    @classmethod
    def from_names(
        cls,
        joints: Sequence[str],
        bones: Iterable[tuple[str, str]],
        *,
        name: str = "custom",
        mirror: Iterable[tuple[str, str]] | None = None,
        virtual: Mapping[str, Sequence[str]] | None = None,
        template: str | Mapping[str, Sequence[float]] | None = None,
        proportions: Mapping[str, float] | None = None,
        flexible: Iterable[tuple[str, str]] = (),
        tree: bool = True,
        hinges: Iterable[Mapping[str, Any]] | None = None,
        contacts: Iterable[str] | None = None,
        spread: Mapping[str, float] | None = None,
    ) -> Skeleton:
        """Build a skeleton from joint names and pairs of names.

        Args:
            joints: names of the joints that tracks have, in their order.
            bones: (parent, child) names.
            name: what to call it.
            mirror: (left, right) names; found from the names if None ("left_hip"/"right_hip", "LHip"/"RHip").
            virtual: ``{joint: sources}``, each the mean of its sources; appended after ``joints``.
            template: ``"human"``, ``"hand"`` or ``"quadruped"`` (by joint names), ``{joint: (x, y, z)}``, or None.
            proportions: ``{"parent-child": relative length}`` for every bone.
            flexible: bones that may change their length.
            tree: False admits cycles and separate pieces.
            hinges: ``{"joint": "left_knee", "bends": "backward"}`` for each joint that bends one way only. More keys,
                where needed: ``axis`` (left, right), by default the mirror pair of the joint above; ``weight``, how
                far it can be relied on, 0 to 1, by default 1; ``parent`` and ``child``, where the bones do not tell
                them. Found from the names if None.
            contacts: joints that touch the ground; found from the names if None.
            spread: ``{"parent-child": degrees}`` for every bone, how far it strays from the template, or an empty
                mapping where nothing is known; found from the names if None and there is a template.

        Raises:
            SkeletonError: a name is unknown, or the skeleton is inconsistent.
        """
        return cls(
            **arguments(
                joints,
                bones,
                name=name,
                mirror=mirror,
                virtual=virtual,
                template=template,
                proportions=proportions,
                flexible=flexible,
                tree=tree,
                hinges=hinges,
                contacts=contacts,
                spread=spread,
            )
        )

    @classmethod
    def from_edges(
        cls,
        edges: Iterable[Sequence[int]],
        joints: int | Sequence[str],
        *,
        name: str = "custom",
        tree: bool = True,
    ) -> Skeleton:
        """Build a skeleton from index pairs; all else is found from the names, as far as they tell.

        Args:
            edges: (B, 2) pairs (parent, child).
            joints: joint names, or how many joints there are (named ``joint0``, ``joint1``, ...).
            name: what to call it.
            tree: False admits cycles and separate pieces.

        Raises:
            SkeletonError: an index is out of range, or the edges are not one tree.
        """
        from kcs_torch.skeleton.builtin import known_by_names  # the built-in ones are made by this class

        if isinstance(joints, (int, Integral)):  # NumPy's too
            joints = [f"joint{i}" for i in range(joints)]
        names = tuple(map(str, listed(joints, "joints", name)))
        pairs = index_pairs(edges, name)
        plain = cls(joints=names, bones=tuple(pairs), name=name, tree=tree)
        return replace(plain, **facts_by_names(names, pairs, known_by_names(names)))

    @classmethod
    def from_dict(cls, data: Mapping[str, Any], *, source: str = "skeleton") -> Skeleton:
        """Build a skeleton from the keys of :meth:`from_names`, as a YAML or JSON file holds them.

        Raises:
            FormatError: a key is unknown or missing, or a value has the wrong type.
        """
        given = check_mapping(data, source)
        try:
            return cls.from_names(**given)
        except SkeletonError as error:
            raise SkeletonError(f"{source}: {error}") from None
        except (TypeError, AttributeError, ValueError, IndexError) as error:
            raise FormatError(f"{source}: expected a skeleton as Skeleton.to_dict gives it, got {error}") from error

    @classmethod
    def load(cls, path: str | Path) -> Skeleton:
        """Read a skeleton from a YAML or JSON file (keys as in :meth:`from_names`).

        Raises:
            FormatError: the file cannot be read, or is not a skeleton.
        """
        return cls.from_dict(read_mapping(Path(path)), source=str(path))

    # ------------------------------------------------------------------ facts

    @property
    def num_joints(self) -> int:
        return len(self.joints)

    @property
    def num_bones(self) -> int:
        return len(self.bones)

    @property
    def num_observed(self) -> int:
        """Joints that tracks have; the virtual ones follow them."""
        return len(self.joints) - len(self.virtual)

    @cached_property
    def bone_names(self) -> tuple[str, ...]:
        return tuple(f"{self.joints[a]}-{self.joints[b]}" for a, b in self.bones)

    @cached_property
    def rigid(self) -> tuple[int, ...]:
        """Indices of the bones whose length is constant."""
        return tuple(i for i in range(self.num_bones) if i not in set(self.flexible))

    @cached_property
    def mirror_bones(self) -> tuple[Pair, ...]:
        """(left, right) pairs of bone indices, twins under ``mirror``."""
        return tuple(find_twins(self.bones, self.mirror))

    def side(self, joint: int) -> str:
        """'left', 'right' or 'centre'."""
        return {**{a: "left" for a, _ in self.mirror}, **{b: "right" for _, b in self.mirror}}.get(joint, "centre")

    def index(self, joint: str) -> int:
        """Index of a joint by name.

        Raises:
            SkeletonError: there is none of that name.
        """
        if joint not in self.joints:
            raise unknown(f"joint of skeleton '{self.name}'", joint, self.joints, SkeletonError)
        return self.joints.index(joint)

    def mapping_to(self, other: Skeleton) -> dict[str, str]:
        """Say which joint of this skeleton is which of another: ``{its name: our name}``, virtual ones included.

        By name, in any usual spelling (:func:`map_joints`); joints that only one of them has are left out.

        >>> from kcs_torch.skeleton import SKELETONS
        >>> [SKELETONS["coco17"].mapping_to(SKELETONS["body25"])[j] for j in ("RWrist", "MidHip", "Neck")]
        ['right_wrist', 'pelvis', 'neck']
        """
        found = map_joints(self.joints, other.joints)
        return {joint: self.joints[i] for joint, i in zip(other.joints, found, strict=True) if i is not None}

    def bone_index(self, *, device: torch.device | str | None = None) -> Tensor:
        """Bones as an integer tensor (B, 2) of (parent, child)."""
        return torch.tensor(self.bones, dtype=torch.long, device=device).reshape(-1, 2)

    def rigid_mask(self, *, dtype: torch.dtype = torch.bool, device: torch.device | str | None = None) -> Tensor:
        """Which bones have a constant length: (B,), True or 1 where they do."""
        mask = torch.ones(self.num_bones, dtype=dtype, device=device)
        mask[list(self.flexible)] = 0
        return mask

    def template_points(self, *, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> Tensor:
        """The rest pose as a tensor (N, 3).

        Raises:
            SkeletonError: the skeleton has no template.
        """
        if self.template is None:
            raise SkeletonError(f"skeleton '{self.name}' has no template pose: give one, or use a body's joint names")
        return torch.tensor(self.template, dtype=dtype, device=device)

    def relative_lengths(
        self, *, dtype: torch.dtype | None = None, device: torch.device | str | None = None
    ) -> Tensor | None:
        """Relative bone lengths (B,) with mean 1, or None where nothing is known of them."""
        if self.proportions is not None:
            lengths = torch.tensor(self.proportions, dtype=dtype, device=device)
        elif self.template is not None and self.bones:
            points = self.template_points(dtype=dtype, device=device)
            index = self.bone_index(device=device)
            lengths = (points[index[:, 1]] - points[index[:, 0]]).norm(dim=-1)
        else:
            return None
        return lengths / lengths.mean()

    # ------------------------------------------------------------------ checks

    def pieces(self) -> list[list[int]]:
        """Connected components, as sorted lists of joint indices; a loose joint is a piece of its own."""
        return find_pieces(self.num_joints, self.bones)

    def cycle(self) -> list[int] | None:
        """Joint indices along one closed chain, or None where there is none."""
        return find_cycle(self.num_joints, self.bones)

    def validate(self) -> None:
        """Check that the bones form one tree.

        Raises:
            SkeletonError: they do not; the message names the cycle or the loose joints, and the fix.
        """
        check_tree(self)

    @property
    def is_tree(self) -> bool:
        return len(self.pieces()) == 1 and len(self.bones) == self.num_joints - 1

    @property
    def found(self) -> bool:
        """Whether bones are not known, but were chosen for keeping their length: by :func:`kcs_torch.find_skeleton`."""
        return self.name == FOUND

    # ------------------------------------------------------------------ changes

    def with_links(self, links: Iterable[tuple[str, str]]) -> Skeleton:
        """Add rigid links between joints, which may close chains (two hands that hold one sword).

        >>> from kcs_torch.skeleton import SKELETONS
        >>> body = SKELETONS["coco17"].with_links([("left_wrist", "right_wrist")])
        >>> body.is_tree, body.bone_names[-1]
        (False, 'left_wrist-right_wrist')
        """
        given: list[Any] = list(links)
        for link in given:
            if isinstance(link, str) or len(link) != 2:
                raise SkeletonError(f"links: expected pairs of joint names, got {link!r}")
        extra = tuple((self.index(a), self.index(b)) for a, b in given)
        return self._with_bones(extra)

    def connected(self) -> Skeleton:
        """Join separate pieces by flexible bones, so that bone vectors determine the whole pose."""
        pieces = self.pieces()
        if len(pieces) == 1:
            return self
        main = max(pieces, key=len)
        extra = tuple((self._apart(main, p[0]), p[0]) for p in pieces if p is not main)
        first = self.num_bones
        flexible = self.flexible + tuple(range(first, first + len(extra)))
        return self._with_bones(extra, flexible=flexible)

    def _apart(self, piece: Sequence[int], joint: int) -> int:
        """The first joint of a piece; where the template has that and another joint in one place, the farthest."""
        if self.template is None:
            return piece[0]
        far = [math.dist(self.template[i], self.template[joint]) for i in piece]
        return piece[0] if far[0] > SAME * max(far) else piece[far.index(max(far))]

    def _with_bones(self, extra: tuple[Pair, ...], **changes: Any) -> Skeleton:
        """More bones, of which neither length nor spread is known."""
        spread = None if self.spread is None else self.spread + (UNKNOWN_SPREAD,) * len(extra)
        return replace(self, bones=self.bones + extra, proportions=None, spread=spread, tree=False, **changes)

    def complete(self, points: Tensor, weights: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Append the virtual joints to observed tracks.

        Args:
            points: (..., num_observed, D), finite.
            weights: (..., num_observed), 0 where unseen; all 1 if None.

        Returns:
            points (..., N, D) and weights (..., N). A virtual joint is seen where all its sources are.

        Raises:
            ShapeError: they are not tensors of these shapes; points that have the virtual joints already are not. Nor
                are points that are not in floating point.
        """
        check_observed(self, points, weights)
        if weights is None:
            weights = torch.ones_like(points[..., 0])
        for _, sources in self.virtual:
            index = torch.tensor(sources, device=points.device)
            points = torch.cat([points, points.index_select(-2, index).mean(-2, keepdim=True)], -2)
            weights = torch.cat([weights, weights.index_select(-1, index).amin(-1, keepdim=True)], -1)
        return points, weights

    def to_dict(self) -> dict[str, Any]:
        """The skeleton as plain lists and mappings: what :meth:`from_dict` and a YAML file take."""
        return as_mapping(self)
