"""Skeletons: construction, checks, files, trees, changes."""

import json
import math
import pickle

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from kcs_torch.errors import ShapeError, SkeletonError
from kcs_torch.skeleton import SKELETONS, Hinge, Skeleton, get_skeleton

KNEE = {"joint": "left_knee", "bends": "backward"}
ARM = Skeleton.from_names(["shoulder", "elbow", "wrist"], [("shoulder", "elbow"), ("elbow", "wrist")], name="arm")


def leg(*, names=("left_hip", "right_hip", "left_knee", "left_ankle", "left_heel"), **options):
    """A leg, its hips and its heel."""
    bones = [(names[0], names[1]), (names[0], names[2]), (names[2], names[3]), (names[3], names[4])]
    return Skeleton.from_names(names, bones, **options)


# As published by each detector or data set, sides as l and r.


# ---------------------------------------------------------------- construction and checks


def test_from_names():
    body = Skeleton.from_names(
        ["LHip", "RHip", "Neck"],
        [("Mid", "LHip"), ("Mid", "RHip"), ("Mid", "Neck")],
        virtual={"Mid": ["LHip", "RHip"]},
        flexible=[("Neck", "Mid")],
        proportions={"Mid-LHip": 1, "Mid-RHip": 1, "Mid-Neck": 4},
        template={"LHip": (1, 0, 0), "RHip": (-1, 0, 0), "Neck": (0, -4, 0)},
    )
    assert body.joints == ("LHip", "RHip", "Neck", "Mid")
    assert body.num_observed == 3 and body.virtual == ((3, (0, 1)),)
    assert body.mirror == ((0, 1),) and body.mirror_bones == ((0, 1),)
    assert body.flexible == (2,) and body.rigid == (0, 1)
    assert body.rigid_mask().tolist() == [True, True, False]
    assert torch.equal(body.rigid_mask(dtype=torch.float64), torch.tensor([1.0, 1.0, 0.0]).double())
    assert [body.side(i) for i in range(4)] == ["left", "right", "centre", "centre"]
    assert body.template_points(dtype=torch.float64)[3].tolist() == [0, 0, 0]
    assert body.relative_lengths().tolist() == [0.5, 0.5, 2.0]
    assert body.bone_index().tolist() == [[3, 0], [3, 1], [3, 2]]


def test_from_edges_finds_what_names_tell():
    body = Skeleton.from_edges([[0, 1], [1, 2]], ["left_hip", "left_knee", "left_ankle"])
    assert body.template is not None
    assert Skeleton.from_edges([[0, 1]], ["tail1", "tail2"]).template is None
    assert Skeleton.from_edges([[0, 1]], 2).joints == ("joint0", "joint1")
    assert Skeleton.from_edges([[0, 1]], np.int64(2)).joints == ("joint0", "joint1")
    hand = SKELETONS["hand21"]
    assert Skeleton.from_edges(hand.bones, hand.joints).template == hand.template
    # names of a built-in skeleton take its template, also where the names alone would say otherwise
    cmu = SKELETONS["cmu17"]
    assert Skeleton.from_edges(cmu.bones, cmu.joints).template == cmu.template
    # two names for one place: no template rather than a bone without length
    assert Skeleton.from_edges([[0, 1]], ["left_toe", "left_ball"]).template is None


def test_from_edges_takes_what_the_built_in_skeleton_of_that_name_says():
    for body in SKELETONS.values():
        names = body.joints[: body.num_observed]
        bones = [b for b in body.bones if max(b) < body.num_observed]
        other = Skeleton.from_edges(bones, names, tree=False)
        assert (other.hinges, other.contacts) == (body.hinges, body.contacts)
        told = dict(zip(body.bones, body.spread, strict=True))
        assert other.spread == tuple(told[b] for b in bones)
    # a hinge needs its bones
    coco = SKELETONS["coco17"]
    few = Skeleton.from_edges([[11, 12], [11, 13], [13, 15]], coco.joints[:17], tree=False)
    assert [coco.joints[h.joint] for h in few.hinges] == ["left_knee"]
    assert few.spread == (12, 30, 35)
    assert Skeleton.from_edges([[0, 1]], ["tail1", "tail2"]).spread is None


