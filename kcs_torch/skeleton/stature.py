"""The stature of a person from the lengths of the bones."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from kcs_torch.anatomy import places_of_known, quadruped_places, share_of_stature, side_of
from kcs_torch.skeleton.core import Skeleton

__all__ = ["stature_weights"]

# What is taken for the top of the body and for the end of each leg: the first that there is. Ears and eyes come last,
# for the length of their bones is hardly known; the direction of those of the toes changes with the shoe.
_TOPS = ("headtop", "head", "upperneck", "nose", "eye", "ear")
_FEET = ("heel", "ankle", "ball", "toetip", "bigtoe")
# Of names that are no joint of the human template.
_WORDS = (
    ("headtop", "headtop"),
    ("topofhead", "headtop"),
    ("head", "head"),
    ("nose", "nose"),
    ("heel", "heel"),
    ("ankle", "ankle"),
    ("foot", "ankle"),
)


def stature_weights(body: Skeleton) -> Tensor | None:
    """How much of a standing person's stature a unit of each bone makes up, by leg: stature = weights @ lengths.

    Along the bones from the head to a foot, each counts by how far it goes down in the template, so that a bone across
    the body, to a hip, does not count; without a template, each counts in full. That is divided by the share of a
    stature that lies between those two joints: 98 % from the top of the head to a heel, 87 % from the nose to an ankle.
    A joint called head lies at the top of the head or in its middle, as the template has it.
    Nothing of the skull counts twice: bones to the face are left out where a joint of the head is higher.

    Returns:
        (K, B), a row for each leg; None where there is no head, or no leg that bones join to it, or an animal's.

    >>> from kcs_torch.skeleton import get_skeleton
    >>> body = get_skeleton("coco17")  # its template is of a person of 1.75 m
    >>> ends = body.template_points()[body.bone_index()]
    >>> stature_weights(body) @ (ends[:, 1] - ends[:, 0]).norm(dim=-1)
    tensor([1.7500, 1.7500])
    """
    if quadruped_places(body.joints) is not None:
        return None
    places = _places(body)
    top, height = next(((i, place) for place in _TOPS for i, (_, p) in enumerate(places) if p == place), (-1, ""))
    if not height:
        return None
    reached = _reach(body, top)
    rows = []
    for side in ("left", "right", "centre"):
        feet = [(i, f) for f in _FEET for i, p in enumerate(places) if p == (side, f) and i in reached]
        for foot, depth in feet[:1]:
            highest = _head(body, places, top, foot) if height == "head" else height
            rows.append(reached[foot] / (share_of_stature(highest) - share_of_stature(depth)))
    return torch.stack(rows) if rows else None


def _places(body: Skeleton) -> list[tuple[str, str | None]]:
    """Side and place of each joint."""
    found = []
    for name, known in zip(body.joints, places_of_known(body.joints), strict=True):
        key = "".join(c for c in name.lower() if c.isalpha())
        found.append(known or (side_of(name), next((place for word, place in _WORDS if word in key), None)))
    return found


def _head(body: Skeleton, places: Sequence[tuple[str, str | None]], top: int, foot: int) -> str:
    """Whether a joint called head lies in the middle of the head or at its top: as the template has it."""
    base = next((i for i, (_, place) in enumerate(places) if place in ("neck", "thorax", "shoulder")), None)
    if body.template is None or base is None:
        return "head"
    tall, trunk = (body.template[foot][1] - body.template[i][1] for i in (top, base))
    least, neck = (share_of_stature(places[i][1] or "") for i in (foot, base))
    return min(("head", "headtop"), key=lambda p: abs((share_of_stature(p) - least) * trunk - (neck - least) * tall))


def _reach(body: Skeleton, top: int) -> dict[int, Tensor]:
    """The joints that bones join to ``top``, and how much each bone (B,) on the way counts."""
    rest = None if body.template is None else body.template_points()
    beside: dict[int, list[tuple[int, int]]] = {i: [] for i in range(body.num_joints)}
    for b, (parent, child) in enumerate(body.bones):
        beside[parent].append((child, b))
        beside[child].append((parent, b))
    reached, queue = {top: torch.zeros(body.num_bones)}, [top]
    for i in queue:  # grows as joints are met
        for j, b in beside[i]:
            if j not in reached:
                reached[j] = reached[i].clone()
                way = torch.tensor([0.0, 1.0, 0.0]) if rest is None else rest[j] - rest[i]
                reached[j][b] = way[1] / way.norm().clamp_min(1e-9)
                queue.append(j)
    return reached
