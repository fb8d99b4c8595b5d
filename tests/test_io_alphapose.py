"""AlphaPose files: every layout, track ids, and files that are none."""

import numpy as np
import pytest
from samples import numbers, person, write_json

from kcs_torch.errors import FormatError, KcsError
from kcs_torch.io import detect_format, load_people, load_tracks
from kcs_torch.skeleton import SKELETONS

A, B = person(12, 17), person(12, 17, at=(900.0, 300.0), confidence=0.6)


def entry(frame, joints, image="{}.jpg", **more):
    return {"image_id": image.format(frame), "category_id": 1, "keypoints": np.ravel(joints).tolist(), **more}


def write(tmp_path, people):
    return write_json(tmp_path / "alphapose-results.json", people)


def test_images_are_in_natural_order(tmp_path):
    """AlphaPose itself lists them in the order in which its workers are done: 10.jpg may come before 2.jpg."""
    path = write(tmp_path, [entry(t, A[t], score=3.0) for t in (10, 11, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9)])
    assert detect_format(path) == "alphapose"
    tracks = load_tracks(path, fps=25)
    assert np.allclose(numbers(tracks), A)
    assert (tracks.skeleton.name, tracks.fps, tracks.units) == ("coco17", 25, "px")


def test_images_without_anybody_are_unseen_frames(tmp_path):
    tracks = load_tracks(write(tmp_path, [entry(t, A[t], "frame_{:06d}.png") for t in range(12) if t not in (4, 5)]))
    assert (~tracks.seen.any(1)).nonzero().flatten().tolist() == [4, 5]
    assert any("2 of 12 frames have no person (numbers 4, 5): unseen" in n for n in tracks.notes)


def test_several_people_without_track_ids_are_followed(tmp_path):
    """Without a tracker idx is 0 for everybody."""
    people = [entry(t, p[t], idx=[0.0]) for t in range(12) for p in ((A, B) if t % 2 else (B, A))]
    a, b = load_people(write(tmp_path, people))
    assert np.allclose(numbers(a), A) and np.allclose(numbers(b), B)


@pytest.mark.parametrize("ids", [(1, 2), ([1.0], [2.0]), ("a", "b")], ids=str)
def test_track_ids_are_used(tmp_path, ids):
    order = np.where(np.arange(12) < 6, 0, 1)
    people = [entry(t, (A, B)[k ^ order[t]][t], idx=ids[k]) for t in range(12) for k in (0, 1)]
    first, _ = load_people(write(tmp_path, people))
    halves = np.concatenate([A[:6], B[6:]]), np.concatenate([B[:6], A[6:]])
    assert any(np.allclose(numbers(first), half) for half in halves)
    assert any("track ids" in n for n in first.notes)


@pytest.mark.parametrize(("count", "name"), [(26, "halpe26"), (68, "halpe26"), (136, "halpe26"), (133, "wholebody63")])
def test_larger_bodies(tmp_path, count, name):
    found = person(4, count)
    (tracks,) = load_people(write(tmp_path, [entry(t, found[t]) for t in range(4)]))
    body = SKELETONS[name]
    assert tracks.skeleton is body
    assert np.allclose(numbers(tracks, 23 if count == 133 else 26), found[:, : 23 if count == 133 else 26])
    told = {26: "", 68: "hands are left out", 133: "the face is left out", 136: "face and hands are left out"}[count]
    assert any(n.startswith(told) and "left out" in n for n in tracks.notes) == (count != 26)
    assert any("(--skeleton wholebody63) keeps the hands" in n for n in tracks.notes) == (count in (68, 136))


def test_the_layouts_by_image(tmp_path):
    found = person(12, 18)
    flat = [np.ravel(f).tolist() for f in found]
    layouts = {
        "cmu": {f"{t}.jpg": {"version": "AlphaPose v0.3", "bodies": [{"joints": flat[t]}]} for t in range(12)},
        "open": {f"{t}.jpg": {"people": [{"pose_keypoints_2d": flat[t]}]} for t in range(12)},
        "poseflow": {f"{t}.png": [{"keypoints": flat[t], "scores": 2.5, "idx": 1}] for t in range(12)},
    }
    for name, data in layouts.items():
        path = write_json(tmp_path / f"{name}.json", data)
        assert detect_format(path) == "alphapose"
        tracks = load_tracks(path)
        assert tracks.skeleton.name == "coco18"
        assert np.allclose(numbers(tracks, 18), found)
    seen = load_tracks(write(tmp_path, layouts["cmu"] | {"0.jpg": {"bodies": []}})).seen.any(1)
    assert seen.tolist() == [False] + [True] * 11


GOOD = entry(0, A[0])
BROKEN = [
    ({}, "expected people in at least one"),
    ({"a.jpg": 3}, r"a\.jpg: expected a list of people, or one under 'bodies' or 'people', got neither"),
    (
        {"a.jpg": {"bodies": [{}]}},
        r"entry 0 \(image a\.jpg\): 'joints': expected numbers x, y, confidence, got no such",
    ),
    ([], "expected people in at least one"),
    ([3], "entry 0: expected an object with keys, got a number"),
    ([GOOD, {}], "entry 1: expected the name of an image under 'image_id', got none"),
    ([GOOD, {**GOOD, "image_id": ["1.jpg"]}], "entry 1: expected the name of an image"),
    ([GOOD, {"image_id": "1.jpg"}], r"entry 1 \(image 1\.jpg\): 'keypoints': expected numbers"),
    ([GOOD, {**GOOD, "keypoints": "x"}], r"entry 1 \(image 0\.jpg\): 'keypoints': expected a list of numbers"),
    ([GOOD, {**GOOD, "keypoints": [1, 2]}], "3 numbers a joint, got 2"),
    ([GOOD, {**GOOD, "keypoints": [1, 2, 1] * 16}], "expected 17 joints of every person, got 16 in frame 0"),
    ([{**GOOD, "keypoints": [1e10] * 51}], "number 0 is 1e"),
    ([{**GOOD, "keypoints": [0] * 51}], "expected people in at least one of 1 frames"),
    (3, "expected AlphaPose's list of people"),
]


@pytest.mark.parametrize(("data", "message"), BROKEN)
def test_what_is_none_is_told(tmp_path, data, message):
    path = write_json(tmp_path / "broken.json", data)
    with pytest.raises(KcsError, match=message) as caught:
        load_people(path, format="alphapose")
    assert "broken.json" in str(caught.value)


def test_a_number_of_joints_that_nobody_knows(tmp_path):
    path = write(tmp_path, [entry(t, person(4, 20)[t]) for t in range(4)])
    with pytest.raises(KcsError, match=r"136 \(halpe26\), got 20, .*give skeleton="):
        load_tracks(path)


def test_a_folder_is_no_file(tmp_path):
    (tmp_path / "f").mkdir()
    write(tmp_path / "f", [GOOD])
    with pytest.raises(FormatError, match="cannot be read: Is a directory"):
        load_tracks(tmp_path / "f", format="alphapose")
