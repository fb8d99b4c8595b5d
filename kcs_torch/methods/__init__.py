"""Methods: one file or folder a paper.

They share ``base`` (what a method is), ``factorised`` (the classical ones), ``clips`` (what is asked of tracks before
they are solved) and ``answer`` (what is made of a solution). ``perspective`` takes any of them before a pinhole camera.
"""

from kcs_torch.methods.base import Estimate, Method
from kcs_torch.methods.bmm import BMM
from kcs_torch.methods.csf import CSF
from kcs_torch.methods.found_skeleton import find_skeleton
from kcs_torch.methods.kcs import KCS
from kcs_torch.methods.local_rigidity import LocalRigidity
from kcs_torch.methods.pkc import PKC
from kcs_torch.methods.pnd import PND
from kcs_torch.methods.pta import PTA
from kcs_torch.methods.rigid import Rigid
from kcs_torch.methods.sfam import SfAM
from kcs_torch.methods.smsr import SMSR

__all__ = [
    "BMM",
    "CSF",
    "KCS",
    "METHODS",
    "PKC",
    "PND",
    "PTA",
    "SMSR",
    "Estimate",
    "LocalRigidity",
    "Method",
    "Rigid",
    "SfAM",
    "find_skeleton",
]

METHODS: dict[str, type[Method]] = {
    "pkc": PKC,
    "sfam": SfAM,
    "kcs": KCS,
    "rigid": Rigid,
    "pta": PTA,
    "csf": CSF,
    "bmm": BMM,
    "smsr": SMSR,
    "local_rigidity": LocalRigidity,
    "pnd": PND,
}
"""The methods by name."""
