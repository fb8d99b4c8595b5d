"""A body before a fixed camera: walks that are known, what is returned, and clips that tell little."""

import pytest
import torch
from numerics import normal
from samples import walk_in_template_units as walk
from torch.testing import assert_close

from kcs_torch.functional import bone_lengths
from kcs_torch.methods.pkc.fixed_view import fixed_view
from kcs_torch.methods.pkc.hypotheses import Hypotheses, distinct
from kcs_torch.nn import PostureEnergy
from kcs_torch.skeleton import SKELETONS


def solve(points, skeleton="h36m17", noise=0.0, **options):
    body = SKELETONS[skeleton]
    noise = torch.full_like(points[..., 0], noise)
    return fixed_view(body, points[..., :2], noise=noise, **{"rounds": 1, "steps": 12, **options})


def error(depth, points):
    """Root mean square over that of a flat guess."""
    return float((depth - points[..., 2]).square().mean().sqrt() / points[..., 2].square().mean().sqrt())


@pytest.fixture(scope="module")
def found():
    points = walk()
    return points, solve(points)


def test_what_is_returned(found):
    points, hypotheses = found
    count = len(hypotheses.energy)
    assert count > 3 and hypotheses.depth.shape == (count, 40, 17) and hypotheses.lengths.shape == (count, 16)
    assert (hypotheses.energy.diff() >= 0).all() and torch.isfinite(hypotheses.energy).all()
    assert hypotheses.depth.mean(-1).abs().max() < 0.02  # the energy's weight keeps them centred
    size = bone_lengths(
        torch.cat([points[..., :2], hypotheses.depth[0, ..., None]], -1), SKELETONS["h36m17"].bone_index()
    )
    assert_close(size, hypotheses.lengths[0].expand_as(size), rtol=0, atol=0.05)
    assert (size / size.mean(0)).std(0).median() < 0.02
    assert hypotheses.steps >= 12
    part = hypotheses[1:3]
    assert isinstance(part, Hypotheses) and torch.equal(part.energy, hypotheses.energy[1:3])
    assert torch.equal(part.depth, hypotheses.depth[1:3]) and part.steps == hypotheses.steps


@pytest.mark.parametrize("yaw", [0.0, 45.0, 160.0])
def test_walks_before_a_fixed_camera(yaw):
    points = walk(60, yaw=yaw)
    assert error(solve(points).depth[0], points) < 0.2


def test_the_right_side_of_the_mirror_is_chosen(found):
    points, hypotheses = found
    best = hypotheses.depth[0]
    assert error(best, points) < 0.1
    assert error(-best, points) > 1.2


def test_same_numbers_again_and_shifts_do_not_matter(found):
    points, hypotheses = found
    again = solve(points)
    assert torch.equal(again.depth, hypotheses.depth) and torch.equal(again.energy, hypotheses.energy)
    moved = points + torch.linspace(0, 3, 40)[:, None, None]
    assert_close(solve(moved).depth[0], hypotheses.depth[0], rtol=0, atol=1e-3)


def test_left_and_right_swapped_in_a_mirror(found):
    """Seen in a mirror on the wall, a person of swapped sides does the same in depth."""
    points, hypotheses = found
    swap = list(range(17))
    for a, b in SKELETONS["h36m17"].mirror:
        swap[a], swap[b] = b, a
    other = solve(points[:, swap] * torch.tensor([-1.0, 1.0, 1.0]))
    assert_close(other.depth[0][:, swap], hypotheses.depth[0], rtol=0, atol=0.05)


@pytest.mark.parametrize("factor", [1.0, 1.1, 1.2])
def test_known_lengths_are_kept(found, factor):
    """Within a percent or so each, even where they contradict the image; free lengths follow the image."""
    points, free = found
    lengths = factor * bone_lengths(points, SKELETONS["h36m17"].bone_index()).mean(0)
    off = lambda hypotheses: (hypotheses.lengths[0] / lengths).log().abs()  # noqa: E731
    anchored = off(solve(points, anchor=lengths))
    assert anchored.mean() < 0.02 and anchored.max() < 0.07
    assert factor == 1 or off(free).mean() > 0.08


def test_more_rounds_are_never_worse():
    points = walk(30, yaw=20.0)
    energies = [float(solve(points, rounds=r).energy[0]) for r in (0, 1, 2)]
    assert energies[0] >= energies[1] >= energies[2]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("frames", [1, 2, 3, 13])
