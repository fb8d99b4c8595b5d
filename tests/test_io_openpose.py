"""OpenPose folders: frames, gaps, layouts, several people, and files that are none."""

import json

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from samples import person, write_openpose

from kcs_torch.data import walking_person
from kcs_torch.errors import FormatError, KcsError, ShapeError, SkeletonError
from kcs_torch.io import detect_format, load_people, load_tracks

quick = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def alone(num_frames=4, joints=25, **options):
    return [p[None] for p in person(num_frames, joints, **options)]


def numbers(tracks, joints=25):
    return torch.cat([tracks.points, tracks.weights[..., None]], -1)[:, :joints].numpy()


# ---------------------------------------------------------------------- one person


def test_reads_a_folder(tmp_path):
    folder = write_openpose(tmp_path / "json", alone())
    assert detect_format(folder) == "openpose"
    tracks = load_tracks(folder, fps=50)
    assert np.allclose(numbers(tracks), person())
    assert (tracks.skeleton.name, tracks.fps, tracks.units) == ("body25", 50, "px")
    assert load_tracks(folder).fps is None


def test_one_file_is_one_frame(tmp_path):
    folder = write_openpose(tmp_path / "json", alone())
    tracks = load_tracks(folder / "clip_000000000002_keypoints.json")
    assert np.allclose(numbers(tracks), person()[2:3])


def test_files_are_in_the_order_of_their_numbers(tmp_path):
    folder = write_openpose(tmp_path / "json", alone(12), name="cam01.{}.json")  # cam01.10 sorts before cam01.2 as text
    assert np.allclose(numbers(load_tracks(folder)), person(12))


def test_gaps_in_the_numbers_are_unseen_frames(tmp_path):
    folder = write_openpose(tmp_path / "json", alone(), frames=[3, 4, 6, 9])
    tracks = load_tracks(folder)
    assert tracks.seen.any(1).tolist() == [True, True, False, True, False, False, True]
    assert np.allclose(numbers(tracks)[[0, 1, 3, 6]], person())
    assert any("3 of 7 frames have no file (numbers 5, 7, 8)" in n for n in tracks.notes)


def test_missing_joints_and_frames_without_people_are_unseen(tmp_path):
    people = person()
    people[1, 4] = 0  # as OpenPose writes a joint that it has not found
    people[2, 7, 0] = 0  # a joint that jumped to the image's edge
    people[0, 9, 2] = 0.1
    folder = write_openpose(tmp_path / "json", [[people[0]], [people[1]], [people[2]], []])
    tracks = load_tracks(folder)
    assert (~tracks.seen[:3]).nonzero().tolist() == [[0, 9], [1, 4], [2, 7]]
    assert not tracks.seen[3].any()
    assert (tracks.points[~tracks.seen] == 0).all()
    assert any("exactly 0" in n for n in tracks.notes)


@pytest.mark.parametrize(("joints", "name"), [(25, "body25"), (18, "coco18"), (15, "mpi15"), (21, "hand21")])
def test_the_number_of_joints_tells_the_skeleton(tmp_path, joints, name):
    tracks = load_tracks(write_openpose(tmp_path / "json", alone(joints=joints)))
    assert (tracks.skeleton.name, tracks.skeleton.num_observed) == (name, joints)


@pytest.mark.parametrize("name", ["body25", "body25b"])
def test_two_layouts_of_25_joints_are_told_apart(tmp_path, name):
    xy = walking_person(6, skeleton=name).points[:, :25, :2].numpy() + 1500
    detections = [[np.column_stack([frame, np.full(25, 0.8)])] for frame in xy]
    tracks = load_tracks(write_openpose(tmp_path / "json", detections))
    assert tracks.skeleton.name == name
    assert any("the joints lie as those of body25b" in n for n in tracks.notes) == (name == "body25b")