def test_hinges():
    expected = Hinge(parent=0, joint=2, child=3, left=0, right=1, sign=1.0, firm=1.0)
    assert leg().hinges == leg(hinges=[KNEE]).hinges == (expected,)
    assert leg(hinges=[]).hinges == ()
    told = KNEE | {"axis": ["right_hip", "left_hip"], "weight": 0.5, "bends": "forward", "child": None}
    assert leg(hinges=[told]).hinges == (Hinge(0, 2, 3, left=1, right=0, sign=-1.0, firm=0.5),)
    numbers = {"mirror": [(1, 2)], "bones": [(1, 2), (1, 3), (3, 4)]}  # as YAML reads names
    assert Skeleton.from_names([1, 2, 3, 4], hinges=[KNEE | {"joint": 3}], **numbers).hinges == (expected,)
    # the ends may be given, also against the direction of the bones
    bend = {"joint": "b", "bends": "backward", "parent": "a", "child": "c", "axis": ["a", "d"]}
    turned = Skeleton.from_names("abcd", [("b", "a"), ("c", "b"), ("c", "d")], hinges=[bend])
    assert turned.hinges == (Hinge(0, 1, 2, left=0, right=3, sign=1.0),)


def test_contacts_and_spread():
    assert leg().contacts == (4,) and leg(contacts=["left_ankle", "left_heel"]).contacts == (3, 4)
    assert leg(contacts=[]).contacts == ()
    assert leg().spread is None and leg(template="human").spread == (12, 30, 35, 35)
    assert leg(template="human", spread={}).spread is None
    degrees = dict(zip(leg().bone_names, (1, 2, 3, 4), strict=True))
    assert leg(spread=degrees).spread == (1, 2, 3, 4)


def test_lists_become_tuples():
    body = Skeleton(("a", "b"), ((0, 1),), hinges=[], contacts=[1], spread=[30])
    assert hash(body) == hash(Skeleton(("a", "b"), ((0, 1),), contacts=(1,), spread=(30.0,)))
    body = Skeleton(joints=["a", "b"], bones=[[0, 1]], template=[[0, 0, 0], [0, 1, 0]])
    assert hash(body) == hash(Skeleton(("a", "b"), ((0, 1),), template=((0.0, 0.0, 0.0), (0.0, 1.0, 0.0))))
    assert pickle.loads(pickle.dumps(body)) == body


def test_a_cycle_is_named():
    with pytest.raises(SkeletonError, match="closed chain") as error:
        Skeleton.from_names(["a", "b", "c", "d"], [("a", "b"), ("b", "c"), ("c", "a"), ("c", "d")], name="ring")
    message = str(error.value)
    assert "'ring'" in message and "tree=False" in message
    chain = message.split("closed chain ")[1].split(".")[0].split(" - ")
    assert set(chain) == {"a", "b", "c"} and chain[0] == chain[-1]


def test_loose_joints_are_named():
    with pytest.raises(SkeletonError, match=r"3 pieces.*: d, e, f"):
        Skeleton.from_names(["a", "b", "c", "d", "e", "f"], [("a", "b"), ("b", "c"), ("d", "e")])


