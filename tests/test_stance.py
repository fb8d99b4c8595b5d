"""The stance's energy: values by hand, gradients with degenerate inputs, and what it tells of people."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from numerics import BATCHES, CHAIN, FLOATS, HALVES, finite, gradcheck, leaves_arguments_alone, normal, rotations
from objective_walks import lengths_of, objective, walk
from torch.testing import assert_close

from kcs_torch.data import walking_person
from kcs_torch.errors import OptionError, ShapeError, SkeletonError
from kcs_torch.functional import bone_vectors
from kcs_torch.io import load_motion
from kcs_torch.methods import METHODS
from kcs_torch.methods.pkc.objective import Objective
from kcs_torch.methods.pkc.weights import Weights
from kcs_torch.nn import StanceEnergy
from kcs_torch.skeleton import SKELETONS
from kcs_torch.types import Motion

DATA = Path(__file__).parents[2] / "shared" / "data"
MAN = SKELETONS["h36m17"]
ENERGY = StanceEnergy(MAN)
FEET = list(MAN.contacts)
REST = ENERGY.posture.rest


def standing(aside: float, behind: float, frames: int = 1):
    """The template with its feet moved by shares of their distance from the trunk's middle, (T, 17, 3)."""
    way = REST[FEET].mean(0) - REST[ENERGY.posture.trunk].mean(0)
    far = way.norm() / (ENERGY.line @ bone_vectors(REST, MAN.bone_index())).norm()
    wanted = far * (ENERGY.usual + torch.tensor([aside, behind]).double())
    points = REST.clone()
    points[FEET] += torch.stack([wanted[0] - way[0], 0 * way[1], wanted[1] - way[2]])
    return points.expand(frames, -1, -1)


@pytest.mark.parametrize(
    ("aside", "behind", "strayed"),
    [
        (0.0, 0.0, 0.0),
        (0.0, 0.2, 0.04),
        (0.0, -0.2, 0.15**2 * math.log(1 + 16 / 9)),
        (0.3, 0.0, 0.15**2 * math.log(5)),
        (-0.3, 0.2, 0.04 + 0.15**2 * math.log(5)),
    ],
)
def test_by_hand(aside, behind, strayed):
    """Far behind the trunk costs the square, far in front or aside hardly more than at the fold."""
    points = standing(aside, behind)
    assert_close(ENERGY.strayed(points, 1.0), torch.tensor([strayed]).double(), rtol=1e-6, atol=1e-9)
    assert_close(ENERGY(points, 1.0), torch.tensor(math.log1p(strayed / 0.06**2) / 2).double(), rtol=1e-6, atol=1e-6)
    turned = 300 * points @ rotations(1)[0] + 7  # whatever the place, the direction and the size
    assert_close(ENERGY(turned, 300.0), ENERGY(points, 1.0))
    assert ENERGY(turned).item() == pytest.approx(ENERGY(300 * points).item(), rel=1e-9)


def test_a_mean_over_the_frames():
    points = torch.cat([standing(0.0, 0.1), standing(0.0, -0.3)])
    each = ENERGY.strayed(points, 1.0)
    assert_close(ENERGY(points, 1.0), torch.log1p(each.mean() / 0.06**2) / 2)
    assert_close(ENERGY(points, 1.0, torch.tensor([0.0, 2.0])), ENERGY(points[1:], 1.0))
    size = torch.tensor([1.0, 2.0]).double()
    two = torch.stack([points, 2 * points])
    assert_close(ENERGY(two, size), ENERGY(points, 1.0).expand(2))


def test_size_comes_from_the_bones_that_are_seen():
    points = standing(0.05, 0.1, 4)
    weights = torch.ones(4, 17).double()
    weights[:, MAN.index("left_wrist")] = 0
    seen = torch.where(weights[..., None] > 0, points, torch.nan)
    bones = [b for b, bone in enumerate(MAN.bones) if MAN.index("left_wrist") not in bone]
    own = bone_vectors(points[0], MAN.bone_index()).norm(dim=-1)[bones]
    size = own.sum() / ENERGY.posture.rest_lengths[bones].sum()
    assert_close(ENERGY(seen, None, weights), ENERGY(points, size))


@pytest.mark.parametrize("kind", ["any", "one frame", "zero", "batch"])
@pytest.mark.parametrize("size", [None, 1.3])
def test_gradients(kind, size):
    points = normal(*(2,) * (kind == "batch"), 1 if kind == "one frame" else 4, 17, 3)
    if kind == "zero":
        finite(lambda x: ENERGY(x, size), 0 * points)
        return
    assert gradcheck(lambda x: ENERGY(x, size), points, fast=True)


@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("dtype", FLOATS + HALVES)
def test_shapes_and_dtypes(batch, dtype):
    points = normal(*batch, 6, 17, 3, dtype=dtype)
    value = leaves_arguments_alone(StanceEnergy("h36m17"), points)
    assert value.shape == batch and value.dtype == dtype and value.isfinite().all()
    assert ENERGY(normal(*batch, 0, 17, 3)).shape == batch


def test_what_stands_on_nothing_costs_nothing():
    assert not StanceEnergy("hand21")(normal(5, 21, 3)).any()
    assert StanceEnergy("hand21").feet == []
    with pytest.raises(SkeletonError, match="no trunk"):
        StanceEnergy(CHAIN)


