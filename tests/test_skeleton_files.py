"""Skeletons as mappings and files: there and back, and files that hold something else."""

import json

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from test_skeleton import trees
from test_skeletons_built_in import BUILT_IN

from kcs_torch.errors import FormatError, KcsError, SkeletonError
from kcs_torch.skeleton import SKELETONS, Skeleton, get_skeleton


@pytest.mark.parametrize("name", BUILT_IN)
def test_round_trip_of_built_in(name, tmp_path):
    body = SKELETONS[name]
    data = body.to_dict()
    assert Skeleton.from_dict(data) == body
    (tmp_path / "a.json").write_text(json.dumps(data))
    (tmp_path / "a.yaml").write_text(yaml.safe_dump(data, sort_keys=False))
    assert Skeleton.load(tmp_path / "a.json") == Skeleton.load(tmp_path / "a.yaml") == body


@given(trees())
def test_round_trip_of_random_trees(body):
    assert body.is_tree and body.cycle() is None and len(body.pieces()) == 1
    data = body.to_dict()
    keys = {f"{a}-{b}" for a, b in ((body.joints[a], body.joints[b]) for a, b in body.bones)}
    if (body.proportions is None and body.spread is None) or len(
        keys
    ) == body.num_bones:  # "a-" + "b" and "a" + "-b" may collide
        assert Skeleton.from_dict(json.loads(json.dumps(data))) == body


@pytest.mark.parametrize(
    ("text", "error", "message"),
    [
        ("joints: [a, b]\nbones: [[a, b]]\ncolour: red\n", FormatError, "unknown key.*colour"),
        ("joints: [a, b]\nbone: [[a, b]]\n", FormatError, "did you mean 'bones'"),
        ("joints: [a, b]\n", FormatError, "a list under 'bones'"),
        ("joints: ab\nbones: [[a, b]]\n", FormatError, "a list under 'joints', got str"),
        ("- a\n- b\n", FormatError, "expected a mapping"),
        ("", FormatError, "expected a mapping"),
        ("joints: [a, b\n", FormatError, "does not parse"),
        ("joints: [a, b]\nbones: [[a, c]]\n", SkeletonError, "arm.yaml: unknown joint in bones"),
        ("joints: ['', b]\nbones: [[h, b]]\n", SkeletonError, "unknown joint in bones .*'h': choices are '', b"),
        ("joints: [a, b]\nbones: [3]\n", SkeletonError, "arm.yaml.*expected pairs"),
        ("joints: [a, b]\nbones: [[a, b]]\ntemplate: {a: [0, 0, 0], b: here}\n", SkeletonError, "arm.yaml.*3 numbers"),
        ("joints: [a, b]\nbones: [[a, b]]\ntemplate: {a: [0, 0, 0], b: [1]}\n", SkeletonError, "arm.yaml.*3 numbers"),
        ("joints: [a, b]\nbones: [[a, b]]\nproportions: 3\n", SkeletonError, "arm.yaml.*a mapping from names, got 3"),
        ("joints: [a, b]\nbones: [[a, b]]\nvirtual: [c]\n", SkeletonError, "arm.yaml.*a mapping from"),
        ("joints: [a, b]\nbones: [{a: 1, b: 2}]\n", SkeletonError, "expected pairs of joint names"),
        ("joints: [a, b]\nbones: [[a, b]]\nname: [a]\n", FormatError, "name: expected a str"),
        ("joints: [a, b]\nbones: [[a, b]]\ntree: 3\n", FormatError, "tree: expected a bool"),
        ("joints: [on, b]\nbones: [[on, b]]\n", SkeletonError, "arm.yaml.*YAML reads on, off.* in quotes"),
        ("joints: [a]\nbones: []\n", SkeletonError, "arm.yaml: .*at least 2 joints"),
    ],
)
def test_bad_files(tmp_path, text, error, message):
    file = tmp_path / "arm.yaml"
    file.write_text(text)
    with pytest.raises(error, match=message):
        Skeleton.load(file)


LEAVES = st.none() | st.booleans() | st.integers(-3, 5) | st.floats() | st.sampled_from(["a", "b", "c", "human", ""])
VALUES = st.recursive(
    LEAVES,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(["a", "b", "a-b"]), inner, max_size=3),
    max_leaves=8,
)
OPTIONAL = ("name", "mirror", "virtual", "template", "proportions", "flexible", "tree", "hinges", "contacts", "spread")


@given(
    st.fixed_dictionaries(
        {"joints": st.just(["a", "b"]) | VALUES, "bones": st.just([["a", "b"]]) | VALUES},
        optional=dict.fromkeys(OPTIONAL, VALUES),
    )
)
def test_wild_mappings_give_a_skeleton_or_one_of_our_errors(data):
    try:
        body = Skeleton.from_dict(data)
    except KcsError:
        return
    assert Skeleton.from_dict(body.to_dict()) == body and hash(body) is not None


def test_unreadable_files(tmp_path):
    with pytest.raises(FormatError, match="cannot be read"):
        Skeleton.load(tmp_path / "none.yaml")
    with pytest.raises(FormatError, match="cannot be read"):
        Skeleton.load(tmp_path)
    (tmp_path / "binary.json").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(FormatError, match="does not parse"):
        Skeleton.load(tmp_path / "binary.json")
    (tmp_path / "deep.json").write_text("[" * 100_000)
    with pytest.raises(FormatError, match="does not parse"):
        Skeleton.load(tmp_path / "deep.json")


def test_name_of_a_file_without_a_name(tmp_path):
    (tmp_path / "horse.yaml").write_text("joints: [a, b]\nbones: [[a, b]]\n")
    assert Skeleton.load(tmp_path / "horse.yaml").name == "horse"


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.yaml", "joints: [a, b]\nbones: [[a, b]]\nbones: [[b, a]]"),
        ("a.json", '{"joints": ["a", "b"], "bones": [["a", "b"]], "bones": [["b", "a"]]}'),
    ],
)
def test_a_key_that_is_there_twice_is_an_error(tmp_path, name, text):
    """Of the two the last would count, without a word."""
    (tmp_path / name).write_text(text)
    with pytest.raises(FormatError, match="'bones' is there twice"):
        Skeleton.load(tmp_path / name)


def test_a_file_of_another_name_is_told_what_it_should_be_called(tmp_path):
    (tmp_path / "body.txt").write_text("joints: [a, b]\nbones: [[a, b]]")
    with pytest.raises(SkeletonError, match=r"body.txt: expected a skeleton's file to be called .yaml or .json"):
        get_skeleton(str(tmp_path / "body.txt"))