def test_graphs_are_admitted_when_asked_for():
    body = Skeleton.from_names(["a", "b", "c", "d"], [("a", "b"), ("b", "c"), ("c", "a")], tree=False)
    assert not body.is_tree and body.pieces() == [[0, 1, 2], [3]] and sorted(body.cycle()) == [0, 1, 2]
    with pytest.raises(SkeletonError, match="closed chain"):
        body.validate()
    assert ARM.is_tree and ARM.cycle() is None


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Skeleton(("a", "b", "a"), ((0, 1), (1, 2))), "given twice: a"),
        (lambda: Skeleton(("a",), ()), "at least 2 joints, got 1"),
        (lambda: Skeleton((), ()), "at least 2 joints, got 0"),
        (lambda: Skeleton(("a", "b"), ((0, 2),)), r"bone \(0, 2\): expected joint indices 0..1"),
        (lambda: Skeleton(("a", "b"), ((-1, 0),)), "expected joint indices 0..1"),
        (lambda: Skeleton(("a", "b"), ((0, 0),)), "joins a joint to itself"),
        (lambda: Skeleton(("a", "b"), ((0, 1), (1, 0))), "is given twice"),
        (lambda: Skeleton(("a", "b"), ((0, 1),), mirror=((0, 5),)), "mirror"),
        (lambda: Skeleton(("a", "b"), ((0, 1),), flexible=(1,)), "flexible 1"),
        (lambda: Skeleton(("a", "b"), ((0, 1),), template=((0, 0, 0),)), "expected 2 positions, got 1"),
        (lambda: Skeleton(("a", "b"), ((0, 1),), template=((0, 0, 0), (0, math.nan, 0))), "'b': expected 3 finite"),
        (lambda: Skeleton(("a", "b"), ((0, 1),), template=((0, 0, 0), (0, 1))), "'b': expected 3 finite"),
        (lambda: Skeleton(("a", "b"), ((0, 1),), proportions=(1.0, 2.0)), "expected 1 lengths, got 2"),
        (lambda: Skeleton(("a", "b"), ((0, 1),), proportions=(0.0,)), "bone a-b: expected a positive number"),
        (lambda: Skeleton(("v", "a", "b"), ((0, 1), (1, 2)), virtual=((0, (1, 2)),)), "must follow the observed"),
        (lambda: Skeleton(("a", "b"), ((0, 1),), virtual=((1, ()),)), "needs sources"),
        (lambda: Skeleton.from_names(["a", "elbow"], [("a", "elbo")]), "did you mean 'elbow'"),
        (lambda: Skeleton.from_names(["a", "b", "b"], [("a", "b"), ("b", "tail")]), "given twice: b"),
        (lambda: Skeleton.from_names(["a", "b"], ["ab"]), "expected pairs of joint names"),
        (lambda: Skeleton.from_names(["a", "b"], [("a", "b")], template={"a": (0, 0, 0)}), "none for b"),
        (lambda: Skeleton.from_names(["a", "b"], [("a", "b")], template={"c": (0, 0, 0)}), "unknown name in template"),
        (lambda: Skeleton.from_names(["a", "b"], [("a", "b")], template="human"), "'a', 'b'"),
        (lambda: Skeleton.from_names(["a", "b"], [("a", "b")], proportions={}), "none for a-b"),
        (lambda: Skeleton.from_names(["a", "b"], [("a", "b")], proportions={"b-a": 1}), "choices are a-b"),
        (lambda: Skeleton.from_names(["a", "b"], [("a", "b")], virtual={"c": ["a", "x"]}), "unknown joint in virtual"),
        (
            lambda: Skeleton.from_names(["a", "b", "c"], [("a", "b"), ("b", "c")], flexible=[("a", "c")]),
            "expected bones",
        ),
        (lambda: Skeleton("abc", ((0, 1), (1, 2)), hinges=[Hinge(0, 1, 3, 0, 2, 1.0)]), "joint indices in 0..2"),
        (lambda: Skeleton("abc", ((0, 1), (1, 2)), hinges=[Hinge(0, 1, 2, 1, 1, 1.0)]), "left and right different"),
        (lambda: Skeleton("abc", ((0, 1), (1, 2)), hinges=[Hinge(1, 0, 2, 1, 2, 1.0)]), "Add the bone a-c"),
        (lambda: Skeleton("abc", ((0, 1), (1, 2)), hinges=[Hinge(0, 1, 0, 0, 2, 1.0)]), "the joint between two bones"),
        (
            lambda: Skeleton("abc", ((0, 1), (1, 2)), hinges=[Hinge(0, 1, 2, 0, 2, 2.0)]),
            "hinge at 'b': sign: expected 1",
        ),
        (lambda: Skeleton("abc", ((0, 1), (1, 2)), hinges=[Hinge(0, 1, 2, 0, 2, 1.0, 1.5)]), "within 0..1, got 1.5"),
        (lambda: Skeleton("abc", ((0, 1), (1, 2)), hinges=[Hinge(0, 1, 2, 0, 2, 1.0, math.nan)]), "within 0..1"),
        (lambda: Skeleton("ab", ((0, 1),), contacts=(2,)), "contact 2: expected joint indices 0..1"),
        (lambda: Skeleton("ab", ((0, 1),), contacts=(1, 1)), "contact 'b' is given twice"),
        (lambda: Skeleton("ab", ((0, 1),), spread=(1, 2)), "spread: expected 1 angles, got 2"),
        (lambda: Skeleton("ab", ((0, 1),), spread=(0,)), "bone a-b: expected degrees above 0"),
        (lambda: Skeleton("ab", ((0, 1),), spread=(math.nan,)), "bone a-b: expected degrees above 0"),
        (lambda: leg(hinges=["left_knee"]), "expected mappings such as {joint: left_knee, bends: backward}"),
        (lambda: leg(hinges=[{"joint": "left_knee"}]), "'joint' and 'bends: backward or forward'"),
        (lambda: leg(hinges=[KNEE | {"bends": "up"}]), "'joint' and 'bends: backward or forward'"),
        (lambda: leg(hinges=[KNEE | {"weigth": 1}]), "did you mean 'weight'"),
        (lambda: leg(hinges=[KNEE | {"joint": "left_kne"}]), "did you mean 'left_knee'"),
        (lambda: leg(hinges=[KNEE | {"axis": "left_hip"}]), "expected two joint names, left and right"),
        (lambda: leg(hinges=[KNEE | {"axis": ["left_hip", "hip"]}]), "unknown joint in hinges"),
        (lambda: leg(hinges=[KNEE | {"joint": "left_ankle"}]), "'left_knee' has no mirror twin.*axis: "),
        (lambda: leg(hinges=[KNEE | {"joint": "left_heel"}]), "give no joint as child: write 'child: NAME'"),
        (lambda: leg(hinges=[KNEE | {"joint": "left_hip"}]), "give no joint as parent: write 'parent: NAME'"),
        (
            lambda: leg(hinges=[KNEE | {"parent": "left_heel", "axis": ["left_hip", "right_hip"]}]),
            "Add the bone left_heel-left_knee",
        ),
        (lambda: leg(hinges=[KNEE, KNEE | {"bends": "forward"}]), "hinge at 'left_knee' bends both ways"),
        (
            lambda: Skeleton("abcd", [(0, 1)], mirror=[(0, 1), (2, 0)]),
            "mirror: 'a' has two twins: expected each joint in one",
        ),
        (
            lambda: Skeleton("ab", [(0, 1)], template=[(1, 2, 3)] * 2),
            "template: both ends of bone a-b lie in one place",
        ),
        (
            lambda: Skeleton("abcd", [(0, 1), (1, 2), (2, 3)], template=[(x, 0, 0) for x in (0, 1, 2, 500)]),
            "bone c-d is 498 times as long as the median bone: is it in another unit",
        ),
        (lambda: leg(contacts=["left_hel"]), "did you mean 'left_heel'"),
        (lambda: leg(contacts="left_heel"), "contacts of skeleton '.*': expected a list, got 'left_heel'"),
        (lambda: leg(contacts=3), "contacts of .* expected a list, got 3"),
        (lambda: leg(hinges=3), "hinges of .* expected a list, got 3"),
        (lambda: leg(flexible=3), "flexible of .* expected a list, got 3"),
        (lambda: leg(virtual=["v"]), "virtual of .* expected a mapping from names"),
        (lambda: leg(virtual={"v": "a"}), "virtual joint 'v' of .* expected a list, got 'a'"),
        (lambda: leg(proportions=[1.0]), "proportions of .* expected a mapping from names"),
        (lambda: Skeleton.from_names("ab", ["ab"[:1], "b"]), "expected pairs of joint names, got 'a'"),
        (lambda: Skeleton.from_names("ab", [("a", "b")], template={"a": 1, "b": 2}), "'a': expected 3 numbers, got 1"),
        (lambda: Skeleton.from_names("ab", [("a", "b")], proportions={"a-b": "x"}), "'a-b': expected a number"),
        (lambda: Skeleton.from_names([True, "b"], [(True, "b")]), "expected names, got True or False: YAML reads on"),
        (lambda: Skeleton.from_names(3, [("a", "b")]), "joints of skeleton 'custom': expected a list, got 3"),
        (lambda: leg(spread={"left_hip-left_knee": 3}), "none for left_hip-right_hip"),
        (lambda: Skeleton.from_edges([[0, math.nan]], 3), "expected pairs of joint indices"),
        (lambda: Skeleton.from_edges([[0, 1.5]], 3), "expected pairs of joint indices"),
        (lambda: Skeleton.from_edges([[0, 1, 2]], 3), "expected pairs of joint indices"),
        (lambda: Skeleton.from_edges([("a", "b")], ["a", "b"]), "edges .*; Skeleton.from_names takes pairs of names"),
        (lambda: Skeleton.from_edges([0, 1], 3), "expected pairs of joint indices, got 0"),
        (lambda: Skeleton.from_edges(None, 2), "edges of skeleton 'custom': expected a list, got None"),
        (lambda: Skeleton.from_edges([[0, 1]], 2.0), "joints of skeleton 'custom': expected a list, got 2.0"),
        (lambda: Skeleton("ab", [(0, 1)], hinges=({"joint": "a"},)), "hinges: expected .*Hinge, got {'joint': 'a'}"),
        (lambda: Skeleton("ab", [("a", "b")]), "bones of skeleton 'custom': expected pairs of"),
        (lambda: Skeleton("ab", [(0, 1.5)]), "expected pairs of joint indices, got"),
        (lambda: Skeleton("ab", [(0, 1)], mirror=[("a", "b")]), "mirror of skeleton 'custom': expected pairs"),
        (
            lambda: Skeleton.from_names("ab", [("a", "b")], template=[(0, 0, 0), (0, 1, 0)]),
            r"template of skeleton 'custom': expected {joint: \(x, y, z\)} or one of .*human.*, got list",
        ),
        (lambda: ARM.index("elbw"), "did you mean 'elbow'"),
        (lambda: ARM.template_points(), "has no template"),
        (lambda: get_skeleton("mpi16"), "did you mean 'mpii16'"),
        (lambda: get_skeleton("x" * 5000), "unknown skeleton 'xxx"),
    ],
)
def test_errors(make, message):
    with pytest.raises(SkeletonError, match=message):
        make()


