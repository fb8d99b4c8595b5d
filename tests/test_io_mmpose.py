"""MMPose predictions: frames, meta information, folders, and files that are none."""

import numpy as np
import pytest
from samples import mmpose_frames, numbers, person, write_json

from kcs_torch.errors import FormatError, KcsError
from kcs_torch.io import detect_format, load_people, load_tracks
from kcs_torch.io.contents.layout import names_of
from kcs_torch.skeleton import SKELETONS

H36M = (
    "root right_hip right_knee right_foot left_hip left_knee left_foot spine thorax neck_base head left_shoulder "
    "left_elbow left_wrist right_shoulder right_elbow right_wrist"
)
AP10K = (
    "L_Eye R_Eye Nose Neck Root_of_tail L_Shoulder L_Elbow L_F_Paw R_Shoulder R_Elbow R_F_Paw L_Hip L_Knee L_B_Paw "
    "R_Hip R_Knee R_B_Paw"
)


def with_meta(joints, **meta):
    return {"meta_info": meta, "instance_info": mmpose_frames(joints)}


def named(names, **meta):
    return with_meta(len(names), keypoint_id2name={str(i): n for i, n in enumerate(names)}, **meta)


def test_frames_are_counted_from_one(tmp_path):
    path = write_json(tmp_path / "a.json", mmpose_frames())
    assert detect_format(path) == "mmpose"
    tracks = load_tracks(path)
    assert np.allclose(numbers(tracks), person(4, 17))
    assert not any("frame 0" in n for n in tracks.notes)


def test_frames_without_anybody(tmp_path):
    frames = mmpose_frames()
    frames[1]["instances"] = []
    frames[2]["instances"] = [{"keypoints": [], "keypoint_scores": []}]
    tracks = load_tracks(write_json(tmp_path / "a.json", frames))
    assert tracks.seen.any(1).tolist() == [True, False, False, True]


def test_several_people_are_followed_and_track_ids_used(tmp_path):
    frames, far = mmpose_frames(), person(4, 17, at=(900.0, 300.0), confidence=0.6)
    for t, frame in enumerate(frames):
        frame["instances"].insert(
            t % 2,
            {"keypoints": far[t, :, :2].tolist(), "keypoint_scores": far[t, :, 2].tolist(), "bbox": [[0, 0, 9, 9]]},
        )
    a, b = load_people(write_json(tmp_path / "a.json", frames))
    assert np.allclose(numbers(a), person(4, 17)) and np.allclose(numbers(b), far)
    for frame in frames:
        for i, instance in enumerate(frame["instances"]):
            instance["track_id"] = i
    a, b = load_people(write_json(tmp_path / "a.json", frames))
    assert not np.allclose(numbers(a), person(4, 17))
    assert any("track ids" in n for n in a.notes)


@pytest.mark.parametrize(
    ("names", "skeleton"),
    [
        (SKELETONS["coco17"].joints[:17], "coco17"),
        (H36M.split(), "h36m17"),
        (names_of("wholebody63", 133), "wholebody63"),
    ],
    ids=["coco", "h36m", "wholebody"],
)
def test_names_tell_the_skeleton(tmp_path, names, skeleton):
    tracks = load_tracks(write_json(tmp_path / "a.json", named(names, dataset_name="something")))
    body = SKELETONS[skeleton]
    assert tracks.skeleton is body
    order = range(17) if len(names) == 17 else [names.index(j) for j in body.joints[:63]]
    assert np.allclose(numbers(tracks, body.num_observed), person(4, len(names))[:, order])


def test_the_data_set_tells_the_skeleton_where_names_do_not(tmp_path):
    for data in (with_meta(17, dataset_name="ap10k"), named(AP10K.split(), dataset_name="AP10K")):
        tracks = load_tracks(write_json(tmp_path / "a.json", data))
        assert tracks.skeleton.name == "ap10k"
        assert np.allclose(numbers(tracks), person(4, 17))


def test_unknown_names_bring_their_own_links(tmp_path):
    links = [[0, 1], [1, 2], [2, 1], [1, 9], [0, 0], "x", [0.5, 1]]  # what makes no sense is passed over
    tracks = load_tracks(write_json(tmp_path / "a.json", named(["snout", "neck", "tail"], skeleton_links=links)))
    assert tracks.skeleton.joints == ("snout", "neck", "tail")
    assert tracks.skeleton.bones == ((0, 1), (1, 2))


def test_meta_information_of_another_kind_is_passed_over(tmp_path):
    for meta in (None, 3, {"dataset_name": ["coco"]}, {"keypoint_id2name": {"0": "a"}}, {"dataset_name": "halpe26"}):
        data = {"meta_info": meta, "instance_info": mmpose_frames()}
        assert load_tracks(write_json(tmp_path / "a.json", data)).skeleton.name == "coco17"


def test_a_folder_with_a_file_an_image(tmp_path):
    (tmp_path / "predictions").mkdir()
    for t, frame in zip((3, 4, 6, 10), mmpose_frames(), strict=True):
        write_json(tmp_path / "predictions" / f"clip_{t}.json", frame["instances"])
    assert detect_format(tmp_path / "predictions") == "mmpose"
    tracks = load_tracks(tmp_path / "predictions")
    assert tracks.seen.any(1).nonzero().flatten().tolist() == [0, 1, 3, 7]
    assert np.allclose(numbers(tracks)[[0, 1, 3, 7]], person(4, 17))
    assert load_tracks(tmp_path / "predictions" / "clip_3.json").num_frames == 1


