"""People of all frames: who is who, how sure, which joints; within memory."""

import numpy as np
import pytest
import torch
from samples import person

from kcs_torch.data import walking_person
from kcs_torch.errors import FormatError, ShapeError, SkeletonError
from kcs_torch.io.contents import people as module
from kcs_torch.io.contents.frames import as_track_id, by_image, by_number
from kcs_torch.io.contents.layout import choose_layout, named_layout, names_of
from kcs_torch.io.contents.people import Sighting, people_tracks
from kcs_torch.io.registry import Options
from kcs_torch.skeleton import SKELETONS

A, B = person(6, 17), person(6, 17, at=(900.0, 300.0), confidence=0.6)


def two(order=None, ids=None):
    """Two people, B first where ``order`` says 1."""
    frames = []
    for t in range(6):
        pair = [Sighting(A[t], ids and ids[0][t]), Sighting(B[t], ids and ids[1][t])]
        frames.append(pair[::-1] if order and order[t] else pair)
    return frames


def read(frames, options=None, **more):
    return people_tracks(frames, options or Options(), source="f.json", **more)


def numbers(tracks):
    return torch.cat([tracks.points, tracks.weights[..., None]], -1)[:, :17].numpy()


# ---------------------------------------------------------------------- who is who


def test_people_are_followed_by_their_places():
    a, b = read(two([0, 1, 1, 0, 1, 0]))
    assert np.allclose(numbers(a), A) and np.allclose(numbers(b), B)
    assert not any("track ids" in n for n in a.notes)


def test_a_track_id_that_breaks_is_joined_by_place():
    first, second = read(two(ids=([7, 7, 12, 12, 12, 3], [1] * 6)))
    assert np.allclose(numbers(first), A) and np.allclose(numbers(second), B)
    assert (
        "track ids that break are joined by place: '12' begins where '7' ends, '3' begins where '12' ends"
        in first.notes
    )
    assert "the file calls this one '12' in 3 of 6 frames" in first.notes
    assert "the file calls this one '1'" in second.notes


@pytest.mark.parametrize("away", [(900.0, 300.0), (300.0, 300.0)], ids=["elsewhere", "after more than a second"])
def test_who_is_somebody_else_is_not_joined(away):
    late = 40 if away == (300.0, 300.0) else 0
    start, end = person(6, 17, at=(300.0, 300.0)), person(6, 17, at=away)
    frames = [[Sighting(p, 7)] for p in start] + [[]] * late + [[Sighting(p, 8)] for p in end]
    people = read(frames, Options(fps=30))
    assert [int(one.seen.any(1).sum()) for one in people] == [6, 6]
    assert not any("joined" in note for one in people for note in one.notes)


def test_track_ids_go_before_places():
    swapped = [[1, 1, 1, 2, 2, 2], [2, 2, 2, 1, 1, 1]]
    first, second = read(two(ids=swapped))
    assert np.allclose(numbers(first), np.concatenate([A[:3], B[3:]]))
    assert np.allclose(numbers(second), np.concatenate([B[:3], A[3:]]))
    assert "people are followed by the file's own track ids" in first.notes


def test_each_person_is_told_by_the_ids_of_the_file():
    def called(ids):
        return [[n for n in one.notes if "calls this one" in n] for one in read(two(ids=ids))]

    left, right = ["the file calls this one 'left'"], ["the file calls this one 'right'"]
    assert called([["left"] * 6, ["right"] * 6]) == [left, right]
    assert called([["left"] * 6, ["left", *["right"] * 5]]) == [left, [right[0] + " in 5 of 6 frames"]]  # by places
    assert called([[0] * 6, [0] * 6]) == [[], []]  # as some trackers number everybody


