"""Methods: one file a paper."""

from kcs_torch.methods.base import Method
from kcs_torch.methods.kcs import KCS
from kcs_torch.methods.sfam import SfAM

__all__ = ["KCS", "METHODS", "Method", "SfAM"]

METHODS: dict[str, type[Method]] = {"kcs": KCS, "sfam": SfAM}
"""The methods by name."""