@pytest.mark.parametrize("nobody", [[], [{"keypoints": [], "keypoint_scores": []}]])
def test_the_first_images_of_a_folder_may_show_nobody(tmp_path, nobody):
    """Its files were taken for clips of their own."""
    for i, frame in enumerate(mmpose_frames(17)[:4]):
        write_json(tmp_path / f"{i:06d}.json", nobody if i < 2 else frame["instances"])
    assert detect_format(tmp_path) == "mmpose"
    assert load_tracks(tmp_path).seen.any(1).tolist() == [False, False, True, True]


def test_two_recordings_in_a_folder_are_told(tmp_path):
    """They were joined to one clip; cam1 is the beginning of cam10, too."""
    for name in ("cam1", "cam10"):
        for t, frame in enumerate(mmpose_frames()):
            write_json(tmp_path / f"{name}_{t}.json", frame["instances"])
    for path in (tmp_path, tmp_path / "cam1"):
        with pytest.raises(FormatError, match=r"2 kinds of file names: give .*cam10_\*' or .*cam1_\*'"):
            load_tracks(path)
    assert load_tracks(tmp_path / "cam1_").num_frames == 4


def test_a_copy_in_the_folder_is_named(tmp_path):
    for name, frame in zip(("a_1", "a_2", "a_2 (1)"), mmpose_frames(), strict=False):
        write_json(tmp_path / f"{name}.json", frame["instances"])
    said = "'a_2 (1).json' holds no frame number, unlike the other file names"
    assert any(note.startswith(said) for note in load_tracks(tmp_path).notes)


@pytest.mark.parametrize("whole", [lambda frames: frames, lambda frames: {"meta_info": {}, "instance_info": frames}])
def test_a_folder_with_the_file_of_a_video(tmp_path, whole):
    file = write_json(tmp_path / "results_1.json", whole(mmpose_frames()))
    with pytest.raises(FormatError, match=r"results_1\.json: expected the people of an image, got .* the file itself"):
        load_tracks(tmp_path)
    assert load_tracks(file).num_frames > 1


def with_third(third):
    frames = mmpose_frames()
    for frame in frames:
        for one in frame["instances"]:
            one["keypoints"] = [[*row, third(i, one)] for i, row in enumerate(one["keypoints"])]
    return frames


def test_3d_joints_are_refused(tmp_path):
    path = write_json(tmp_path / "a.json", with_third(lambda i, _: 0.1 * i - 0.2))
    with pytest.raises(FormatError, match=r"a\.json: frame 1: entry 0: 'keypoints': expected 2D joints, got 3D motion"):
        load_tracks(path)


THIRDS = [
    lambda i, one: one["keypoint_scores"][i],
    lambda i, one: 100 * one["keypoint_scores"][i],
    lambda i, one: round(one["keypoint_scores"][i], 1) + 0.04,
    lambda i, _: i % 3,
    lambda i, _: -1 if i % 5 == 0 else i / 15,
]


@pytest.mark.parametrize("third", THIRDS)
def test_rows_may_hold_scores_or_flags_again(tmp_path, third):
    tracks = load_tracks(write_json(tmp_path / "a.json", with_third(third)))
    assert np.allclose(numbers(tracks), person(4, 17))


def changed(**parts):
    first, second, *_ = mmpose_frames()
    return [first, {**second, **parts}]


BROKEN = [
    ({}, "expected a list, got null"),
    ({"instance_info": 3}, "expected a list, got a number"),
    ([3], "entry 0: expected an object"),
    ([{"frame_id": 1}], "entry 0: expected the people of a frame under 'instances'"),
    (changed(frame_id=1), "entry 1: expected every frame once, got frame_id 1 again"),
    (changed(frame_id="2"), "entry 1: 'frame_id': expected a whole number, got 2"),
    (changed(instances=None), "frame 2: expected a list, got null"),
    (changed(instances=[3]), "frame 2: entry 0: expected an object"),
    (changed(instances=[{"keypoints": [[1, 2], [3]]}]), "frame 2: entry 0: 'keypoints': .*rows of several lengths"),
    (changed(instances=[{"keypoints": [[1, 2]], "keypoint_scores": [1, 2]}]), "expected 1 scores"),
    (changed(instances=[{"keypoints": [[1, 2]], "keypoint_scores": [1]}]), "expected 17 joints .*got 1 in frame 1"),
    ([{"frame_id": 1, "instances": []}], "expected people in at least one of 1 frames"),
]


@pytest.mark.parametrize(("data", "message"), BROKEN)
def test_what_is_none_is_told(tmp_path, data, message):
    path = write_json(tmp_path / "broken.json", data)
    with pytest.raises(KcsError, match=message) as caught:
        load_people(path, format="mmpose")
    assert "broken.json" in str(caught.value)
    with pytest.raises(KcsError, match="MMPose .json files, got none"):
        (tmp_path / "other").mkdir()
        (tmp_path / "other" / "a.txt").write_text("x")
        load_people(tmp_path / "other", format="mmpose")
