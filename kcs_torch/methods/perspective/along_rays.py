"""A body seen along rays whose bones may have other signs of depth: :class:`AlongRays`."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kcs_torch.functional.chain import bone_vectors
from kcs_torch.methods.perspective.pinhole import NEAREST
from kcs_torch.methods.pkc.objective import Objective
from kcs_torch.methods.pkc.run_costs import Flipped

__all__ = ["AlongRays"]


class _Link(NamedTuple):
    """A bone from a joint that is laid to one that hangs on it; of sense -1 if its parent is the latter."""

    bone: int
    near: int
    far: int
    sense: int


class AlongRays:
    """A body whose joints stay on their rays (u, v, 1), and whose bones keep their lengths, whatever their signs.

    The ray of a bone's far joint meets the sphere about the near joint whose radius is the bone's length twice, as far
    before the ray's nearest point as behind it. Under parallel rays these are depths z and -z; before a near camera -z
    would be another length, and what hangs on the bone moves other spheres. Bones are therefore laid one after another,
    from the trunk's first joint on, which stays where it is.

    Args:
        objective: of the body's image under parallel rays.
        rays: (T, N, 2), complete.
        distance: (T,) of the body, in units of the template.
        depth: (T, N) of joints, relative to the distance.

    Attributes:
        own: (T, B) signed depths of bones, each along its far joint's ray.
    """

    def __init__(self, objective: Objective, rays: Tensor, distance: Tensor, depth: Tensor) -> None:
        self.objective, self.least = objective, NEAREST * distance
        self.rays = torch.cat([rays, torch.ones_like(rays[..., :1])], -1)
        self.square = self.rays.square().sum(-1)  # (T, N)
        self.far = distance[:, None] + depth
        self.links = _from_trunk(objective)
        points = self.rays * self.far[..., None]
        self.lengths = bone_vectors(points, objective.bones).norm(dim=-1)  # (T, B)
        self.own = torch.zeros_like(self.lengths)
        for bone, near, far, sense in self.links:
            ahead = self.far[:, far] - (self.rays[:, far] * points[:, near]).sum(-1) / self.square[:, far]
            self.own[:, bone] = sense * ahead * self.square[:, far].sqrt()

    def turned(self, signs: Tensor) -> Flipped:
        """Bodies with signs (K, T or 1, B) turned."""
        places = list(self.far.expand(len(signs), -1, -1).unbind(-1))  # (K, T) each
        signs = torch.where(self.own < 0, -1, 1) * signs
        for bone, near, far, sense in self.links:
            here, square = places[near], self.square[:, far]
            along = (self.rays[:, far] * self.rays[:, near]).sum(-1) / square * here
            left = (self.lengths[:, bone].square() - self.square[:, near] * here.square()) / square
            reach = (along.square() + left).clamp_min(0).sqrt()
            places[far] = torch.maximum(along + sense * signs[..., bone] * reach, self.least)
        n, complete = self.objective.skeleton.num_observed, self.objective.complete  # virtual joints follow the others
        laid = torch.stack(places[:n], -1)
        depth, image = laid @ complete, ((self.rays[:, :n, :2] * laid[..., None]).mT @ complete).mT
        outer = self.objective.bones[:, 1]
        ahead = (self.rays[:, outer, :2] * bone_vectors(image, self.objective.bones)).sum(-1)
        over = depth[..., outer] / self.far.mean()
        return Flipped(depth - depth.mean(-1, keepdim=True), image - image.mean(-2, keepdim=True), ahead, over)


def _from_trunk(objective: Objective) -> list[_Link]:
    """All bones, those nearer to the trunk first; each further piece of a skeleton after its first bone's parent."""
    left = dict(enumerate(objective.skeleton.bones))
    reached, links = {int(objective.posture.trunk[0])}, list[_Link]()
    while left:
        here = {b: pair for b, pair in left.items() if reached.intersection(pair)}
        for bone, (parent, child) in here.items():
            del left[bone]
            if not reached.issuperset((parent, child)):
                near, far, sense = (parent, child, 1) if parent in reached else (child, parent, -1)
                links.append(_Link(bone, near, far, sense))
                reached.add(far)
        if not here:
            reached.add(next(iter(left.values()))[0])
    return links