@pytest.mark.parametrize(
    ("ids", "say"),
    [([[0] * 6, [0] * 6], "stands twice in frame 0"), ([[1, 1, 1, None, 1, 1], [2] * 6], "is missing in frame 3")],
    ids=["twice", "missing"],
)
def test_ids_that_do_not_say_who_is_who_are_no_ids(ids, say):
    a, b = read(two([0, 1, 1, 0, 1, 0], ids))
    assert np.allclose(numbers(a), A) and np.allclose(numbers(b), B)
    assert f"a track id {say}: people are followed by their places, not by the ids" in a.notes


def test_half_characters_of_ids_are_shown_escaped():
    a, _ = read(two([0, 1, 1, 0, 1, 0], [["\ud800a"] * 6, ["b"] * 6]))
    assert a.notes[0] == "the file calls this one '\\ud800a'"
    "".join(a.notes).encode()


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        *[(3, 3), ([0.0], 0), ([[7]], 7), ("p1", "p1"), (-1, None), (True, None), ([1, 2], None), (None, None)],
        *[({}, None), ("0", 0), (" 7 ", 7), ("7.0", 7), ("7.5", "7.5"), ("07", "07"), ("-1", None), ("  ", None)],
        ("9" * 5000, "9" * 5000),
    ],
)
def test_track_ids(value, expected):
    assert as_track_id(value) == expected


# ---------------------------------------------------------------------- how sure


def scored(confidence):
    frames = person(4, 17)
    frames[..., 2] = confidence
    return [[Sighting(f)] for f in frames]


@pytest.mark.parametrize("ids", [None, [[1] * 6, [2] * 6]], ids=["places", "ids"])
def test_shares_of_the_image_are_told_and_scaled_by_its_size(ids):
    shares = [[s._replace(joints=s.joints / [1920, 1080, 1]) for s in frame] for frame in two(ids=ids)]
    told = "coordinates are taken as they are: if they are shares of the image, give image_size=(width, height)"
    assert any(note.startswith(told) for note in read(shares)[0].notes)
    a, b = read(shares, Options(image_size=(1920, 1080)))
    assert np.allclose(numbers(a), A) and np.allclose(numbers(b), B)
    for pixels in (read(two()), read(two(), Options(image_size=(1920, 1080)))):
        assert np.allclose(numbers(pixels[0]), A)
        assert not any("shares" in n for n in pixels[0].notes)


def test_confidences_a_little_above_one_are_one():
    (tracks,) = read(scored(1.02))
    assert (tracks.weights == 1).all()
    assert "confidences above 1 (up to 1.02) are taken as 1" in tracks.notes


def test_confidences_on_another_scale_are_divided():
    (tracks,) = read(scored(np.linspace(2, 200, 17)))
    weights = tracks.weights[0, :17]
    assert (weights[:5] == 0).all() and (weights[5:].diff() >= 0).all()
    assert weights[8].item() == pytest.approx(50.5 / 98, abs=0.02) and weights[-1] == 1
    assert any(n.startswith("confidences up to 200: divided by 19") for n in tracks.notes)


def test_confidences_in_per_cent():
    """Also where no joint is certain: the best of them would count as such."""
    (tracks,) = read(scored(np.linspace(20, 60, 17)))
    assert np.allclose(tracks.weights[0, 4:17], np.linspace(0.2, 0.6, 17)[4:])
    assert (tracks.weights[0, :4] == 0).all()
    assert "confidences up to 60 are taken as per cent" in tracks.notes


@pytest.mark.parametrize("odd", [95, 9.5, 1e4])
def test_one_odd_confidence_is_no_scale(odd):
    """A decimal point that was lost hid everybody else."""
    scores = np.full((4, 17), 0.9)
    scores[2, 3] = odd
    (tracks,) = read(scored(scores))
    assert np.allclose(tracks.weights[:, :17], scores.clip(max=1))
    assert f"confidences above 1 (up to {odd:.3g}) are taken as 1" in tracks.notes