def test_get_skeleton(tmp_path):
    assert get_skeleton(ARM) is ARM
    assert get_skeleton("coco17") is SKELETONS["coco17"]
    file = tmp_path / "arm.json"
    file.write_text(json.dumps(ARM.to_dict()))
    assert get_skeleton(file) == get_skeleton(str(file)) == ARM


# ---------------------------------------------------------------- trees


@st.composite
def trees(draw):
    """Random trees with random extras."""
    names = draw(st.lists(st.text(min_size=1, max_size=8), min_size=2, max_size=12, unique=True))
    bones = [(draw(st.integers(0, i - 1)), i) for i in range(1, len(names))]
    bones = [b if draw(st.booleans()) else b[::-1] for b in bones]
    number = st.floats(-300, 300)
    extras = {}
    if draw(st.booleans()):
        extras["template"] = [(*draw(st.tuples(number, number)), 20.0 * i) for i in range(len(names))]
    if draw(st.booleans()):
        extras["proportions"] = [draw(st.floats(1e-6, 1e6)) for _ in bones]
    if draw(st.booleans()):
        extras["flexible"] = sorted(draw(st.sets(st.integers(0, len(bones) - 1))))
    if draw(st.booleans()):
        extras["spread"] = [draw(st.floats(1e-6, 180)) for _ in bones]
    if draw(st.booleans()):
        extras["contacts"] = sorted(draw(st.sets(st.integers(0, len(names) - 1))))
    chains = [(a, b, c) for a, b in bones for d, c in bones if b == d]
    if chains:
        end = st.tuples(st.sampled_from(chains), st.permutations(range(len(names))))
        ends = draw(st.lists(end, min_size=1, max_size=2, unique_by=lambda e: (e[0], tuple(e[1][:2]))))
        extras["hinges"] = [
            Hinge(*chain, *order[:2], draw(st.sampled_from([1.0, -1.0])), draw(st.floats(0, 1)))
            for chain, order in ends
        ]
    return Skeleton(joints=names, bones=draw(st.permutations(bones)), name=draw(st.text(max_size=5)), **extras)


