"""Signs of depth by second-order Viterbi: against trying every path, and on motions whose signs are known."""

import itertools

import pytest
import torch
from numerics import FLOATS, leaves_arguments_alone, normal
from torch.testing import assert_close

from kcs_torch.errors import ShapeError
from kcs_torch.solvers import sign_costs, sign_table, smooth_signs

SIZES = [(4, 2, 1), (5, 1, 2), (3, 2, 2), (2, 2, 1), (2, 1, 2), (1, 2, 1), (1, 1, 2), (3, 3, 1), (6, 1, 1)]  # T, C, M


def problem(frames, poses, bones, batch=2, seed=0):
    size = (batch, frames, poses, 2**bones)
    unary = 3 * normal(*size, seed=seed).abs()
    depths = 1.5 * normal(batch, frames, bones, seed=seed + 1).abs()
    return unary, depths, normal(batch, max(frames - 1, 0), poses, poses, seed=seed + 2).abs()


def every_path(unary, depths, cap, transition):
    """Cost of every path of one problem: (cost, poses, states)."""
    frames, poses, states = unary.shape
    table = sign_table(depths.shape[-1], depths)
    for path in itertools.product(range(poses * states), repeat=frames):
        pose, state = [p // states for p in path], [p % states for p in path]
        cost = sum(float(unary[t, pose[t], state[t]]) for t in range(frames))
        cost += sum(float(transition[t, pose[t], pose[t + 1]]) for t in range(frames - 1))
        if frames > 2:
            signed = table[state] * depths
            cost += 0.5 * float((signed[2:] - 2 * signed[1:-1] + signed[:-2]).square().clamp_max(cap).sum())
        yield cost, pose, state


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("cap", [0.5, 4.0])
def test_cheapest_of_all_paths(size, cap):
    unary, depths, transition = problem(*size)
    found = smooth_signs(unary, depths, cap=cap, transition=transition, margins=True)
    table = sign_table(size[2], depths)
    for k in range(2):
        paths = list(every_path(unary[k], depths[k], cap, transition[k]))
        cost, pose, state = min(paths)
        assert found.cost[k].item() == pytest.approx(cost, abs=1e-9)
        assert sign_costs(unary, depths, cap=cap, transition=transition)[k].item() == pytest.approx(cost, abs=1e-9)
        assert found.poses[k].tolist() == pose
        assert torch.equal(found.signs[k], table[state])
        through = torch.full_like(unary[k], torch.inf)
        for value, poses, states in paths:
            for t, (c, s) in enumerate(zip(poses, states, strict=True)):
                through[t, c, s] = min(through[t, c, s].item(), value)
        assert_close(found.margins[k], through - cost, rtol=0, atol=1e-9)


def test_table_holds_every_combination_once():
    like = torch.zeros(1).double()
    for count in range(4):
        table = sign_table(count, like)
        assert table.shape == (2**count, count) and table.dtype == torch.float64
        assert len({tuple(row) for row in table.tolist()}) == 2**count
        assert (table.abs() == 1).all() and (table[0] == 1).all()
    assert sign_table(2, like).tolist() == [[1, 1], [1, -1], [-1, 1], [-1, -1]]


def test_a_swinging_bone_is_followed_through_the_image_plane():
    """One hint in one frame settles a path of many crossings."""
    time = torch.linspace(0, 20, 150, dtype=torch.float64)
    swing = torch.stack([time.sin(), (0.7 * time + 1).sin()], -1)  # (T, M)
    unary = torch.zeros(1, 150, 1, 4, dtype=torch.float64)
    table = sign_table(2, swing)
    unary[0, 75] = 1 - (table == swing[75].sign()).all(-1).double()
    found = smooth_signs(unary, swing[None].abs() / 0.02, cap=18.0)
    clear = swing.abs() > 0.05
    assert torch.equal(found.signs[0][clear], swing.sign()[clear])
    mirrored = smooth_signs(unary.flip(-1), swing[None].abs() / 0.02, cap=18.0)
    assert torch.equal(mirrored.signs[0][clear], -swing.sign()[clear])


def test_margins_are_zero_along_the_path_and_nowhere_negative():
    unary, depths, transition = problem(30, 2, 2, batch=3)
    found = smooth_signs(unary, depths, cap=4.0, transition=transition, margins=True)
    assert found.margins.min() > -1e-9
    state = ((1 - found.signs) / 2 @ torch.tensor([2.0, 1.0]).double()).long()
    own = found.margins.flatten(2).gather(2, (found.poses * 4 + state)[..., None])
    assert_close(own, torch.zeros_like(own), rtol=0, atol=1e-9)
    plain = smooth_signs(unary, depths, cap=4.0, transition=transition)
    assert plain.margins is None and torch.equal(plain.signs, found.signs) and torch.equal(plain.poses, found.poses)


def test_problems_do_not_see_each_other():
    unary, depths, transition = problem(12, 2, 2, batch=4)
    together = smooth_signs(unary, depths, cap=4.0, transition=transition)
    for k in range(4):
        one = smooth_signs(unary[k : k + 1], depths[k : k + 1], cap=4.0, transition=transition[k])  # (T - 1, C, C)
        assert_close(one.cost, together.cost[k : k + 1])
        assert torch.equal(one.signs[0], together.signs[k]) and torch.equal(one.poses[0], together.poses[k])


def test_without_transitions_poses_follow_each_other_freely():
    unary, depths, _ = problem(6, 3, 1)
    free = smooth_signs(unary, depths, cap=4.0)
    zero = smooth_signs(unary, depths, cap=4.0, transition=torch.zeros(5, 3, 3).double())
    assert torch.equal(free.cost, zero.cost) and torch.equal(free.signs, zero.signs)


def test_flat_bones_go_where_the_costs_say():
    unary, _, _ = problem(8, 1, 2)
    found = smooth_signs(unary, torch.zeros(2, 8, 2).double(), cap=4.0)
    assert torch.equal(found.signs, sign_table(2, unary)[unary[:, :, 0].argmin(-1)])
    assert_close(found.cost, unary.amin((-1, -2)).sum(-1))


@pytest.mark.parametrize("dtype", FLOATS)
def test_follows_dtype_and_leaves_arguments_alone(dtype):
    unary, depths, _ = (x.to(dtype) for x in problem(5, 2, 2))
    found = leaves_arguments_alone(lambda u, d: smooth_signs(u, d, cap=4.0, margins=True), unary, depths)
    assert found.cost.dtype == found.signs.dtype == found.margins.dtype == dtype
    assert found.signs.shape == (2, 5, 2) and found.poses.shape == (2, 5) and found.margins.shape == unary.shape


def test_shapes_that_do_not_fit():
    for depths in (torch.ones(2, 5, 1), torch.ones(2, 4, 2), torch.ones(1, 5, 2)):
        for function in (smooth_signs, sign_costs):
            with pytest.raises(ShapeError, match="smooth_signs: expected"):
                function(torch.ones(2, 5, 1, 4), depths, cap=1.0)
            with pytest.raises(ShapeError, match="smooth_signs: expected"):
                function(torch.ones(5, 4), depths, cap=1.0)
    for function in (smooth_signs, sign_costs):
        with pytest.raises(ShapeError, match="of a frame or more, got"):
            function(torch.ones(2, 0, 1, 4), torch.ones(2, 0, 2), cap=1.0)
        for shape in ((3, 2, 2), (4, 1, 1), (3, 4, 2, 2), (2, 5, 2, 2)):
            with pytest.raises(ShapeError, match=r"transition: expected shape \(4, 2, 2\), or \(2, 4, 2, 2\), got"):
                function(torch.ones(2, 5, 2, 4), torch.ones(2, 5, 2), cap=1.0, transition=torch.zeros(shape))
