"""COCO keypoints: results and annotations, visibility, the file's own skeleton, videos, and files that are none."""

import numpy as np
import pytest
from samples import coco_annotations, numbers, person, write_json

from kcs_torch.errors import KcsError
from kcs_torch.io import detect_format, load_people, load_tracks
from kcs_torch.skeleton import SKELETONS, Skeleton

A, B = person(6, 17), person(6, 17, at=(900.0, 300.0), confidence=0.6)


def result(image, joints, **more):
    return {"image_id": image, "category_id": 1, "keypoints": np.ravel(joints).tolist(), "score": 0.9, **more}


# ---------------------------------------------------------------------- results


def test_results_of_two_people(tmp_path):
    people = [result(t, p[t]) for t in range(6) for p in ((A, B) if t % 2 else (B, A))]
    path = write_json(tmp_path / "results.json", people)
    assert detect_format(path) == "coco"
    a, b = load_people(path)
    assert np.allclose(numbers(a), A) and np.allclose(numbers(b), B)
    assert a.skeleton.name == "coco17"


def test_images_that_are_all_alike_tell_their_size(tmp_path):
    data = coco_annotations()
    for image in data["images"]:
        image |= {"width": 1280, "height": 720}
    path = write_json(tmp_path / "a.json", data)
    assert load_tracks(path).image_size == (1280, 720)
    assert load_tracks(path, image_size=(640, 480)).image_size == (640, 480)  # the caller goes before the file
    pixels = load_tracks(path).points
    for one in data["annotations"]:
        one["keypoints"] = (np.reshape(one["keypoints"], (-1, 3)) / [1280, 720, 1]).ravel().tolist()
    assert np.allclose(load_tracks(write_json(tmp_path / "b.json", data)).points, pixels)  # shares of it


@pytest.mark.parametrize("side", [0, -720, 720.5, "high", None, True, [720]])
def test_images_that_are_not_alike_or_of_no_size_tell_none(tmp_path, side):
    data = coco_annotations()
    for image in data["images"]:
        image |= {"width": 1280, "height": side}
    assert load_tracks(write_json(tmp_path / "a.json", data)).image_size is None
    for t, image in enumerate(data["images"]):
        image["height"] = 720 if t else 960
    assert load_tracks(write_json(tmp_path / "a.json", data)).image_size is None


def test_results_are_in_the_order_of_the_images(tmp_path):
    tracks = load_tracks(write_json(tmp_path / "a.json", [result(t + 500, A[t]) for t in (3, 0, 5, 1, 2)]))
    assert np.allclose(numbers(tracks)[[0, 1, 2, 3, 5]], A[[0, 1, 2, 3, 5]])
    assert not tracks.seen[4].any()
    assert "frame 0 is image 500" in tracks.notes


def test_ids_of_a_data_set_are_no_frame_numbers(tmp_path):
    tracks = load_tracks(write_json(tmp_path / "a.json", [result(t**9 * 97, A[t]) for t in range(6)]))
    assert np.allclose(numbers(tracks), A)
    assert any("too far apart" in n for n in tracks.notes)


# ---------------------------------------------------------------------- annotations


def test_annotations_bring_their_own_skeleton(tmp_path):
    data = coco_annotations(names=("hip", "knee", "foot"), skeleton=((1, 2), (2, 3), (3, 2)))
    path = write_json(tmp_path / "instances.json", data)
    assert detect_format(path) == "coco"
    tracks = load_tracks(path)
    assert tracks.skeleton.joints == ("hip", "knee", "foot")
    assert tracks.skeleton.bones == ((0, 1), (1, 2))  # counted from 1 in the file
    assert np.allclose(tracks.points, person(4, 3)[..., :2])
    assert (tracks.weights == 1).all()


def test_the_users_skeleton_goes_before_the_files_own(tmp_path):
    """Some programs count the joints of a category's links from 0."""
    path = write_json(tmp_path / "a.json", coco_annotations(skeleton=((0, 1), (1, 2))))
    with pytest.raises(KcsError, match=r"counted 1..3, got \[0, 1\]: mend it, or give a skeleton \(--skeleton\)"):
        load_tracks(path)
    leg = Skeleton.from_names(["foot", "knee", "hip"], [("hip", "knee"), ("knee", "foot")])
    tracks = load_tracks(path, skeleton=leg)
    assert tracks.skeleton is leg
    assert np.allclose(tracks.points, person(4, 3)[:, ::-1, :2])


def test_names_of_a_known_skeleton_bring_its_tree(tmp_path):
    names = SKELETONS["coco17"].joints[:17]
    cyclic = [(6, 7), (6, 12), (7, 13), (12, 13)]
    tracks = load_tracks(write_json(tmp_path / "a.json", coco_annotations(names=names, skeleton=cyclic)))
    assert tracks.skeleton is SKELETONS["coco17"]


