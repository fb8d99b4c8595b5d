"""JSON that nobody vouches for."""

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kcs_torch.errors import FormatError
from kcs_torch.io.containers import jsonfile
from kcs_torch.io.containers.jsonfile import as_frame_number, as_joints, as_text, entries, outline, read_json

values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=4),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text('ab"\\,:{}[] ', max_size=4), inner, max_size=4),
    max_leaves=12,
)


def routes(value, route=()):
    """What an outline should be."""
    kinds = {dict: "dict", list: "list", str: "text", bool: "bool", type(None): "null"}
    yield (*route, kinds.get(type(value), "number"))
    if isinstance(value, dict):
        for key, inside in value.items():
            yield from routes(inside, (*route, json.dumps(key)[1:-1]))
    elif isinstance(value, list):
        for inside in value:
            yield from routes(inside, (*route, "[]"))


@given(st.lists(values, max_size=4) | st.dictionaries(st.text(max_size=4), values, max_size=4), st.booleans())
def test_outline_tells_every_key_and_kind(value, indented):
    text = json.dumps(value, indent=2 if indented else None)
    assert outline(b"\xef\xbb\xbf\n" + text.encode()) == frozenset(routes(value))


@given(values, st.integers(0, 200))
def test_outline_of_a_cut_text_has_nothing_wrong(value, length):
    whole = json.dumps([value]).encode()
    wrong = outline(whole[:length]) - outline(whole)
    assert len(wrong) <= 1 and all(route[-1] == "number" for route in wrong)  # half a word


@given(st.binary(max_size=60) | st.text('[]{},:"\\ 1tn', max_size=60).map(str.encode))
def test_outline_of_anything(head):
    assert isinstance(outline(head), frozenset)


def test_outline_is_of_json_only():
    assert outline(b"frame,x\n") == outline(b"") == outline(b'"people"') == frozenset()
    assert max(map(len, outline(b"[" * 100_000))) < 40
    assert ("people", "list") in outline(b'{"people": [{"pose_keyp')


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"[" * 100_000, "nested too deeply"),
        (b"{", "does not parse"),
        (b"\xff\xfe\x00", "does not parse"),
        (b"9" * 5000, "does not parse"),
        (b"", "does not parse"),
    ],
)
def test_what_is_no_json_is_told(tmp_path, content, message):
    (tmp_path / "a.json").write_bytes(content)
    with pytest.raises(FormatError, match=rf"a\.json: expected JSON.*{message}"):
        read_json(tmp_path / "a.json")


def test_a_file_that_is_too_large_or_absent(tmp_path, monkeypatch):
    (tmp_path / "a.json").write_text("[1, 2, 3]")
    assert read_json(tmp_path / "a.json") == [1, 2, 3]
    monkeypatch.setattr(jsonfile, "LIMIT", 5)
    with pytest.raises(FormatError, match=r"a\.json: expected 1 GiB of JSON at most, got 9 bytes: split"):
        read_json(tmp_path / "a.json")
    with pytest.raises(FormatError, match="cannot be read: No such file"):
        read_json(tmp_path / "b.json")


def test_joints_in_every_layout():
    flat = as_joints([1, 2, 0.5, 3, None, math.nan], "f")
    assert np.array_equal(flat, [[1, 2, 0.5], [3, np.nan, np.nan]], equal_nan=True)
    assert as_joints([[1, 2], [3, 4]], "f").tolist() == [[1, 2, 1], [3, 4, 1]]
    assert as_joints([[1, 2], [3, 4]], "f", [0.5, 0.25]).tolist() == [[1, 2, 0.5], [3, 4, 0.25]]
    assert as_joints([1, 2, 3, 4], "f", [0.5, 0.25]).tolist() == [[1, 2, 0.5], [3, 4, 0.25]]
    assert as_joints([[1, 2, 9, 9]], "f", [0.5]).tolist() == [[1, 2, 0.5]]


@pytest.mark.parametrize(
    ("found", "scores", "message"),
    [
        (None, None, "got null or nothing"),
        ([], None, "got a list of 0"),
        ("12", None, "got text"),
        ({"x": 1}, None, "got an object with keys"),
        ([1, 2], None, "3 numbers a joint, got 2 numbers"),
        ([1, True, 1], None, "number 1: expected a number, got true or false"),
        ([1, "2", 1], None, "number 1: expected a number, got text"),
        ([1, [2], 1], None, "number 1: expected a number, got a list of 1"),
        ([1, math.inf, 1], None, "number 1 is inf"),
        ([1, -1e300, 1], None, "number 1 is -1e"),
        ([10**400, 1, 1], None, "number 0 is a number of 333 hexadecimal digits"),
        ([[1, 2], [3]], None, "rows of several lengths"),
        ([[1, 2], 3], None, "rows of several lengths"),
        ([[1], [2]], None, "3 numbers a joint"),
        ([[1, 2], [3, 4]], [0.5], "expected 2 scores, one a joint, got a list of 1"),
        ([[1, 2], [3, 4]], 0.5, "expected 2 scores"),
        ([0] * 9000, None, "at most 2000 joints, got 3000"),
    ],
)
def test_what_are_no_joints_is_told(found, scores, message):
    with pytest.raises(FormatError, match=f"^a.json: {'.*' if message else ''}{message}"):
        as_joints(found, "a.json", scores)


def test_entries_name_what_is_none():
    assert [(where, e["a"]) for where, e in entries([{"a": 1}, {"a": 2}], "f")] == [
        ("f: entry 0", 1),
        ("f: entry 1", 2),
    ]
    with pytest.raises(FormatError, match="f: expected a list, got text"):
        list(entries("ab", "f"))
    with pytest.raises(FormatError, match="f: entry 1: expected an object with keys, got a number"):
        list(entries([{}, 3], "f"))


@pytest.mark.parametrize(
    ("value", "number"),
    [
        (3, 3),
        (3.0, 3),
        (-2, -2),
        (0.5, None),
        (True, None),
        ("3", None),
        (None, None),
        (10**30, None),
        (math.nan, None),
    ],
)
def test_frame_numbers(value, number):
    assert as_frame_number(value) == number
    assert as_frame_number(math.inf) is None


def test_text_can_be_printed():
    assert as_text("é\ud800").encode() == "é?".encode()
    assert as_text("x" * 900) == "x" * 197 + "..."
    assert "digits" in as_text(10**9000)
