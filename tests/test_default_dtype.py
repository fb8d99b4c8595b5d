"""Numbers do not pass through torch's default dtype."""

import pytest
import torch
from numerics import normal

from kcs_torch.data import walking_person
from kcs_torch.functional import orbit
from kcs_torch.methods.clips.size import size_path
from kcs_torch.methods.local_rigidity import triangulation
from kcs_torch.solvers import null_space_upgrade
from kcs_torch.solvers.spectrum import spectrum_floor

CLIP = walking_person(30, turn=90.0)
TRACKS, CAMERAS = CLIP.tracks, orbit(torch.linspace(0, 90, 30, dtype=torch.float64))[:, :2]


@pytest.mark.parametrize(
    "run",
    [
        lambda: null_space_upgrade(normal(12, 2, 4)),
        lambda: triangulation(TRACKS.points, TRACKS.weights, CAMERAS, 4, 0.3)[0],
        lambda: size_path(TRACKS.points, TRACKS.seen, TRACKS.skeleton, 30.0)[0],
        lambda: spectrum_floor(normal(2, 40).square()),
    ],
    ids=["null space", "triangulation", "size", "spectrum"],
)
def test_results_are_the_same(run):
    usual = run()
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        assert torch.equal(run(), usual)
    finally:
        torch.set_default_dtype(before)