def test_hidden_joints_count_half(tmp_path):
    data = coco_annotations()
    data["annotations"][1]["keypoints"][2] = 1
    data["annotations"][2]["keypoints"][3:6] = [0, 0, 0]
    tracks = load_tracks(write_json(tmp_path / "a.json", data))
    assert tracks.weights[1].tolist() == [0.5, 1, 1]
    assert tracks.weights[2].tolist() == [1, 0, 1]
    assert any("1 (placed but hidden) as 0.5" in n for n in tracks.notes)


def test_images_without_anybody_are_frames(tmp_path):
    data = coco_annotations()
    del data["annotations"][1]
    tracks = load_tracks(write_json(tmp_path / "a.json", data))
    assert tracks.seen.any(1).tolist() == [True, False, True, True]


def test_frames_are_those_of_the_video_where_it_is_told(tmp_path):
    data = coco_annotations()
    for image, frame in zip(data["images"], (3, 2, 1, 0), strict=True):
        image |= {"frame_id": frame, "video_id": 1}
    tracks = load_tracks(write_json(tmp_path / "a.json", data))
    assert np.allclose(tracks.points, person(4, 3)[::-1, :, :2])


def test_several_videos_are_told(tmp_path):
    data = coco_annotations()
    for i, image in enumerate(data["images"]):
        image["video_id"] = i // 2
    assert any("of 2 videos" in n for n in load_tracks(write_json(tmp_path / "a.json", data)).notes)


def test_track_ids_are_used(tmp_path):
    data = coco_annotations(2)
    far = person(2, 3, at=(9000.0, 0.0), confidence=2)
    for t in range(2):
        data["annotations"][t]["track_id"] = 1 + t
        data["annotations"].append(result(70 + t, far[t], track_id=2 - t))
    first, second = load_people(write_json(tmp_path / "a.json", data))
    assert {tuple((p.points[:, 0, 0] > 5000).tolist()) for p in (first, second)} == {(False, True), (True, False)}


def test_the_commonest_category_is_read(tmp_path):
    data = coco_annotations()
    data["categories"].insert(0, {"id": 9, "name": "cat", "keypoints": ["nose", "tail"], "skeleton": [[1, 2]]})
    data["annotations"].append({**data["annotations"][0], "category_id": 9, "keypoints": [1, 2, 2, 3, 4, 2]})
    data["annotations"].append({"image_id": 70, "category_id": 1, "bbox": [0, 0, 1, 1]})  # a box only
    tracks = load_tracks(write_json(tmp_path / "a.json", data))
    assert tracks.skeleton.joints == ("hip", "knee", "foot")
    assert any("of 2 categories with joints the commonest is read: leg" in n for n in tracks.notes)


# ---------------------------------------------------------------------- files that are none


def changed(**parts):
    return {**coco_annotations(), **parts}


def category(**parts):
    return changed(categories=[{**coco_annotations()["categories"][0], **parts}])


BROKEN = [
    ([result(0, A[0]), {"keypoints": [1, 2, 3]}], "entry 1: 'image_id': expected a whole number, got None"),
    ([result(0.5, A[0])], "'image_id': expected a whole number, got 0.5"),
    ([result(10**400, A[0])], "'image_id': expected a whole number"),
    ([result(0, A[0]), result(1, A[1], keypoints=None)], r"entry 1 \(image 1\): 'keypoints': .*got null"),
    ([result(0, A[0]), result(1, A[1][:3])], "expected 17 joints of every person, got 3 in frame 1"),
    (changed(annotations=[]), "people in at least one of 4 frames"),
    (changed(annotations=None), "'annotations': expected a list, got null"),
    (changed(annotations=[3]), "'annotations': entry 0: expected an object"),
    (changed(images=[{"id": 1}, {"id": 1}]), "'images': entry 1: expected every image once, got id 1 again"),
    (changed(images=[{"id": "x"}]), "'images': entry 0: 'id': expected a whole number, got x"),
    (category(skeleton=[[1, 4]]), r"'skeleton': expected two different joints, counted 1..3, got \[1, 4\]"),
    (category(skeleton=[[0, 1]]), "'skeleton': expected two different joints"),
    (category(skeleton=[[2, 2]]), "'skeleton': expected two different joints"),
    (category(skeleton=[[1, 2, 3]]), "'skeleton': expected pairs"),
    (category(skeleton="x"), "'skeleton': expected pairs"),
    (category(keypoints=[1, 2, 3]), "'keypoints': expected a list of names"),
    (category(keypoints=["a", "b"]), "image 70: expected the 2 joints of the category, got 3"),
    (category(keypoints=["a", "a", "b"]), "given twice: a"),
]


@pytest.mark.parametrize(("data", "message"), BROKEN)
def test_what_is_none_is_told(tmp_path, data, message):
    path = write_json(tmp_path / "broken.json", data)
    with pytest.raises(KcsError, match=message) as caught:
        load_people(path, format="coco")
    assert "broken.json" in str(caught.value)
