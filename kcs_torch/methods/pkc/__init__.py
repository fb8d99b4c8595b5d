"""PKC: Procrustean kinematic chains; every stage is a function of its own."""

from kcs_torch.methods.pkc.fixed_view import fixed_view
from kcs_torch.methods.pkc.hypotheses import Hypotheses
from kcs_torch.methods.pkc.method import PKC
from kcs_torch.methods.pkc.moving_solutions import MovingView
from kcs_torch.methods.pkc.moving_view import moving_view
from kcs_torch.methods.pkc.objective import Objective
from kcs_torch.methods.pkc.refinement import minimise
from kcs_torch.methods.pkc.weights import Weights

__all__ = ["PKC", "Hypotheses", "MovingView", "Objective", "Weights", "fixed_view", "minimise", "moving_view"]