def test_few_confidences_in_per_cent():
    """All others are next to 0 or 0, or too few to tell."""
    for others in (0.3, 0):
        scores = np.full((4, 17), others)
        scores[2, 3] = 95
        (tracks,) = read(scored(scores))
        assert tracks.weights[:, :17].nonzero().tolist() == [[2, 3]] and tracks.weights[2, 3] == 0.95
    scores[2, 4:6] = 0.9
    assert read(scored(scores))[0].weights[2, 3] == 0.95


def test_negative_confidences_and_blank_joints_are_unseen():
    frames = scored(0.8)
    frames[1][0].joints[3, 2] = -0.1
    frames[2][0].joints[4] = 0
    frames[2][0].joints[5] = np.nan
    frames[3][0].joints[6, :2] = 0, 5  # whatever lies beyond the image's edge, or a detector's slip
    frames[3][0].joints[7, :2] = -1
    (tracks,) = read(frames)
    assert (~tracks.seen[:, :17]).nonzero().tolist() == [[1, 3], [2, 4], [2, 5], [3, 6], [3, 7]]
    assert "1 joint whose x and y are both -1 is taken as unseen" in tracks.notes
    assert "1 joint whose x or y is exactly 0 is taken as unseen" in tracks.notes
    assert "1 joints of negative confidence are taken as unseen" in tracks.notes
    assert frames[1][0].joints[3, 2] == -0.1  # left as it was


def test_people_below_the_threshold_are_left_out():
    (tracks,) = read(two(), Options(threshold=0.7))
    assert "1 people never reach the confidence threshold: left out" in tracks.notes
    with pytest.raises(ShapeError, match="lower the threshold"):
        read(two(), Options(threshold=0.9))


# ---------------------------------------------------------------------- which joints


def test_other_numbers_of_joints_are_told():
    frames = two()
    frames[4][1] = Sighting(B[4][:16])
    with pytest.raises(FormatError, match=r"f\.json: expected 17 joints of every person, got 16 in frame 4"):
        read(frames)
    with pytest.raises(FormatError, match="people in at least one of 3 frames, got none"):
        read([[], [], []])


def test_people_without_any_seen_joint_are_told():
    nobody = [[s._replace(joints=s.joints * [1, 1, 0]) for s in frame] for frame in two()]
    with pytest.raises(FormatError, match="got none with a joint that is seen: every confidence is 0"):
        read(nobody)


@pytest.mark.parametrize(
    ("count", "name"),
    [
        (15, "mpi15"),
        (16, "mpii16"),
        (18, "coco18"),
        (21, "hand21"),
        (26, "halpe26"),
        (33, "mediapipe33"),
        (68, "halpe26"),
        (133, "wholebody63"),
        (136, "halpe26"),
    ],
)
def test_the_number_of_joints_tells_the_skeleton(count, name):
    (tracks,) = read([[Sighting(p)] for p in person(4, count)])
    body = SKELETONS[name]
    assert tracks.skeleton is body
    where = [names_of(name, count).index(j) for j in body.joints[: body.num_observed]]
    assert np.allclose(tracks.points[:, : body.num_observed], person(4, count)[:, where, :2])


def test_all_names_of_a_layout_differ():
    for name, count in (("wholebody63", 133), ("halpe26", 136), ("halpe26", 68), ("coco17", 17)):
        assert len(set(names_of(name, count))) == count
    assert names_of("wholebody63", 133)[91] == "left_hand_root" and names_of("wholebody63", 133)[22] == "right_heel"
    assert names_of("halpe26", 136)[94] == "left_hand_root" and names_of("halpe26", 68)[26] == "left_hand_root"


@pytest.mark.parametrize("name", ["coco17", "h36m17"])
def test_seventeen_joints_are_told_apart_by_their_places(name):
    xy = walking_person(6, skeleton=name).points[:, :17, :2].numpy() + 1500
    people = [np.column_stack([frame, np.full(17, 0.8)]) for frame in xy]
    notes = []
    assert choose_layout(people, Options(), "f", notes) == (name, SKELETONS[name].joints[:17])
    what = {"coco17": "taken as coco17; if they are h36m17 or ap10k", "h36m17": "the joints' places say h36m17, not"}
    assert notes[0].startswith(f"17 joints without names: {what[name]}")