def test_few_frames(frames, dtype):
    points = walk(frames, dtype=dtype)
    found = solve(points, steps=4, rounds=1)
    assert found.depth.dtype == dtype and found.depth.shape[1:] == (frames, 17)
    assert torch.isfinite(found.depth).all() and torch.isfinite(found.lengths).all()
    assert found.depth[0].abs().max() > 0.02  # not flat


@pytest.mark.parametrize("kind", ["static", "one point", "on a line", "huge"])
def test_clips_that_tell_little(kind):
    points = {
        "static": lambda: walk(1).expand(8, -1, -1),
        "one point": lambda: torch.zeros(8, 17, 3).double(),
        "on a line": lambda: walk(8) * torch.tensor([0.0, 1.0, 1.0]),
        "huge": lambda: 4 * walk(8),
    }[kind]()
    found = solve(points, steps=4, rounds=1)
    assert torch.isfinite(found.depth).all() and torch.isfinite(found.lengths).all()
    assert (found.lengths > 0).all()
    if kind == "static":
        assert (found.depth[0] - found.depth[0, :1]).abs().max() < 0.02


@pytest.mark.parametrize("skeleton", ["coco17", "mediapipe33", "cmu17"])
def test_any_skeleton_of_a_person(skeleton):
    points = walk(12, skeleton=skeleton)
    assert error(solve(points, skeleton, steps=8).depth[0], points) < 0.15


@pytest.mark.parametrize("skeleton", ["coco17", "hand21", "ap10k"])
def test_a_template_that_turns_is_found_again(skeleton):
    rest = PostureEnergy(skeleton).rest
    angle = torch.linspace(0.6, 1.0, 6).double()
    zero, one = torch.zeros(6).double(), torch.ones(6).double()
    turn = torch.stack([angle.cos(), zero, angle.sin(), zero, one, zero, -angle.sin(), zero, angle.cos()], -1)
    points = rest @ turn.view(6, 3, 3).mT
    points = points - points.mean(1, keepdim=True)
    # Where a quadruped's descent ends; its first steps are nearer, as the prior's mean is no template's own pose.
    assert error(solve(points, skeleton, steps=40).depth[0], points) < 0.35


# ---------------------------------------------------------------------- several hypotheses

BENT = torch.tensor([[-0.9, -0.3, 0.3, 0.9]]).repeat(5, 1).double()  # a chain of three bones that points away


def hypotheses(depths, energy, steps=0):
    lengths = torch.arange(3 * len(depths)).view(-1, 3).double()
    return Hypotheses(torch.stack(depths), lengths, torch.tensor(energy).double(), steps)


@pytest.mark.parametrize("apart", [0.02, 0.04])
def test_equal_solutions_are_told_once(apart):
    near = 0.9 * apart
    shapes = [BENT, BENT + near, -BENT, -BENT + 0.1 * near * normal(5, 4), 2 * BENT]
    found = hypotheses(shapes, [1.0, 2.0, 3.0, 4.0, 5.0])
    assert distinct(found, 5, apart).energy.tolist() == [1, 3, 5]
    assert distinct(found, 2, apart).energy.tolist() == [1, 3]
    assert distinct(found, 1, apart).energy.tolist() == [1]
    assert distinct(found, 5, 0.8 * apart).energy.tolist() == [1, 2, 3, 5]
    kept = distinct(found, 5, apart)
    assert torch.equal(kept.depth, torch.stack([BENT, -BENT, 2 * BENT])) and kept.lengths[:, 0].tolist() == [0, 6, 12]


def test_solutions_that_failed_are_left_out():
    found = hypotheses([BENT, -BENT, 2 * BENT], [1.0, torch.nan, torch.inf])
    assert distinct(found, 3, 0.02).energy.tolist() == [1]
    lost = hypotheses([BENT, -BENT], [torch.nan, torch.nan])
    assert len(distinct(lost, 3, 0.02).energy) == 1  # something has to be returned


def test_joined_hypotheses_are_sorted():
    one, other = (
        hypotheses([BENT, 2 * BENT], [1.0, 4.0], 7),
        hypotheses([-BENT, 3 * BENT, 0 * BENT], [-2.0, 3.0, 9.0], 5),
    )
    both = one.joined(other)
    assert both.energy.tolist() == [-2, 1, 3, 4, 9] and both.steps == 12
    assert torch.equal(both.depth, torch.stack([-BENT, BENT, 3 * BENT, 2 * BENT, 0 * BENT]))
    assert both.lengths[:, 0].tolist() == [0, 0, 3, 3, 6]
    assert torch.equal(other.joined(one).depth, both.depth)
