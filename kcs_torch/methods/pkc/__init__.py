"""PKC: Procrustean kinematic chains; every stage is a function of its own, and ``docs/pkc.md`` derives them.

- The recipe: ``method``, for a ``clip``, and for ``hands`` by themselves; ``batch`` answers what searches of several
  clips ask for at once.
- What goes in: ``gate`` leaves out what is no detection of the body, ``elsewhere`` what leaps away and back, and
  ``stuck`` what only repeats itself; ``ends`` that no frame shows are placed afterwards; ``cleaning`` smooths and
  completes, ``long_gaps`` are shortened and ``gaps`` filled in space; ``sizing`` takes out a size that changes,
  ``near`` asks for a near camera.
- A body with a template: ``fixed_view`` makes hypotheses, of a ``trunk`` and its ``limbs``, by ``placing`` these where
  their ``limb_costs`` are least; ``blocks`` divides long clips, and ``body`` ranks and polishes what is found.
- The objective: ``objective`` by its ``weights``, and ``refinement`` of ``hypotheses`` on it by the gradient of
  ``descent``, which takes from ``image``, ``sides`` and ``trunk_frame``, over ``unknowns``.
- Runs of signs: ``flips`` by ``run_costs``, and ``strides`` of legs; judged by aligned bones in ``around``.
- A viewpoint that turns: ``moving_search``, which is ``moving_view`` as a function, finds ``moving_solutions`` by
  ``descents`` from many starts, by ``assembly`` of bones' paths, and without ``leaps``.
- What comes out: ``fixed_answer`` and ``moving_answer`` with what both say in ``answers``; ``held`` for a few joints.
"""

from kcs_torch.methods.pkc.fixed_view import fixed_view
from kcs_torch.methods.pkc.hypotheses import Hypotheses
from kcs_torch.methods.pkc.method import PKC
from kcs_torch.methods.pkc.moving_solutions import MovingView
from kcs_torch.methods.pkc.moving_view import moving_view
from kcs_torch.methods.pkc.objective import Objective
from kcs_torch.methods.pkc.refinement import minimise
from kcs_torch.methods.pkc.weights import Weights

__all__ = ["PKC", "Hypotheses", "MovingView", "Objective", "Weights", "fixed_view", "minimise", "moving_view"]