def test_wrong_calls():
    for name in ("sway", "fold"):
        for value in (0.0, -1.0, math.nan):
            with pytest.raises(OptionError, match=rf"StanceEnergy: {name}: expected a positive number"):
                StanceEnergy(MAN, **{name: value})
    with pytest.raises(ShapeError, match=r"StanceEnergy: expected points \(\.\.\., T, N, 3\)"):
        ENERGY(normal(4, 17, 2))
    with pytest.raises(ShapeError, match=r"StanceEnergy: expected weights"):
        ENERGY(normal(4, 17, 3), None, torch.ones(3))
    for size in (np.ones(3), [1.0, 2.0, 3.0]):
        with pytest.raises(ShapeError, match=r"StanceEnergy: expected a tensor of size, got .*use torch\.as_tensor"):
            ENERGY(normal(3, 4, 17, 3), size)
    with pytest.raises(ShapeError, match=r"StanceEnergy: expected size"):
        ENERGY(normal(3, 4, 17, 3), torch.ones(2))
    with pytest.raises(ShapeError, match=r"StanceEnergy: expected sizes \(\) that are the same in all frames"):
        ENERGY(normal(4, 17, 3), torch.ones(4))


@pytest.mark.parametrize("size", [0.0, 1, 1.7, np.float64(1.7)])
def test_a_size_may_be_a_number(size):
    points = normal(3, 4, 17, 3)
    value = ENERGY(points, size)
    assert_close(value, ENERGY(points, torch.full((3,), float(size), dtype=torch.float64)), rtol=1e-12, atol=0)
    finite(lambda x: ENERGY(x, size), points)


def test_leaning_backward_costs_more_than_leaning_forward():
    """Of a walking person whose trunk is turned about the hips."""
    points = walking_person(60).points / 1000
    hips = points[:, [MAN.index("left_hip"), MAN.index("right_hip")]].mean(1, keepdim=True)
    upper = [n for n, name in enumerate(MAN.joints) if not any(part in name for part in ("hip", "knee", "ankle"))]
    across = points[:, MAN.index("left_hip")] - points[:, MAN.index("right_hip")]
    across = across / across.norm(dim=-1, keepdim=True)
    costs = []
    for degrees in (0, 40, -40):  # upright, forward, backward
        angle = torch.tensor(math.radians(degrees))
        off = points[:, upper] - hips
        axis = across[:, None].expand_as(off)
        turned = off * angle.cos() + torch.linalg.cross(axis, off) * angle.sin()
        turned = turned + axis * (axis * off).sum(-1, keepdim=True) * (1 - angle.cos())
        leaning = points.clone()
        leaning[:, upper] = hips + turned
        costs.append(float(ENERGY(leaning)))
    assert costs[0] + 0.5 < costs[1] < costs[2] - 0.2


@pytest.mark.skipif(not DATA.exists(), reason=f"no real motion in {DATA}")
def test_real_people_who_walk_stand_on_their_feet():
    """Their feet stray by about the sway that walking people are taken to have."""
    energy = StanceEnergy("cmu21")
    for name in ("cmu_02_01", "cmu_16_15", "cmu_35_01", "cmu_39_01"):
        motion = load_motion(DATA / "cmu" / f"{name}.npz")
        points = torch.as_tensor(np.asarray(motion.points)) * torch.tensor([1.0, -1.0, -1.0])
        order = [motion.skeleton.index(joint) for joint in energy.skeleton.joints]
        assert 0.05 < energy.strayed(points[:, order]).mean().sqrt() < 0.1


def test_the_objective_holds_it():
    """Its strength is no more than twice what the clip has independent frames; of guessed feet nothing is known."""
    points = walk(120)
    found = objective(points)
    assert found.weights.stance == Weights().stance and objective(walk(12)).weights.stance == 4.0
    depth, lengths = points[None, ..., 2], lengths_of(found, points)[None]
    value = found.terms(depth, lengths)["stance"]
    assert_close(value, 12 * StanceEnergy(MAN)(points[None], 1.0))
    noise = torch.zeros(120, 17).double()
    noise[:, FEET[0]] = 0.1
    hidden = Objective(MAN, points[..., :2], Weights(), noise)
    assert hidden.weights.stance == 0 and not hidden.terms(depth, lengths)["stance"].any()


@pytest.mark.skipif(not DATA.exists(), reason=f"no real motion in {DATA}")
@pytest.mark.parametrize("name", ["cmu_35_02", "cmu_35_05"])
def test_walks_seen_from_the_front_do_not_lean(name):
    """Hardly anything else tells how far the trunk leans in depth: without the term it leans on by 6 degrees."""
    clip = load_motion(DATA / "cmu" / f"{name}.npz")
    upright = clip.points[::4] * torch.tensor([1, -1, -1])
    clip = Motion.from_arrays(upright, skeleton=clip.skeleton, fps=30, units="mm")
    view = {"yaw": 0.0, "pitch": 10.0}
    found = METHODS["pkc"](alternatives=0)(clip.tracks(**view)).points
    low, high = (clip.skeleton.index(joint) for joint in ("pelvis", "thorax"))
    leans = []
    for points in (clip.in_camera(**view), found):
        way = (points[:, high] - points[:, low]).mean(0)
        leans.append(math.degrees(math.atan2(way[2], -way[1])))
    assert abs(leans[0] - leans[1]) < 4


def test_weights_below_zero_count_as_zero():
    points = standing(0.05, 0.1, 4)
    weights = torch.tensor([1.0, 0.0, 1.0, 1.0]).double()
    assert_close(ENERGY(points, None, weights - 1.0 * (weights == 0)), ENERGY(points, None, weights))
