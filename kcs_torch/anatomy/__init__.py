"""What the names of joints mean, and where a human's joints are."""

from kcs_torch.anatomy.names import canonical_name, mirror_name, side_of
from kcs_torch.anatomy.template import places_by_names, template_by_names

__all__ = ["canonical_name", "mirror_name", "places_by_names", "side_of", "template_by_names"]