def test_a_skeleton_of_as_many_joints_goes_before_any_guess():
    (tracks,) = read([[Sighting(p)] for p in A], Options(skeleton="h36m17"))
    assert tracks.skeleton.name == "h36m17"
    assert np.allclose(numbers(tracks), A)


def test_an_unknown_number_of_joints_asks_for_a_skeleton():
    with pytest.raises(SkeletonError, match=r"got 9, which the file does not name: give skeleton=a YAML.*--skeleton"):
        read([[Sighting(p)] for p in person(4, 9)])
    with pytest.raises(SkeletonError, match="got 31.*give skeleton='cmu31'"):
        read([[Sighting(p)] for p in person(4, 31)])


def test_names_in_another_spelling_tell_the_skeleton():
    notes = []
    names = [n.upper() for n in names_of("wholebody63", 133)]
    assert named_layout(names, notes) == "wholebody63"
    assert notes == ["63 of the file's 133 joints are by their names those of wholebody63"]
    assert named_layout(SKELETONS["coco17"].joints[:17], notes := []) == "coco17" and not notes
    assert named_layout(["snout", "tail"], []) is None


# ---------------------------------------------------------------------- frames


def placed(images, make=by_image):
    notes = []
    out = make({k: [k] for k in images}, notes)
    return [frame[0] if frame else None for frame in out], notes


def test_images_are_in_the_order_of_their_numbers():
    assert placed(["10.jpg", "9.jpg", "11.jpg"]) == (["9.jpg", "10.jpg", "11.jpg"], ["frame 0 is image 9.jpg"])
    frames, notes = placed(["a/f_0001.png", "a/f_0004.png", "a/f_0003.png"])
    assert frames == ["a/f_0001.png", None, "a/f_0003.png", "a/f_0004.png"]
    assert notes == ["1 of 4 frames has no person (number 2): unseen"]


def test_images_without_numbers_or_of_several_kinds_are_in_the_order_of_the_names():
    assert placed(["b.jpg", "a.jpg"])[0] == ["a.jpg", "b.jpg"]
    frames, notes = placed(["cam2_1.jpg", "cam1_2.jpg", "cam1_1.jpg"])
    assert frames == ["cam1_1.jpg", "cam1_2.jpg", "cam2_1.jpg"]
    assert any("begin in 2 ways" in n for n in notes)
    assert placed(["9" * 5000 + ".jpg", "1.jpg"])[0][0] == "1.jpg"


def test_one_far_number_does_not_make_millions_of_frames():
    frames, notes = placed([0, 1, 10**15], by_number)
    assert frames == [0, 1, 10**15]
    assert any("too far apart" in n for n in notes)


# ---------------------------------------------------------------------- memory


def test_ghosts_do_not_fill_the_memory(monkeypatch):
    monkeypatch.setattr(module, "_MOST_NUMBERS", 2 * 8 * 17 * 3)
    real = person(8, 17)
    ghost = person(1, 17, confidence=0.4)[0]
    frames = [[Sighting(real[t]), Sighting(ghost + np.array([5000.0 * (t + 1), 0, 0]))] for t in range(8)]
    people = read(frames)
    assert len(people) == 2
    assert people[0].seen.all()
    assert any("7 people who are seen least are left out" in n for n in people[0].notes)


def test_a_crowd_is_thinned(monkeypatch):
    monkeypatch.setattr(module, "_MOST_IN_FRAME", 2)
    faint = person(1, 17, at=(5000.0, 0.0), confidence=0.4)[0]
    people = read([[Sighting(faint), *frame] for frame in two()])
    assert len(people) == 2
    assert np.allclose(numbers(people[0]), A)
    assert any("6 frames have more than 2 people" in n for n in people[0].notes)
