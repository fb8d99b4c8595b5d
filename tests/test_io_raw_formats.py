"""The real files of people's detectors: recognised, read, every joint in its place, and the same after a round trip."""

import csv
import json

import numpy as np
import pytest
import torch

import kcs_torch as kt
from kcs_torch.io import detect_format, load_people, load_tracks
from kcs_torch.skeleton import SKELETONS

SIZE = (1088, 1920)  # of the video that the MediaPipe files are of

# Skeleton, frames, and the share of unseen joints of each person in per cent.
FILES = {
    "openpose/pose2sim_cam01_json": ("body25b", 100, [5.5, 18.8, 99.6]),
    "openpose/pose2sim_cam03_json": ("body25b", 100, [16.6]),
    "openpose/pose2sim_multiperson_cam01_json": ("body25b", 40, [16.0, 10.5, 18.8, 98.9]),
    "alphapose/figureskating_alphapose-results_first120.json": ("coco17", 120, [0.0, 94.3, 99.3, 99.6]),
    "coco/mmpose_test_coco.json": ("coco17", 4, [7.4, 55.9, 58.8, 55.9, 79.4, 76.5]),
    "coco/rewritten_keypoint_results_cam01.json": ("coco17", 60, [8.0, 98.6]),
    "mmpose/rewritten_results_cam01.json": ("coco17", 60, [8.0, 98.6]),
    "mediapipe/pose_landmarks_cam01.csv": ("mediapipe33", 100, [0.0]),
    "mediapipe/pose_landmarks_cam01.json": ("mediapipe33", 60, [0.0]),
}


def test_the_table_has_every_file(raw):
    kinds = {name.partition("/")[0] for name in FILES}
    there = {f"{kind}/{f.name}" for kind in kinds for f in (raw / kind).iterdir() if f.suffix != ".toml"}
    assert there == set(FILES)


@pytest.mark.parametrize("name", FILES)
def test_real_file(raw, tmp_path, name):
    skeleton, num_frames, unseen = FILES[name]
    assert detect_format(raw / name) == name.partition("/")[0]
    people = load_people(raw / name, image_size=SIZE)
    assert {p.skeleton for p in people} == {SKELETONS[skeleton]}
    assert {p.num_frames for p in people} == {num_frames}
    assert [round(100 * p.unseen_share, 1) for p in people] == unseen
    for person in people[:2]:
        again = load_tracks(kt.save(person, tmp_path / "again.npz"))
        assert torch.equal(again.points, person.points)
        assert torch.equal(again.weights, person.weights)
        assert again.skeleton == person.skeleton


@pytest.mark.parametrize("name", FILES)
def test_people_stand_upright(raw, name):
    """Joints are in their usual order up and down, so their names are right."""
    tracks = load_tracks(raw / name, image_size=SIZE)
    joints = {j.lower().replace("left_", "l").replace("right_", "r"): j for j in tracks.skeleton.joints}
    seen = tracks.seen.all(1) if "coco.json" in name else tracks.seen.any(1)

    def height(part):
        found = [tracks.skeleton.index(joints[f"{side}{part}"]) for side in "lr"]
        good = tracks.seen[:, found].all(1) & seen
        return tracks.points[good][:, found, 1].mean()

    below = [height(part) for part in ("shoulder", "hip", "knee", "ankle")]
    assert below == sorted(below)


def test_numbers_are_those_of_the_file(raw):
    entry = json.loads((raw / "alphapose/figureskating_alphapose-results_first120.json").read_text())[0]
    tracks = load_tracks(raw / "alphapose/figureskating_alphapose-results_first120.json")
    assert np.allclose(tracks.points[0, :17], np.reshape(entry["keypoints"], (17, 3))[:, :2])
    wrist = tracks.skeleton.index("left_wrist")
    assert np.allclose(tracks.weights[0, wrist], entry["keypoints"][3 * 9 + 2])


def test_the_same_clip_is_the_same_in_three_formats(raw):
    """The COCO and MMPose files hold what OpenPose found, except where it lists the other person first (frame 37)."""
    own = load_tracks(raw / "openpose/pose2sim_cam01_json")
    for name in ("coco/rewritten_keypoint_results_cam01.json", "mmpose/rewritten_results_cam01.json"):
        other = load_tracks(raw / name)
        assert other.seen.any(1).logical_not().nonzero().flatten().tolist() == [37]
        for joint, twin in other.skeleton.mapping_to(own.skeleton).items():
            j, k = own.skeleton.index(joint), other.skeleton.index(twin)
            both = own.seen[:60, j] & other.seen[:, k]
            assert torch.allclose(own.points[:60][both, j], other.points[both, k], atol=1e-3), joint


def test_csv_and_json_of_the_same_landmarks_agree(raw):
    table = load_tracks(raw / "mediapipe/pose_landmarks_cam01.csv", image_size=SIZE)
    nested = load_tracks(raw / "mediapipe/pose_landmarks_cam01.json", image_size=SIZE)
    assert torch.allclose(table.points[:60], nested.points, atol=2e-3)
    assert torch.allclose(table.weights[:60], nested.weights, atol=1e-5)
    with (raw / "mediapipe/pose_landmarks_cam01.csv").open() as file:
        row = next(csv.DictReader(file))
    nose = [float(row["nose_x"]) * SIZE[0], float(row["nose_y"]) * SIZE[1]]
    assert table.points[0, 0].tolist() == pytest.approx(nose)
    assert table.weights[0, 0].item() == pytest.approx(0.3 + 0.7 * float(row["nose_visibility"]))


def test_annotations_count_what_is_hidden_half(raw):
    data = json.loads((raw / "coco/mmpose_test_coco.json").read_text())
    people = load_people(raw / "coco/mmpose_test_coco.json")
    visible = [v for a in data["annotations"] for v in a["keypoints"][2::3]]
    weights = torch.cat([p.weights[:, :17].flatten() for p in people])
    assert [(weights == w).sum().item() for w in (0.5, 1)] == [visible.count(1), visible.count(2)]
    assert weights.unique().tolist() == [0, 0.5, 1]