def test_other_lengths_name_the_skeletons_that_fit(tmp_path):
    folder = write_openpose(tmp_path / "json", alone(joints=17))
    with pytest.raises(FormatError, match=r"75 \(body25.*got 51; 17 joints fit skeleton=.*'coco17'"):
        load_tracks(folder)
    assert load_tracks(folder, skeleton="coco17").skeleton.name == "coco17"
    with pytest.raises(SkeletonError, match="expected the 21 joints"):
        load_tracks(write_openpose(tmp_path / "other", alone()), skeleton="hand21")


def test_another_skeleton_takes_the_joints_by_name(tmp_path):
    from kcs_torch.skeleton import SKELETONS, Skeleton

    body = Skeleton.from_names(["LKnee", "LHip"], [("LHip", "LKnee")])
    tracks = load_tracks(write_openpose(tmp_path / "json", alone()), skeleton=body)
    own = SKELETONS["body25"]
    assert np.allclose(numbers(tracks), person()[:, [own.index("LKnee"), own.index("LHip")]])


def test_confidences_a_little_above_one_are_one(tmp_path):
    tracks = load_tracks(write_openpose(tmp_path / "json", alone(confidence=1.04)))
    assert (tracks.weights == 1).all()
    assert any("above 1" in n for n in tracks.notes)
    percent = load_tracks(write_openpose(tmp_path / "percent", alone(confidence=90.0)))
    assert np.allclose(percent.weights, 0.9)
    assert any("confidences up to 90 are taken as per cent" in n for n in percent.notes)


def test_a_byte_order_mark_is_no_error(tmp_path):
    folder = write_openpose(tmp_path / "json", alone(1), name="f{}.json")
    (folder / "f0.json").write_bytes(b"\xef\xbb\xbf" + (folder / "f0.json").read_bytes())
    assert load_tracks(folder).num_frames == load_tracks(folder / "f0.json").num_frames == 1


def test_a_slow_clip_is_linked(tmp_path):
    assert len(load_people(write_openpose(tmp_path / "json", alone()), fps=0.1)) == 1


# ---------------------------------------------------------------------- several people


def test_people_are_linked_and_sorted_by_how_much_is_seen(tmp_path):
    a, b, ghost = person(8, confidence=0.6), person(8, at=(900.0, 300.0), confidence=0.9), person(8, at=(1800.0, 99.0))
    order = np.random.default_rng(3).permuted(np.tile(np.arange(2), (8, 1)), axis=1)
    detections = [[(a[t], b[t])[i] for i in order[t]] for t in range(8)]
    detections[5].insert(0, ghost[5])
    folder = write_openpose(tmp_path / "json", detections)
    people = load_people(folder)
    assert len(people) == 3
    assert np.allclose(numbers(people[0]), b)
    assert np.allclose(numbers(people[1]), a)
    assert people[2].seen.any(1).tolist() == [t == 5 for t in range(8)]
    assert np.allclose(numbers(load_tracks(folder, person=1)), a)
    chosen = load_tracks(folder)
    assert np.allclose(numbers(chosen), b)
    assert "3 people" in chosen.notes[-1]
    with pytest.raises(FormatError, match=r"person: expected 0 to 2, as there are 3 people, got 3"):
        load_tracks(folder, person=3)


def test_people_below_the_threshold_are_left_out(tmp_path):
    faint = person(at=(900.0, 300.0), confidence=0.2)
    folder = write_openpose(tmp_path / "json", [[p, q] for p, q in zip(person(), faint, strict=True)])
    people = load_people(folder)
    assert len(people) == 1
    assert any("1 people never reach" in n for n in people[0].notes)
    assert len(load_people(folder, threshold=0.1)) == 2
    assert [one.source for one in load_people(folder, threshold=0.1)] == [f"{folder}, person {k}" for k in (0, 1)]
    assert load_tracks(folder, person=1, threshold=0.1).source == f"{folder}, person 1"
    with pytest.raises(ShapeError, match="lower the threshold"):
        load_people(folder, threshold=0.95)


# ---------------------------------------------------------------------- names of files


