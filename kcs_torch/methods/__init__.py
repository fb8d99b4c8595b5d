"""Methods: one file a paper."""

from kcs_torch.methods.base import Method
from kcs_torch.methods.found import find_skeleton
from kcs_torch.methods.kcs import KCS
from kcs_torch.methods.pkc import PKC
from kcs_torch.methods.sfam import SfAM

__all__ = ["KCS", "METHODS", "PKC", "Method", "SfAM", "find_skeleton"]

METHODS: dict[str, type[Method]] = {"pkc": PKC, "sfam": SfAM, "kcs": KCS}
"""The methods by name."""
