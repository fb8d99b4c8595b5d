"""Unrolled solvers: a fixed number of a method's steps as layers, with learnable step sizes, weights and bone lengths.

Untrained they are the method. Each is differentiated through all of its steps, through the last ones, or implicitly at
its fixed point.
"""

from kcs_torch.nn.unrolled.base import Unrolled
from kcs_torch.nn.unrolled.fpc import UnrolledFPC
from kcs_torch.nn.unrolled.kcs import UnrolledKCS
from kcs_torch.nn.unrolled.pkc import UnrolledPKC
from kcs_torch.nn.unrolled.sfam import UnrolledSfAM

__all__ = ["Unrolled", "UnrolledFPC", "UnrolledKCS", "UnrolledPKC", "UnrolledSfAM"]
