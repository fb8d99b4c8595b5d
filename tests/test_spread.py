"""How far bones stray from the template, by their names."""

import pytest

from kcs_torch.anatomy import UNKNOWN_SPREAD, spread_by_names
from kcs_torch.anatomy.spread import _HAND, _PERSON
from kcs_torch.anatomy.template import _CENTRE, _LEFT
from kcs_torch.anatomy.template import _HAND as HAND_PLACES
from kcs_torch.skeleton import SKELETONS


def test_every_place_of_the_template_has_one():
    assert set(_PERSON) == set(_CENTRE) | set(_LEFT)
    assert set(_HAND) == set(HAND_PLACES)


@pytest.mark.parametrize(
    ("names", "degrees"),
    [
        (["LHip", "LKnee"], 30),
        (["left_shoulder", "left_elbow"], 50),
        (["UpperNeck", "LShoulder"], 15),
        (["chest", "RHip"], 12),
        (["neck", "nose"], 25),
        (["WRIST", "INDEX_MCP"], 10),
        (["INDEX_MCP", "INDEX_PIP"], 40),
        (["tail1", "tail2"], UNKNOWN_SPREAD),
        (["left_knee", "ski"], UNKNOWN_SPREAD),
    ],
)
def test_bones(names, degrees):
    assert spread_by_names(names, [(0, 1), (1, 0)]) == (degrees, degrees)


def test_fingers_of_a_person_go_where_the_arm_goes():
    names = ["l_elbow", "l_wrist", "l_index_mcp", "l_index_pip"]
    assert spread_by_names(names, [(0, 1), (1, 2), (2, 3)]) == (60, 60, 60)
    assert spread_by_names(names[1:], [(0, 1), (1, 2)]) == (10, 40)


@pytest.mark.parametrize("name", sorted(SKELETONS))
def test_built_in_skeletons(name):
    body = SKELETONS[name]
    assert len(body.spread) == body.num_bones and UNKNOWN_SPREAD not in body.spread
    for left, right in body.mirror_bones:
        assert body.spread[left] == body.spread[right]
