"""Iterations over callables: they know no camera, prior or skeleton."""

from kcs_torch.solvers.camera_path import choose_path, constant_path, settle_path
from kcs_torch.solvers.completion import complete_tracks
from kcs_torch.solvers.denoise import Denoised, denoise_tracks
from kcs_torch.solvers.implicit import Implicit, fixed_point, gmres
from kcs_torch.solvers.ist import ist, metric_upgrade
from kcs_torch.solvers.iterate import Solution, fpc, iterate, svt
from kcs_torch.solvers.lbfgs import lbfgs
from kcs_torch.solvers.lm import fit_bones
from kcs_torch.solvers.noise import Noise, measure_noise
from kcs_torch.solvers.nullspace import null_space_upgrade
from kcs_torch.solvers.procrustean import procrustean
from kcs_torch.solvers.sign_filter import SignFilter
from kcs_torch.solvers.signs import SignPath, sign_costs, sign_table, smooth_signs
from kcs_torch.solvers.standing import root_velocity
from kcs_torch.solvers.swaps import swapped_frames

__all__ = [
    "Denoised",
    "Implicit",
    "Noise",
    "SignFilter",
    "SignPath",
    "Solution",
    "choose_path",
    "complete_tracks",
    "constant_path",
    "denoise_tracks",
    "fit_bones",
    "fixed_point",
    "fpc",
    "gmres",
    "ist",
    "iterate",
    "lbfgs",
    "measure_noise",
    "metric_upgrade",
    "null_space_upgrade",
    "procrustean",
    "root_velocity",
    "settle_path",
    "sign_costs",
    "sign_table",
    "smooth_signs",
    "svt",
    "swapped_frames",
]