def test_other_files_are_left_out(tmp_path):
    folder = write_openpose(tmp_path / "json", alone())
    (folder / "readme.txt").write_text("recorded on Monday")
    (folder / ".hidden.json").write_text("no JSON at all")
    tracks = load_tracks(folder)
    assert tracks.num_frames == 4
    assert "1 file that is not .json is left out" in tracks.notes
    (folder / "more.txt").write_text("and on Tuesday")
    assert "2 files that are not .json are left out" in load_tracks(folder).notes


def test_two_recordings_in_a_folder_are_chosen_by_the_beginning_of_the_names(tmp_path):
    folder = write_openpose(tmp_path / "json", alone(), name="cam1_{:012d}_keypoints.json")
    write_openpose(folder, alone(6, at=(900.0, 900.0)), name="cam2_{:012d}_keypoints.json")
    with pytest.raises(FormatError, match=r"2 kinds of file names: give .*cam1_\*' or .*cam2_\*'"):
        load_tracks(folder)
    assert load_tracks(folder / "cam1_").num_frames == 4
    assert load_tracks(folder / "cam2_*").num_frames == 6
    assert load_tracks(folder / "cam2*.json").num_frames == 6


def test_frames_that_begin_elsewhere_are_told(tmp_path):
    folder = write_openpose(tmp_path / "json", alone(), name="v_{}_keypoints.json", frames=range(500, 504))
    assert "frame 0 is file v_500_keypoints.json" in load_tracks(folder).notes


def test_two_files_of_one_frame_are_told(tmp_path):
    folder = write_openpose(tmp_path / "json", alone(), name="f{}.json")
    (folder / "f02.json").write_text((folder / "f2.json").read_text())
    with pytest.raises(FormatError, match=r"one file a frame, got f0?2.json and f0?2.json"):
        load_tracks(folder)


def test_a_copy_in_the_folder_is_named(tmp_path):
    folder = write_openpose(tmp_path / "json", alone(), name="f{}.json")
    (folder / "f2 (1).json").write_text((folder / "f2.json").read_text())
    said = "'f2 (1).json' holds no frame number, unlike the other file names"
    assert any(note.startswith(said) for note in load_tracks(folder).notes)


# ---------------------------------------------------------------------- files that are none


