"""From names to indices."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from kcs_torch.anatomy import (
    BENDS,
    KINDS,
    Hinge,
    contacts_by_names,
    hinges_by_names,
    mirror_name,
    side_of,
    spread_by_names,
    template_by_names,
)
from kcs_torch.errors import SkeletonError, unknown

if TYPE_CHECKING:
    from kcs_torch.skeleton.core import Skeleton

__all__ = ["arguments", "facts_by_names", "find_mirror", "index_pairs", "listed"]

Pair = tuple[int, int]
Point = tuple[float, float, float]


def index_pairs(edges: Iterable[Sequence[int]], name: str, what: str = "edges") -> list[Pair]:
    """Pairs of joint indices as plain integers.

    Raises:
        SkeletonError: an edge of the skeleton of that name is no pair of whole numbers.
    """
    pairs = []
    for edge in listed(edges, what, name):
        try:
            ends = tuple(map(float, edge))
        except (TypeError, ValueError):
            ends = ()
        if len(ends) != 2 or not all(e.is_integer() for e in ends):
            raise SkeletonError(
                f"{what} of skeleton '{name}': expected pairs of joint indices, got {edge!r}; "
                "Skeleton.from_names takes pairs of names"
            )
        pairs.append((int(ends[0]), int(ends[1])))
    return pairs


def arguments(
    joints: Sequence[str],
    bones: Iterable[tuple[str, str]],
    *,
    name: str,
    mirror: Iterable[tuple[str, str]] | None,
    virtual: Mapping[str, Sequence[str]] | None,
    template: str | Mapping[str, Sequence[float]] | None,
    proportions: Mapping[str, float] | None,
    flexible: Iterable[tuple[str, str]],
    tree: bool,
    hinges: Iterable[Mapping[str, Any]] | None,
    contacts: Iterable[str] | None,
    spread: Mapping[str, float] | None,
) -> dict[str, Any]:
    """Return the arguments of ``Skeleton`` from those of ``Skeleton.from_names``."""
    for what, mapping in (("virtual", virtual), ("proportions", proportions), ("spread", spread)):
        if not isinstance(mapping, (Mapping, type(None))):
            raise SkeletonError(f"{what} of skeleton '{name}': expected a mapping from names, got {mapping!r}")
    virtual = {str(v): listed(s, f"virtual joint '{v}'", name) for v, s in (virtual or {}).items()}
    names = (*_observed(joints, name), *virtual)
    position = {n: i for i, n in enumerate(names)}
    if doubled := sorted({n for n in names if names.count(n) > 1}):  # else the joint that one replaced would be unknown
        raise SkeletonError(f"skeleton '{name}': joint names must differ; given twice: {', '.join(doubled)}")

    def at(joint: object, what: str) -> int:
        if str(joint) not in position:
            raise unknown(f"joint in {what} of skeleton '{name}'", joint, names, SkeletonError)
        return position[str(joint)]

    def pairs(items: Iterable[tuple[str, str]], what: str) -> tuple[Pair, ...]:
        out = []
        for item in listed(items, what, name):
            if not isinstance(item, (list, tuple)) or len(item) != 2:
                raise SkeletonError(f"{what} of skeleton '{name}': expected pairs of joint names, got {item!r}")
            out.append((at(item[0], what), at(item[1], what)))
        return tuple(out)

    bone_pairs = pairs(bones, "bones")
    bone_names = [f"{names[a]}-{names[b]}" for a, b in bone_pairs]
    soft = {frozenset(p) for p in pairs(flexible, "flexible")}
    if soft - {frozenset(p) for p in bone_pairs}:
        raise SkeletonError(f"flexible of skeleton '{name}': expected bones, one of {', '.join(bone_names)}")

    def per_bone(given: Mapping[str, float] | None, what: str) -> tuple[float, ...] | None:
        if given is None:
            return None
        _check_keys(f"{what} of skeleton '{name}'", given, bone_names, bone_names)
        return tuple(_numbers((given[b],), f"{what} of skeleton '{name}': '{b}'")[0] for b in bone_names)

    spreads = None if spread is None or len(spread) == 0 else per_bone(spread, "spread")
    if spread is None and template is not None:
        spreads = spread_by_names(names, bone_pairs)
    twins = find_mirror(names) if mirror is None else pairs(mirror, "mirror")
    if hinges is None:
        bends = hinges_by_names(names, bone_pairs)
    else:
        given = listed(hinges, "hinges", name)
        bends = tuple(_read_hinge(h, names, bone_pairs, twins, f"hinges of skeleton '{name}'") for h in given)
    stand = None if contacts is None else listed(contacts, "contacts", name)
    return {
        "joints": names,
        "bones": bone_pairs,
        "name": name,
        "mirror": twins,
        "virtual": tuple((position[v], tuple(at(s, "virtual") for s in sources)) for v, sources in virtual.items()),
        "template": None if template is None else _read_template(template, names, virtual, name),
        "proportions": per_bone(proportions, "proportions"),
        "flexible": tuple(i for i, b in enumerate(bone_pairs) if frozenset(b) in soft),
        "tree": tree,
        "hinges": bends,
        "contacts": contacts_by_names(names) if stand is None else tuple(at(c, "contacts") for c in stand),
        "spread": spreads,
    }


def facts_by_names(names: Sequence[str], bones: Sequence[Pair], known: Skeleton | None) -> dict[str, Any]:
    """Return what names tell of a skeleton of these bones: mirror, template, hinges, contacts, spread, flexible.

    Args:
        names: N joint names.
        bones: pairs of joint indices.
        known: a skeleton whose observed joints have these names; what it says goes before what the names say.
    """
    template = None if known is None or known.template is None else known.template[: len(names)]
    for kind in KINDS:
        if template is None:
            try:
                template = template_by_names(kind, names)
            except SkeletonError:
                continue
    if template is not None and any(math.dist(template[a], template[b]) < 1e-6 for a, b in bones):
        template = None  # two names for one place: this body is built otherwise
    hinges, contacts, spread = hinges_by_names(names, bones), contacts_by_names(names), spread_by_names(names, bones)
    flexible: tuple[int, ...] = ()
    if known is not None:
        joined = {frozenset(b) for b in bones}
        hinges = tuple(h for h in known.hinges if {frozenset(b) for b in h.bones} <= joined)
        contacts = known.contacts
        bends = {frozenset(known.bones[b]) for b in known.flexible}
        flexible = tuple(i for i, bone in enumerate(bones) if frozenset(bone) in bends)
        if known.spread is not None:
            told = dict(zip(map(frozenset, known.bones), known.spread, strict=True))
            # A bone that the known skeleton has not, such as the links of hips and shoulders to a neck that is virtual
            # there, is as its names say.
            spread = tuple(told.get(frozenset(b), s) for b, s in zip(bones, spread, strict=True))
    return {
        "mirror": find_mirror(names),
        "template": template,
        "hinges": hinges,
        "contacts": contacts,
        "spread": None if template is None else spread,
        "flexible": flexible,
    }


def find_mirror(names: Sequence[str]) -> tuple[Pair, ...]:
    """Return (left, right) indices of the joints whose names are twins."""
    position = {n: i for i, n in enumerate(names)}
    twins = ((n, mirror_name(n)) for n in names if side_of(n) == "left")
    return tuple((position[a], position[b]) for a, b in twins if b in position)


def _observed(joints: Sequence[str], name: str) -> list[str]:
    """The names of the joints that tracks have."""
    joints = listed(list(joints) if isinstance(joints, str) else joints, "joints", name)
    if any(isinstance(joint, bool) for joint in joints):
        raise SkeletonError(
            f"joints of skeleton '{name}': expected names, got True or False: YAML reads on, off, yes and no as such, "
            "so put them in quotes"
        )
    return [str(joint) for joint in joints]


def _read_hinge(
    data: Mapping[str, Any], names: Sequence[str], bones: Sequence[Pair], mirror: Sequence[Pair], what: str
) -> Hinge:
    """A hinge from names; ends not given follow from the bones, an axis not given from the mirror pairs."""
    keys = ("joint", "bends", "axis", "weight", "parent", "child")
    if not isinstance(data, Mapping):
        raise SkeletonError(f"{what}: expected mappings such as {{joint: left_knee, bends: backward}}, got {data!r}")
    for key in data:
        if key not in keys:
            raise unknown(f"key in {what}", key, keys, SkeletonError)

    def at(joint: object) -> int:
        if str(joint) not in names:
            raise unknown(f"joint in {what}", joint, names, SkeletonError)
        return list(names).index(str(joint))

    if "joint" not in data or data.get("bends") not in list(BENDS):
        raise SkeletonError(f"{what}: expected 'joint' and 'bends: {' or '.join(BENDS)}', got {dict(data)}")
    joint, ends = at(data["joint"]), {}
    for key, around in (
        ("parent", [a for a, b in bones if b == joint]),
        ("child", [b for a, b in bones if a == joint]),
    ):
        if data.get(key) is not None:
            ends[key] = at(data[key])
        elif len(around) == 1:
            ends[key] = around[0]
        else:
            choices = ", ".join(names[i] for i in around) or "no joint"
            raise SkeletonError(f"{what}: '{names[joint]}': the bones give {choices} as {key}: write '{key}: NAME'")
    axis = data.get("axis")
    if axis is None:
        pair = next((p for p in mirror if ends["parent"] in p), None)
        if pair is None:
            raise SkeletonError(
                f"{what}: '{names[joint]}': '{names[ends['parent']]}' has no mirror twin to make an axis: "
                "write 'axis: [LEFT, RIGHT]'"
            )
    elif isinstance(axis, (list, tuple)) and len(axis) == 2:
        pair = (at(axis[0]), at(axis[1]))
    else:
        raise SkeletonError(f"{what}: '{names[joint]}': axis: expected two joint names, left and right, got {axis!r}")
    weight = data.get("weight")
    (firm,) = (1.0,) if weight is None else _numbers((weight,), f"{what}: '{names[joint]}': weight")
    return Hinge(ends["parent"], joint, ends["child"], *pair, sign=BENDS[data["bends"]], firm=firm)


def _read_template(
    template: str | Mapping[str, Sequence[float]],
    names: Sequence[str],
    virtual: Mapping[str, Sequence[str]],
    name: str,
) -> tuple[Point, ...]:
    """Positions of all joints; a virtual one that has none of its own is the mean of its sources."""
    given: dict[str, Sequence[float]]
    if isinstance(template, str):
        real = [n for n in names if n not in virtual]
        given = dict(zip(real, template_by_names(template, real), strict=True))
    elif not isinstance(template, Mapping):
        raise SkeletonError(
            f"template of skeleton '{name}': expected {{joint: (x, y, z)}} or one of {', '.join(KINDS)}, "
            f"got {type(template).__name__}"
        )
    else:
        given = {str(n): _numbers(p, f"template of skeleton '{name}': '{n}'", 3) for n, p in template.items()}
        _check_keys(f"template of skeleton '{name}'", given, names, [n for n in names if n not in virtual])
    for joint, sources in virtual.items():
        if joint not in given and all(s in given for s in sources):
            columns = zip(*(given[s] for s in sources), strict=True)
            given[joint] = tuple(sum(column) / len(sources) for column in columns)
    return tuple(tuple(given[n]) for n in names if n in given)  # type: ignore[misc]


def listed(items: Iterable[Any], what: str, name: str) -> tuple[Any, ...]:
    """The items of a list, which a word is none of.

    Raises:
        SkeletonError: they are none.
    """
    if isinstance(items, (str, Mapping)) or not isinstance(items, Iterable):
        raise SkeletonError(f"{what} of skeleton '{name}': expected a list, got {items!r}")
    return tuple(items)


def _numbers(values: Iterable[float], what: str, count: int = 1) -> tuple[float, ...]:
    """So many numbers.

    Raises:
        SkeletonError: they are none, or not so many.
    """
    try:
        numbers = tuple(float(value) for value in values)
    except (TypeError, ValueError):
        numbers = ()
    if len(numbers) != count:
        raise SkeletonError(f"{what}: expected {'a number' if count == 1 else f'{count} numbers'}, got {values!r}")
    return numbers


def _check_keys(what: str, given: Iterable[str], known: Sequence[str], needed: Sequence[str]) -> None:
    """Every needed key is there, and no unknown one."""
    given = set(given)
    for key in sorted(given - set(known)):
        raise unknown(f"name in {what}", key, known, SkeletonError)
    missing = [n for n in needed if n not in given]
    if missing:
        raise SkeletonError(f"{what}: expected an entry for each of {len(needed)}, none for {', '.join(missing)}")
