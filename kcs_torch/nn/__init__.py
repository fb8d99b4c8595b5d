"""Modules: layers, energies that are losses and solver terms at once, and unrolled solvers."""

from kcs_torch.nn.anatomy import HingeEnergy
from kcs_torch.nn.energies import (
    BoneLengthEnergy,
    LowRankEnergy,
    ReprojectionEnergy,
    SmoothnessEnergy,
    SymmetryEnergy,
)
from kcs_torch.nn.layers import SVT, BoneLengths, BoneVectors, KCSMatrix
from kcs_torch.nn.posture import ContactEnergy, ForeshorteningEnergy, PostureEnergy, ProportionEnergy
from kcs_torch.nn.procrustean import ProcrusteanEnergy
from kcs_torch.nn.unrolled import UnrolledFPC, UnrolledSfAM

__all__ = [
    "SVT",
    "BoneLengthEnergy",
    "BoneLengths",
    "BoneVectors",
    "ContactEnergy",
    "ForeshorteningEnergy",
    "HingeEnergy",
    "KCSMatrix",
    "LowRankEnergy",
    "PostureEnergy",
    "ProcrusteanEnergy",
    "ProportionEnergy",
    "ReprojectionEnergy",
    "SmoothnessEnergy",
    "SymmetryEnergy",
    "UnrolledFPC",
    "UnrolledSfAM",
]