def test_a_folder_without_tracks(tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(FormatError, match="empty"):
        load_tracks(tmp_path / "empty")
    (tmp_path / "empty" / "a.txt").write_text("hello")
    with pytest.raises(FormatError, match=r"a folder without tracks \(1 files: .txt\)"):
        load_tracks(tmp_path / "empty")
    with pytest.raises(FormatError, match=r"expected a folder of OpenPose \.json files, got .txt"):
        load_tracks(tmp_path / "empty", format="openpose")


BROKEN = [
    ("", "does not parse"),
    ("{", "does not parse"),
    ('{"people": [{"pose_keypoints_2d": [1, 2', "does not parse"),
    ("\x00\x01", "does not parse"),
    ("[" * 100_000, "nested too deep"),
    ('{"people": [{"pose_keypoints_2d": [' + "9" * 5000 + "]}]}", "does not parse"),
    ("[]", "other JSON"),
    ("{}", "other JSON"),
    ('{"people": {"a": 1}}', "other JSON"),
    ('{"people": [3]}', "other JSON"),
    ('{"people": [{"pose_keypoints_2d": {"x": 1}}]}', "expected a list of numbers.*, got an object"),
    ('{"people": [{"pose_keypoints_2d": ["1", "2", "3"]}]}', "number 0: expected a number, got text"),
    ('{"people": [{"pose_keypoints_2d": [1, true, 1]}]}', "number 1: expected a number, got true or false"),
    ('{"people": [{"pose_keypoints_2d": [1, null, 1]}]}', "number 1: expected a number, got null"),
    ('{"people": [{"pose_keypoints_2d": [1, 2]}]}', "3 numbers a joint"),
    ('{"people": [{"pose_keypoints_2d": [1, 2, 1]}]}', "expected 75 numbers a person as in clip_000000000000"),
    ('{"people": [{"pose_keypoints_2d": [1, 2, -0.5]}]}', "joint 0 has a negative confidence -0.5"),
    ('{"people": [{"pose_keypoints_2d": [Infinity, 2, 1]}]}', "number 0 is inf"),
    ('{"people": [{"pose_keypoints_2d": [1, -1e300, 1]}]}', "number 1 is -1e"),
]


@pytest.mark.parametrize(("text", "message"), BROKEN)
def test_a_broken_frame_is_named(tmp_path, text, message):
    folder = write_openpose(tmp_path / "json", alone())
    (folder / "clip_000000000002_keypoints.json").write_text(text)
    with pytest.raises(FormatError, match=message) as caught:
        load_tracks(folder)
    assert "clip_000000000002_keypoints.json" in str(caught.value)


def test_nobody_anywhere(tmp_path):
    with pytest.raises(FormatError, match="expected people in at least one of 3 files"):
        load_tracks(write_openpose(tmp_path / "json", [[], [], []]))


def test_hands_and_faces_are_left_out_and_told(tmp_path):
    folder = write_openpose(tmp_path / "json", alone())
    for file in folder.iterdir():
        data = json.loads(file.read_text())
        data["people"][0]["hand_left_keypoints_2d"] = [1.0] * 63
        file.write_text(json.dumps(data))
    tracks = load_tracks(folder)
    assert tracks.skeleton.name == "body25"
    assert any("hand" in n for n in tracks.notes)


def check_answer(path):
    """The file gives tracks of finite numbers, or an error of ours."""
    try:
        people = load_people(path, format="openpose")
    except KcsError:
        return
    assert all(torch.isfinite(p.points).all() and torch.isfinite(p.weights).all() for p in people)


@quick
@given(data=st.data())
def test_flipped_bytes_give_tracks_or_our_errors(tmp_path, data):
    folder = tmp_path / "json"
    if not folder.exists():
        write_openpose(folder, [[p, q] for p, q in zip(person(3), person(3, at=(900.0, 9.0)), strict=True)])
        (tmp_path / "good").write_bytes((folder / "clip_000000000001_keypoints.json").read_bytes())
    raw = bytearray((tmp_path / "good").read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.sampled_from(b'0123456789eE.,-+[]{}":ntN\x00\xff '))
    (folder / "clip_000000000001_keypoints.json").write_bytes(raw[: data.draw(st.integers(0, len(raw)))])
    check_answer(folder)


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from(["people", "x"]), inner, max_size=3),
    max_leaves=8,
)
poses = st.lists(st.floats(-1e4, 1e4) | st.just(0.0) | st.floats(), min_size=45, max_size=45)


@quick
@given(st.lists(st.fixed_dictionaries({"pose_keypoints_2d": poses | json_values}) | json_values, max_size=4))
def test_any_json_gives_tracks_or_our_errors(tmp_path, people):
    (tmp_path / "f.json").write_text(json.dumps({"people": people}))
    check_answer(tmp_path / "f.json")


# ---------------------------------------------------------------------- real files


def test_real_folder_follows_the_main_person_through_every_frame(shared):
    """Two people; in frame 37 the detector splits one in two, in frames 4 to 8 and 15 the nose jumps to x = 0."""
    main, other, *ghosts = load_people(shared / "data/raw_formats/openpose/pose2sim_cam01_json")
    assert main.skeleton.name == "body25b"
    assert main.seen.any(1).all()
    assert other.seen.any(1).all()
    assert all(g.seen.any(1).sum() <= 1 for g in ghosts)
    neck = main.skeleton.index("UpperNeck")
    steps = main.points[:, neck].diff(dim=0).norm(dim=-1)[main.seen[1:, neck] & main.seen[:-1, neck]]
    assert steps.max() < 40  # of about 800 pixels of height: nobody else was taken for a frame
    assert (main.points[main.seen][:, 0] > 50).all()


def test_real_folder_of_three_people(shared):
    people = load_people(shared / "data/raw_formats/openpose/pose2sim_multiperson_cam01_json")
    frames = [int(p.seen.any(1).sum()) for p in people]
    assert frames[:3] == [40, 38, 40]
    assert all(f <= 1 for f in frames[3:])