@given(trees(), st.data())
def test_one_more_bone_closes_a_chain(body, data):
    free = [
        (a, b)
        for a in range(body.num_joints)
        for b in range(a)
        if (a, b) not in body.bones and (b, a) not in body.bones
    ]
    if free:
        extra = data.draw(st.sampled_from(free))
        with pytest.raises(SkeletonError, match="closed chain"):
            Skeleton(body.joints, (*body.bones, extra))
    if body.num_bones > 1:
        with pytest.raises(SkeletonError, match="2 pieces"):
            Skeleton(body.joints, body.bones[1:])


# ---------------------------------------------------------------- changes


def test_with_links():
    body = SKELETONS["coco17"]
    held = body.with_links([("left_wrist", "right_wrist")])
    assert held.num_bones == body.num_bones + 1 and not held.is_tree and held.flexible == body.flexible
    assert {held.joints[i] for i in held.cycle()} >= {"left_wrist", "right_wrist", "neck"}
    assert (held.hinges, held.contacts) == (body.hinges, body.contacts) and held.spread == (*body.spread, 45)
    with pytest.raises(SkeletonError, match="given twice"):
        body.with_links([("left_knee", "left_hip")])
    with pytest.raises(SkeletonError, match="did you mean 'left_wrist'"):
        body.with_links([("left_wrst", "right_wrist")])
    for wrong in ("ab", ["ab"], [("left_wrist",)]):
        with pytest.raises(SkeletonError, match="links: expected pairs of joint names, got"):
            body.with_links(wrong)


