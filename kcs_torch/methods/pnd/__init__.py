"""PND: Procrustean normal distribution, fitted by expectation maximisation (Lee, Cho, Choi, Oh, CVPR 2013)."""

from kcs_torch.methods.pnd.distribution import ProcrusteanNormal, align_to_mean, procrustean_tangent
from kcs_torch.methods.pnd.fit import fit_procrustean_normal
from kcs_torch.methods.pnd.method import PND

__all__ = ["PND", "ProcrusteanNormal", "align_to_mean", "fit_procrustean_normal", "procrustean_tangent"]
