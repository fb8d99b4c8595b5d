"""What the names of joints mean, where a human's joints are, and how they move."""

from kcs_torch.anatomy.limbs import BENDS, Hinge, contacts_by_names, hinges_by_names
from kcs_torch.anatomy.names import mirror_name, side_of
from kcs_torch.anatomy.quadruped import quadruped_places
from kcs_torch.anatomy.spread import UNKNOWN_SPREAD, spread_by_names
from kcs_torch.anatomy.template import (
    KINDS,
    STATURE,
    places_by_names,
    places_of_known,
    share_of_stature,
    template_by_names,
)

__all__ = [
    "BENDS",
    "KINDS",
    "STATURE",
    "UNKNOWN_SPREAD",
    "Hinge",
    "contacts_by_names",
    "hinges_by_names",
    "mirror_name",
    "places_by_names",
    "places_of_known",
    "quadruped_places",
    "share_of_stature",
    "side_of",
    "spread_by_names",
    "template_by_names",
]
