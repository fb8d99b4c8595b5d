"""The forward recursion of the signs agrees with the whole Viterbi search."""

import pytest
import torch

from kcs_torch.solvers import SignFilter, smooth_signs


@pytest.mark.parametrize(("frames", "poses", "bones"), [(1, 2, 1), (2, 2, 2), (12, 1, 1), (12, 2, 2), (9, 3, 1)])
def test_last_frame_is_that_of_smooth_signs(frames, poses, bones):
    generator = torch.Generator().manual_seed(frames + poses)
    draw = lambda *shape: torch.rand(*shape, generator=generator, dtype=torch.float64)  # noqa: E731
    unary, depths = 4 * draw(5, frames, poses, 2**bones), 6 * draw(5, frames, bones)
    transition = 2 * draw(max(frames - 1, 0), poses, poses)
    whole = smooth_signs(unary, depths, cap=9.0, transition=transition, margins=True)
    signs = SignFilter(cap=9.0)
    for t in range(frames):
        margins = signs.step(unary[:, t], depths[:, t], transition[t - 1] if t else None)
    assert torch.allclose(margins, whole.margins[:, -1])


def test_costs_stay_bounded():
    signs = SignFilter(cap=9.0)
    for t in range(300):
        depth = torch.tensor([[1.0 + (t % 7)]])
        margins = signs.step(torch.tensor([[[0.0, 5.0]]]), depth)
    assert float(signs.cost.abs().max()) < 100 and float(margins.min()) == 0
