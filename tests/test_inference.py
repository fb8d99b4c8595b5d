"""Inference mode saves time within, and nothing of it is seen outside."""

import dataclasses
from dataclasses import dataclass
from typing import NamedTuple

import pytest
import torch

import kcs_torch as kt
from kcs_torch.data import walking_person
from kcs_torch.functional.inference import differentiating, plain, undifferentiated
from kcs_torch.methods import METHODS
from kcs_torch.methods.base import Estimate
from kcs_torch.solvers import settle_path

CLIP = walking_person(40, turn=60, generator=torch.Generator().manual_seed(0))


class Pair(NamedTuple):
    first: torch.Tensor
    second: object


@dataclass(frozen=True)
class Held:
    value: torch.Tensor
    others: tuple = ()
    name: str = "held"


def tensors(value):
    """All tensors in tuples, lists and dataclasses."""
    if isinstance(value, torch.Tensor):
        return [value]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = [getattr(value, field.name) for field in dataclasses.fields(value)]
    return [x for part in value for x in tensors(part)] if isinstance(value, tuple | list) else []


def test_plain_copies_what_inference_mode_made():
    before = torch.ones(2)
    with torch.inference_mode():
        made = torch.zeros(3) + 1
        value = Held(made, (before, [made, "text"], Pair(made, None)), "some")
    found = plain(value)
    assert all(x.is_inference() for x in (value.value, value.others[1][0])), "the given value changed"
    assert not any(x.is_inference() for x in tensors(found)) and len(tensors(found)) == 4
    assert found.others[0] is before and found.name == "some"
    assert isinstance(found.others[2], Pair) and found.others[2].second is None
    assert torch.equal(found.value, torch.ones(3))
    (found.value * torch.ones(3, requires_grad=True)).sum().backward()  # autograd may keep it


def test_plain_leaves_alone_what_is_plain():
    value = Held(torch.ones(2), (torch.ones(1), 3, None))
    assert plain(value) is value
    assert plain("text") == "text" and plain(None) is None and plain(Held) is Held


def test_plain_keeps_what_is_the_callers():
    with torch.inference_mode():
        own, made = Held(torch.zeros(2) + 1), torch.zeros(1) + 1
        value = Held(made, (own,))
    found = plain(value, keep=own)
    assert found.others[0] is own and not found.value.is_inference()


def test_plain_within_inference_mode_gives_plain_tensors():
    with torch.inference_mode():
        assert not plain(torch.zeros(2)).is_inference()


def test_undifferentiated_runs_in_inference_mode():
    modes = []

    @undifferentiated
    def double(x):
        modes.append(torch.is_inference_mode_enabled())
        return x * 2, "text"

    found, text = double(torch.ones(2, requires_grad=True))
    assert modes == [True] and not found.is_inference() and not found.requires_grad and text == "text"
    with torch.inference_mode():
        assert double(torch.ones(2))[0].is_inference()  # the caller's own affair


def test_differentiating_works_in_inference_mode():
    @differentiating
    def slope(x, *, by):
        with torch.enable_grad():
            leaf = x.detach().requires_grad_()
            return torch.autograd.grad((leaf * by).sum(), leaf)[0]

    by = torch.tensor([1.0, 2.0])
    with torch.inference_mode():
        x, other = torch.zeros(2), by + 0
        assert torch.equal(slope(x, by=other), by)
    assert torch.equal(slope(torch.zeros(2), by=by), by)


def test_a_camera_path_settles_in_inference_mode():
    vectors = (CLIP.points[:, 1:] - CLIP.points[:, :1]) / 1000
    path = kt.functional.complete_rotation(CLIP.cameras)
    expected = settle_path(vectors, path)
    with torch.inference_mode():
        found = settle_path(vectors + 0, path + 0)
    assert torch.allclose(found, expected, atol=1e-9)


@pytest.mark.filterwarnings("ignore::kcs_torch.KcsWarning")
@pytest.mark.parametrize("method", METHODS)
def test_results_are_plain(method):
    found = [kt.reconstruct(CLIP.tracks, method=method), *METHODS[method]().many([CLIP.tracks, CLIP.tracks])]
    assert not any(x.is_inference() for x in tensors(found))


@pytest.mark.filterwarnings("ignore::kcs_torch.KcsWarning")
@pytest.mark.parametrize("lens", ["auto", (900.0, 900.0, 0.0, 0.0)])
def test_results_under_perspective_are_plain(lens):
    points = CLIP.points + torch.tensor([0.0, 0.0, 3500.0], dtype=torch.float64)
    image = 900 * points[..., :2] / points[..., 2:]
    tracks = kt.Tracks.from_arrays(image, skeleton="coco17", units="px", fps=30)
    found = kt.reconstruct(tracks, intrinsics=lens)
    assert found.distance is not None
    assert not any(x.is_inference() for x in tensors(found))


def test_a_method_of_ones_own_may_differentiate():
    class Fitted(kt.Method):
        name = "fitted"

        def solve(self, tracks, cameras):
            with torch.enable_grad():
                depth = torch.zeros(tracks.points.shape[:-1], dtype=torch.float64, requires_grad=True)
                ((depth - 1) * tracks.points[..., 0]).square().sum().backward()
            points = torch.cat([tracks.points, depth.grad[..., None]], -1)
            return Estimate(points, CLIP.cameras, torch.ones(len(points)).double(), True, 1)

    with pytest.warns(kt.KcsWarning, match="lengths of rigid bones vary"):
        found = Fitted()(CLIP.tracks)
    assert bool(found.points[..., 2].any())
