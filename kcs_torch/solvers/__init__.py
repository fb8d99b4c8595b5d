"""Iterations over callables: they know no camera, prior or skeleton."""

from kcs_torch.solvers.camera_path import choose_path, constant_path, settle_path, smooth_path
from kcs_torch.solvers.completion import complete_tracks
from kcs_torch.solvers.denoise import Denoised, denoise_tracks
from kcs_torch.solvers.ist import ist, metric_upgrade
from kcs_torch.solvers.iterate import Solution, fpc, iterate, svt
from kcs_torch.solvers.lm import fit_bones
from kcs_torch.solvers.procrustean import procrustean

__all__ = [
    "Denoised",
    "Solution",
    "choose_path",
    "complete_tracks",
    "constant_path",
    "denoise_tracks",
    "fit_bones",
    "fpc",
    "ist",
    "iterate",
    "metric_upgrade",
    "procrustean",
    "settle_path",
    "smooth_path",
    "svt",
]
