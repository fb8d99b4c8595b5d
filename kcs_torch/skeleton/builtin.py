"""The skeletons that ship with the package, and finding one."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path

from kcs_torch.errors import SkeletonError, unknown
from kcs_torch.skeleton.core import Skeleton

__all__ = ["SKELETONS", "fitting_links", "get_skeleton", "guess_skeleton", "known_by_names"]


class _BuiltIn(Mapping[str, Skeleton]):
    """The skeletons that ship with the package, one YAML file each; read when first asked for."""

    folder = Path(__file__).parents[1] / "skeletons"

    def __getitem__(self, name: str) -> Skeleton:
        if not isinstance(name, str) or name not in self._names():
            raise KeyError(name)
        return self._load(name)

    def __iter__(self) -> Iterator[str]:
        return iter(self._names())

    def __len__(self) -> int:
        return len(self._names())

    @staticmethod
    @cache
    def _names() -> tuple[str, ...]:
        return tuple(sorted(p.stem for p in _BuiltIn.folder.glob("*.yaml")))

    @staticmethod
    @cache
    def _load(name: str) -> Skeleton:
        return Skeleton.load(_BuiltIn.folder / f"{name}.yaml")


SKELETONS: Mapping[str, Skeleton] = _BuiltIn()
"""The built-in skeletons by name."""


SUFFIXES = (".yaml", ".yml", ".json")
"""By which a name is told to be that of a skeleton's file."""


def get_skeleton(skeleton: str | Path | Skeleton) -> Skeleton:
    """Return a skeleton from itself, a built-in name, or a YAML/JSON file.

    Raises:
        SkeletonError: no built-in skeleton has that name.
        FormatError: the file cannot be read.
    """
    if isinstance(skeleton, Skeleton):
        return skeleton
    if isinstance(skeleton, Path) or str(skeleton).lower().endswith(SUFFIXES):
        return Skeleton.load(skeleton)
    if not isinstance(skeleton, str):
        raise SkeletonError(
            f"unknown skeleton {str(skeleton)[:100]}: expected a Skeleton, a built-in name or a file, got a "
            f"{type(skeleton).__name__}: Skeleton.from_names(joints, bones) or Skeleton.from_edges(edges, joints)"
        )
    if skeleton not in SKELETONS:
        with suppress(OSError):  # a name too long for a file's
            if Path(skeleton).is_file():
                raise SkeletonError(f"{skeleton}: expected a skeleton's file to be called .yaml or .json")
        raise unknown("skeleton", skeleton, SKELETONS, SkeletonError)
    return SKELETONS[skeleton]


def guess_skeleton(joint_names: Sequence[str], *, ordered: bool = True) -> Skeleton | None:
    """Return the built-in skeleton whose observed joints carry exactly these names, if any.

    Args:
        joint_names: names of a body's joints.
        ordered: whether they have to stand in the skeleton's order.
    """
    names = [str(j) for j in joint_names]
    for skeleton in SKELETONS.values():
        own = list(skeleton.joints[: skeleton.num_observed])
        if own == names or (not ordered and sorted(own) == sorted(names)):
            return skeleton
    return None


def known_by_names(joint_names: Sequence[str]) -> Skeleton | None:
    """Return the built-in skeleton whose observed joints carry these names, with its joints in their order.

    Args:
        joint_names: names of a body's joints, in any order.
    """
    known = guess_skeleton(joint_names)
    other = None if known is not None else guess_skeleton(joint_names, ordered=False)
    return known if other is None else Skeleton.from_dict(other.to_dict() | {"joints": [str(j) for j in joint_names]})


ALIKE = 0.9
"""Share of the bones of a skeleton with virtual joints that must be among links that are to tell it."""


def fitting_links(links: Iterable[Sequence[int]], num_joints: int) -> list[Skeleton]:
    """Return the built-in skeletons of as many observed joints whose bones these links are, joint by joint.

    Published links of detectors that close chains have more than the bones of a tree with virtual joints, and may lack
    one or two of these; links that are a tree have to be the same.

    Args:
        links: pairs of joint indices.
        num_joints: observed joints.

    >>> body = SKELETONS["body25"]
    >>> [fits.name for fits in fitting_links(body.bones, 25)], fitting_links(body.bones[1:], 25)
    (['body25'], [])
    """
    given = {frozenset(map(int, link)) for link in links}
    fitting = []
    for skeleton in SKELETONS.values():
        if skeleton.num_observed == num_joints:
            own = {frozenset(bone) for bone in skeleton.bones if max(bone) < num_joints}
            if given == own or (skeleton.virtual and len(given & own) >= ALIKE * len(own)):
                fitting.append(skeleton)
    return fitting
