"""A body is the same whatever the order of its joints: what the built-in skeletons know goes by names."""

import pytest
import torch

import kcs_torch as kt
from kcs_torch.methods.clips.template import guessed
from kcs_torch.skeleton import guess_skeleton, known_by_names

PLAIN = [name for name in kt.SKELETONS if not kt.SKELETONS[name].virtual]


def turned_round(body: kt.Skeleton) -> kt.Skeleton:
    """A skeleton made of the links and names of another one, whose joints stand the other way round."""
    last = body.num_observed - 1
    bones = [(last - a, last - b) for a, b in body.bones if max(a, b) <= last]
    return kt.Skeleton.from_edges(bones, body.joints[last::-1], tree=not body.virtual)


def facts(body: kt.Skeleton) -> dict[str, object]:
    """What is known of a skeleton, by names."""
    names, bones = body.joints, [frozenset(body.joints[i] for i in bone) for bone in body.bones]
    return {
        "template": None if body.template is None else dict(zip(names, body.template, strict=True)),
        "hinges": {(names[h.joint], names[h.parent], names[h.child], h.sign, h.firm) for h in body.hinges},
        "axes": {(names[h.joint], names[h.left], names[h.right]) for h in body.hinges},
        "contacts": {names[i] for i in body.contacts},
        "spread": None if body.spread is None else dict(zip(bones, body.spread, strict=True)),
        "flexible": {bones[i] for i in body.flexible},
    }


@pytest.mark.parametrize("name", PLAIN)
def test_links_tell_the_same_in_any_order(name):
    body = kt.SKELETONS[name]
    other, same = turned_round(body), kt.Skeleton.from_edges(body.bones, body.joints)
    assert facts(other) == facts(same)
    assert facts(same)["flexible"] == facts(body)["flexible"]
    assert guessed(other) == guessed(body)


def test_a_known_skeleton_takes_the_order_that_names_have():
    body = kt.SKELETONS["coco17"]
    assert known_by_names(body.joints[:17]) is body
    known = known_by_names(body.joints[16::-1])
    assert known.joints == (*body.joints[16::-1], *body.joints[17:]) and facts(known) == facts(body)
    assert known_by_names(["a", "b"]) is None and guess_skeleton(body.joints[16::-1]) is None


def test_links_that_close_a_chain_give_way_to_the_known_bones_in_any_order():
    body = kt.SKELETONS["coco17"]
    links = [("left_shoulder", "right_shoulder"), ("left_hip", "right_hip"), ("left_shoulder", "left_hip")]
    links += [("right_shoulder", "right_hip"), ("left_hip", "left_knee"), ("left_knee", "left_ankle")]
    for names in (body.joints[:17], body.joints[16::-1]):
        edges = [(names.index(a), names.index(b)) for a, b in links]
        tracks = kt.Tracks.from_arrays(torch.randn(4, 17, 2), joint_names=names, edges=edges)
        assert tracks.skeleton.joints[:17] == tuple(names) and facts(tracks.skeleton) == facts(body)
        assert any("used the built-in skeleton 'coco17'" in note for note in tracks.notes)
