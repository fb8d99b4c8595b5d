"""Systems of bones that meet: elimination against a dense solve."""

import pytest
import torch
from numerics import BODY, CHAIN, RING, normal
from torch.testing import assert_close

from kcs_torch.functional import coupled
from kcs_torch.functional.chain import incidence, kcs_matrix
from kcs_torch.functional.coupled import solve_coupled
from kcs_torch.skeleton import SKELETONS

FRAMES = 300
STAR = torch.tensor([(0, i) for i in range(1, 9)])
LOOSE = torch.tensor([(0, 1), (2, 3)])  # two pieces
BODIES = {
    "tree": BODY.bone_index(), "ring": RING.bone_index(), "chain": CHAIN.bone_index(), "star": STAR, "loose": LOOSE,
    "one": torch.tensor([(1, 0)]), "none": torch.zeros(0, 2, dtype=torch.long),
    "hand": SKELETONS["hand21"].bone_index(),
}  # fmt: skip


def overlap_of(bones):
    ends = incidence(bones, int(bones.max()) + 1 if len(bones) else 1, dtype=torch.float64)
    return ends.mT @ ends


def order_of(bones):
    return coupled._order(tuple(map(tuple, bones.tolist())))


@pytest.fixture
def eliminates(monkeypatch):
    """How often the elimination was taken."""
    taken = []
    usual = coupled._eliminated
    monkeypatch.setattr(coupled, "_eliminated", lambda *given: taken.append(1) or usual(*given))
    return taken


@pytest.mark.parametrize("share", [1.0, 0.3, 0.0])
@pytest.mark.parametrize("body", [body for body in BODIES if body != "none"])
def test_elimination_is_the_dense_solution(body, share):
    bones = BODIES[body]
    overlap = share * overlap_of(bones)
    vectors, right = normal(2, FRAMES, len(bones), 3), normal(2, FRAMES, len(bones), seed=1)
    vectors[0, 3] = 0
    vectors[1, 5] *= 1e3  # stiff
    got = coupled._eliminated(vectors, right, order_of(bones), overlap)
    matrix = torch.eye(len(bones), dtype=torch.float64) + overlap * kcs_matrix(vectors)
    assert_close(got, torch.linalg.solve(matrix, right[..., None])[..., 0], rtol=1e-7, atol=1e-9)
    assert_close(solve_coupled(vectors, right, bones, overlap), got, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("body", [body for body in BODIES if body not in ("star", "ring")])
def test_a_tree_stays_as_sparse_as_it_is(body):
    bones = BODIES[body]
    order = order_of(bones)
    assert order.slots == len(order.first) == int(overlap_of(bones).triu(1).ne(0).sum())
    assert sorted(step.bone for step in order.steps) == list(range(len(bones)))


def test_few_frames_many_cycles_and_derivatives_are_dense(eliminates):
    bones = BODIES["hand"]
    overlap = overlap_of(bones)
    vectors, right = normal(FRAMES, len(bones), 3), normal(FRAMES, len(bones), seed=1)
    whole = solve_coupled(vectors, right, bones, overlap)
    assert len(eliminates) == 1
    assert_close(solve_coupled(vectors[:20], right[:20], bones, overlap), whole[:20])
    leaf = vectors.clone().requires_grad_()
    assert_close(solve_coupled(leaf, right, bones, overlap).detach(), whole)
    solve_coupled(vectors[:, :8], right[:, :8], STAR, overlap_of(STAR))  # every bone meets every other
    assert solve_coupled(vectors[:, :0], right[:, :0], BODIES["none"], overlap_of(BODIES["none"])).shape == (FRAMES, 0)
    assert len(eliminates) == 1


def test_what_is_not_finite_spoils_its_own_frame_only(eliminates):
    bones = BODIES["hand"]
    vectors, right = normal(FRAMES, len(bones), 3), normal(FRAMES, len(bones), seed=1)
    vectors[7, 2, 1] = torch.nan
    got = solve_coupled(vectors, right, bones, overlap_of(bones))
    assert eliminates and got[7].isnan().any()
    assert got[torch.arange(FRAMES) != 7].isfinite().all()


def test_right_sides_may_be_more_than_systems(eliminates):
    bones = BODIES["hand"]
    vectors, right = normal(FRAMES, len(bones), 3), normal(4, FRAMES, len(bones), seed=1)
    got = solve_coupled(vectors, right, bones, overlap_of(bones))
    alone = [solve_coupled(vectors, one, bones, overlap_of(bones)) for one in right]
    assert eliminates and torch.equal(got, torch.stack(alone))


def test_vmap_is_a_loop(eliminates):
    """Over frames' values bones are read as ever; over several bodies' bones the solution is dense."""
    bones, others = BODIES["hand"], BODIES["hand"].roll(3, 0)
    vectors, right = normal(2, FRAMES, len(bones), 3), normal(2, FRAMES, len(bones), seed=1)
    alone = [solve_coupled(v, r, bones, overlap_of(bones)) for v, r in zip(vectors, right, strict=True)]
    got = torch.func.vmap(lambda v, r: solve_coupled(v, r, bones, overlap_of(bones)))(vectors, right)
    assert_close(got, torch.stack(alone))
    assert len(eliminates) == 3
    alone[1] = solve_coupled(vectors[1], right[1], others, overlap_of(others))
    overlaps = torch.stack([overlap_of(bones), overlap_of(others)])
    assert_close(
        torch.func.vmap(solve_coupled)(vectors, right, torch.stack([bones, others]), overlaps), torch.stack(alone)
    )
    assert len(eliminates) == 4


def test_the_order_does_not_take_the_default_device_of_its_first_call():
    coupled._order.cache_clear()
    try:
        with torch.device("meta"):
            order = order_of(BODIES["tree"])
        assert order.first.device.type == order.second.device.type == "cpu"
    finally:
        coupled._order.cache_clear()
