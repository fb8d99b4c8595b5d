"""Motion to try things on."""

from kcs_torch.data.synthetic import SyntheticClip, random_motion, walking_person

__all__ = ["SyntheticClip", "random_motion", "walking_person"]
