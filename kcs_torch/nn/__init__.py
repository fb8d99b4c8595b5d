"""Modules: layers, energies that are losses and solver terms at once, and unrolled solvers."""

from kcs_torch.nn.anatomy import AdductionEnergy, HingeEnergy
from kcs_torch.nn.contact import ContactEnergy
from kcs_torch.nn.critic import KCSCritic, critic_loss, generator_loss
from kcs_torch.nn.distances import JointDistance, KCSDistance
from kcs_torch.nn.energies import BoneLengthEnergy, LowRankEnergy, SmoothnessEnergy, SymmetryEnergy
from kcs_torch.nn.layers import SVT, BoneLengths, BoneVectors, KCSMatrix
from kcs_torch.nn.lengths import ForeshorteningEnergy, ProportionEnergy
from kcs_torch.nn.networks import CameraHead, MLPLifter, TemporalLifter
from kcs_torch.nn.perspective import PerspectiveEnergy
from kcs_torch.nn.posture import PostureEnergy
from kcs_torch.nn.procrustean import ProcrusteanEnergy
from kcs_torch.nn.refined import RefinedLifter
from kcs_torch.nn.reprojection import ReprojectionEnergy
from kcs_torch.nn.stance import StanceEnergy
from kcs_torch.nn.unrolled import UnrolledFPC, UnrolledKCS, UnrolledPKC, UnrolledSfAM

__all__ = [
    "SVT",
    "AdductionEnergy",
    "BoneLengthEnergy",
    "BoneLengths",
    "BoneVectors",
    "CameraHead",
    "ContactEnergy",
    "ForeshorteningEnergy",
    "HingeEnergy",
    "JointDistance",
    "KCSCritic",
    "KCSDistance",
    "KCSMatrix",
    "LowRankEnergy",
    "MLPLifter",
    "PerspectiveEnergy",
    "PostureEnergy",
    "ProcrusteanEnergy",
    "ProportionEnergy",
    "RefinedLifter",
    "ReprojectionEnergy",
    "SmoothnessEnergy",
    "StanceEnergy",
    "SymmetryEnergy",
    "TemporalLifter",
    "UnrolledFPC",
    "UnrolledKCS",
    "UnrolledPKC",
    "UnrolledSfAM",
    "critic_loss",
    "generator_loss",
]