def test_connected():
    assert ARM.connected() is ARM
    body = Skeleton.from_names(["a", "b", "c", "d", "e", "f"], [("a", "b"), ("c", "d"), ("d", "e")], tree=False)
    whole = body.connected()
    assert len(whole.pieces()) == 1 and whole.bones[: body.num_bones] == body.bones
    assert [whole.bones[i] for i in whole.flexible] == [(2, 0), (2, 5)]
    places = ((0, 0, 0), (1, 0, 0), (0, 0, 0), (0, 1, 0))  # two pieces that meet in one place
    assert Skeleton("abcd", ((0, 1), (2, 3)), tree=False, template=places).connected().bones[2] == (1, 2)
    names = ("left_hip", "left_knee", "left_ankle", "right_hip")
    apart = Skeleton.from_edges([[0, 1], [1, 2]], names, tree=False)
    joined = apart.connected()
    assert joined.hinges == apart.hinges == (Hinge(0, 1, 2, 0, 3, 1.0),)
    assert joined.contacts == (2,) and joined.spread == (30, 35, 45)


@pytest.mark.parametrize("batch", [(), (2,), (2, 3)])
def test_complete(batch):
    body = SKELETONS["coco17"]
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(*batch, 17, 2, generator=generator, dtype=torch.float64)
    weights = torch.rand(*batch, 17, generator=generator, dtype=torch.float64)
    hip = body.index("left_hip")
    weights[..., hip] = 0
    before = points.clone()
    more, seen = body.complete(points, weights)
    assert more.shape == (*batch, 19, 2) and seen.shape == (*batch, 19)
    assert torch.equal(points, before) and torch.equal(more[..., :17, :], before)
    shoulders = [body.index("left_shoulder"), body.index("right_shoulder")]
    assert torch.allclose(more[..., body.index("neck"), :], points[..., shoulders, :].mean(-2))
    assert torch.equal(seen[..., body.index("neck")], weights[..., shoulders].amin(-1))
    assert (seen[..., body.index("pelvis")] == 0).all()
    same = ARM.complete(points[..., :3, :], weights[..., :3])
    assert torch.equal(same[0], points[..., :3, :])


def test_complete_names_what_it_cannot_take():
    body = SKELETONS["coco17"]
    points = torch.zeros(4, 17, 3)
    for bad in (points.numpy(), points.tolist()):
        with pytest.raises(ShapeError, match="complete: expected a tensor of points, got .*as_tensor"):
            body.complete(bad)
    with pytest.raises(ShapeError, match="complete: expected a tensor of weights, got ndarray"):
        body.complete(points, np.ones((4, 17)))
    with pytest.raises(ShapeError, match=r"\(\.\.\., 17, D\) for skeleton 'coco17', got \(4, 3, 17\): swap"):
        body.complete(points.mT)
    with pytest.raises(ShapeError, match=r"got \(4, 19, 3\), which have its virtual joints already"):
        body.complete(body.complete(points)[0])
    with pytest.raises(ShapeError, match=r"expected weights \(\.\.\., 17\) for points \(4, 17, 3\), got \(4, 19\)"):
        body.complete(points, torch.ones(4, 19))
    with pytest.raises(ShapeError, match=r"complete: points: expected floating point, got torch.int64"):
        body.complete(points.long())
    with pytest.raises(ShapeError, match=r"got \(17,\)"):
        body.complete(points[0, :, 0])
