"""Skeletons: named joints, the rigid bones between them, and what is known of their shape."""

from kcs_torch.anatomy import Hinge
from kcs_torch.skeleton.builtin import SKELETONS, fitting_links, get_skeleton, guess_skeleton, known_by_names
from kcs_torch.skeleton.core import Skeleton
from kcs_torch.skeleton.mapping import map_joints
from kcs_torch.skeleton.person import has_middle, person_by_names
from kcs_torch.skeleton.stature import stature_weights

__all__ = [
    "SKELETONS",
    "Hinge",
    "Skeleton",
    "fitting_links",
    "get_skeleton",
    "guess_skeleton",
    "has_middle",
    "known_by_names",
    "map_joints",
    "person_by_names",
    "stature_weights",
]
