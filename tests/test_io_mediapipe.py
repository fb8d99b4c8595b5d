"""MediaPipe landmarks: JSON, CSV and NPY; the size of the image, visibility, hands, and files that are none."""

import json

import numpy as np
import pytest
from samples import mediapipe_frames, person, write_json, write_mediapipe_csv, write_npy

from kcs_torch.errors import FormatError, KcsError
from kcs_torch.io import detect_format, load_motion, load_people, load_tracks
from kcs_torch.skeleton import SKELETONS, Skeleton

SIZE = (1000, 1000)
NAMES = SKELETONS["mediapipe33"].joints[:33]
HAND_NAMES = SKELETONS["hand21"].joints
POSE, HAND = person(4, 33), person(4, 21)
SEEN = 0.3 + 0.7 * 0.8  # the weight of the samples' visibility


def marks(pose, visibility=True):
    """One person's landmarks, shares of an image of 1000 pixels."""
    return [
        {"x": x / 1000, "y": y / 1000, "z": 0.0} | ({"visibility": v} if visibility else {})
        for x, y, v in np.asarray(pose).tolist()
    ]


def read(tmp_path, data, **options):
    path = write_json(tmp_path / "a.json", data)
    assert detect_format(path) == "mediapipe"
    return load_people(path, image_size=SIZE, **options)


def same(tracks, points):
    return np.allclose(tracks.points[:, : points.shape[1]], points[..., :2])


# ---------------------------------------------------------------------- size and visibility


def test_shares_of_the_image_need_its_size(tmp_path):
    path = write_json(tmp_path / "a.json", mediapipe_frames())
    with pytest.raises(FormatError, match=r"a\.json: .*image_size=\(width, height\) .*--image-size 1920x1080"):
        load_tracks(path)
    tracks = load_tracks(path, image_size=(1000, 500), fps=30)
    assert np.allclose(tracks.points[:, :33], POSE[..., :2] * [1, 0.5])
    assert (tracks.skeleton.name, tracks.fps, tracks.units) == ("mediapipe33", 30, "px")


def test_the_file_may_tell_the_size_and_the_rate(tmp_path):
    for sides in (
        {"width": 1000, "height": 500},
        {"image_size": [1000, 500]},
        {"image_width": 1000, "image_height": 500},
    ):
        path = write_json(tmp_path / "a.json", {**sides, "fps": 25, "frames": mediapipe_frames()})
        tracks = load_tracks(path)
        assert np.allclose(tracks.points[:, :33], POSE[..., :2] * [1, 0.5])
        assert (tracks.fps, tracks.image_size) == (25, (1000, 500))
    assert same(load_tracks(path, image_size=SIZE, fps=50), POSE)
    path = write_json(tmp_path / "a.json", {"width": -3, "height": "x", "fps": True, "frames": mediapipe_frames()})
    tracks = load_tracks(path, image_size=SIZE)
    assert (tracks.fps, tracks.image_size) == (None, SIZE)
    pixels = {"width": 1000, "height": 800, "frames": mediapipe_frames(size=1000)}
    assert load_tracks(write_json(tmp_path / "b.json", pixels)).image_size == (1000, 800)
    assert load_tracks(write_json(tmp_path / "b.json", pixels | {"width": True})).image_size is None


def test_pixels_stay_pixels(tmp_path):
    for size in (None, (640, 480)):
        tracks = load_tracks(write_json(tmp_path / "a.json", mediapipe_frames(size=1000)), image_size=size)
        assert same(tracks, POSE)
        assert tracks.image_size == size
        assert ("the coordinates are pixels already" in tracks.notes) == (size is None)


def test_what_is_hidden_is_not_unseen_unless_out_of_the_image(tmp_path):
    pose = POSE.copy()
    pose[0, 5, 2], pose[0, 6, 2], pose[0, 7, 2] = 0.0, 1.0, 0.5
    pose[0, 8] = 200, 1020, 0.2  # below the image's edge
    pose[0, 9] = 200, 1020, 0.9
    (tracks,) = read(tmp_path, [marks(p) for p in pose])
    assert tracks.weights[0, 5:10].tolist() == pytest.approx([0.3, 1.0, 0.65, 0.0, 0.9])
    assert tracks.weights[1, :33].numpy() == pytest.approx(SEEN)
    assert any(n.startswith("visibility v tells what is hidden") for n in tracks.notes)
    (strict,) = read(tmp_path, [marks(p) for p in pose], threshold=0.5)
    assert strict.weights[0, 5:8].tolist() == pytest.approx([0.0, 1.0, 0.65])


@pytest.mark.parametrize("visibility", [None, 0.0], ids=["absent", "zero everywhere"])
def test_no_visibility_is_full_confidence(tmp_path, visibility):
    pose = POSE if visibility is None else POSE * [1, 1, 0]
    (tracks,) = read(tmp_path, [marks(p, visibility is not None) for p in pose])
    assert (tracks.weights == 1).all()
    assert not any("visibility" in n for n in tracks.notes)


@pytest.mark.parametrize("key", ["confidence", "score", "likelihood", "prob"])
def test_confidences_are_weights_as_they_are(tmp_path, key):
    frames = [[{"x": m["x"], "y": m["y"], key: m["visibility"]} for m in marks(p)] for p in POSE]
    frames[0][5][key] = 0.1
    (tracks,) = read(tmp_path, frames)
    assert tracks.weights[0, 4:7].tolist() == pytest.approx([0.8, 0, 0.8])
    assert not any("visibility" in n for n in tracks.notes)
    text = write_mediapipe_csv(tmp_path / "a.csv").read_text().replace("_visibility", f"_{key}")
    (tmp_path / "a.csv").write_text(text)
    assert load_tracks(tmp_path / "a.csv", image_size=SIZE, threshold=0.8).weights.numpy() == pytest.approx(0.8)
    with pytest.raises(KcsError, match="no joint has a confidence of 0.9"):
        load_tracks(tmp_path / "a.csv", image_size=SIZE, threshold=0.9)


# ---------------------------------------------------------------------- JSON

LAYOUTS = {
    "dictionaries": lambda p: {"pose_landmarks": marks(p)},
    "web": lambda p: {"poseLandmarks": marks(p), "poseWorldLandmarks": marks(p)},
    "tasks, a list a person": lambda p: {"pose_landmarks": [marks(p)], "pose_world_landmarks": [marks(p)]},
    "web tasks": lambda p: {"pose_landmarks": [{"landmarks": marks(p)}]},
    "message": lambda p: {"pose_landmarks": {"landmark": marks(p)}},
    "numbers": lambda p: {"pose_landmarks": [[m["x"], m["y"], m["z"], m["visibility"]] for m in marks(p)]},
    "by name": lambda p: {"pose_landmarks": {n.upper(): m for n, m in zip(NAMES, marks(p), strict=True)}},
    "in JavaScript": lambda p: {"landmarks": [marks(p)], "worldLandmarks": [marks(p)]},
    "bare": lambda p: marks(p),
    "bare, a list a person": lambda p: [marks(p)],
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_every_layout_of_json(tmp_path, name):
    (tracks,) = read(tmp_path, [LAYOUTS[name](p) for p in POSE])
    assert same(tracks, POSE)
    assert tracks.weights.numpy() == pytest.approx(SEEN)


def test_frames_that_are_bare_or_lines(tmp_path):
    rows = [[[m["x"], m["y"], m["z"], m["visibility"]] for m in marks(p)] for p in POSE]
    hands = [[[r[:3] for r in row[:21]], [r[:3] for r in row[-21:]]] for row in rows]
    (tracks,) = read(tmp_path, {str(t): marks(p) for t, p in enumerate(POSE)})
    assert same(tracks, POSE)
    for frames in (rows, [[], None, *rows], [[row] for row in rows]):
        (tracks,) = read(tmp_path, frames)
        assert same(tracks.frames(tracks.num_frames - 4, tracks.num_frames), POSE)
    assert len(read(tmp_path, hands)) == 2
    lines = "\n".join(json.dumps({"frame": t, "pose_landmarks": marks(p)}) for t, p in enumerate(POSE))
    (tmp_path / "a.jsonl").write_text(lines + "\n")
    assert same(load_tracks(tmp_path / "a.jsonl", image_size=SIZE), POSE)
    (tmp_path / "a.jsonl").write_text(lines[:-9])
    with pytest.raises(FormatError, match="does not parse: line 4: "):
        load_tracks(tmp_path / "a.jsonl", image_size=SIZE)


def test_hands_that_say_their_side_each(tmp_path):
    other = person(4, 21, at=(230.0, 320.0))
    frames = [
        {"hands": [{"handedness": s, "landmarks": marks(h, False)} for s, h in (("Left", a), ("Right", b))]}
        for a, b in zip(HAND, other, strict=True)
    ]
    a, b = read(tmp_path, frames)
    assert {same(a, HAND), same(b, HAND)} == {same(a, other), same(b, other)} == {True, False}
    assert {a.notes[0], b.notes[0]} == {f"the file calls this one '{side}'" for side in ("left", "right")}


def test_frames_by_number(tmp_path):
    frames = {"3": {"pose_landmarks": marks(POSE[0])}, "10": {"pose_landmarks": marks(POSE[1])}}
    (tracks,) = read(tmp_path, {**frames, "5": {"pose_landmarks": None}})
    assert tracks.seen.any(1).nonzero().flatten().tolist() == [0, 7]
    assert any("frame 0 is image 3" in n for n in tracks.notes)
    (one,) = read(tmp_path, {"pose_landmarks": marks(POSE[0])})
    assert one.num_frames == 1


@pytest.mark.parametrize(
    ("key", "second", "told"),
    [("timestamp_ms", 1000, None), ("time", 1, None), ("timestamp", 1e6, "times are taken to count 1000000 a second")],
)
@pytest.mark.parametrize("since", [0.0, 1.7e9], ids=["the clip's beginning", "1970"])
def test_times_place_frames_and_tell_the_rate(tmp_path, key, second, told, since):
    frames = [{key: (since + i / 25) * second, "pose_landmarks": marks(POSE[0])} for i in (0, 1, 2, 4, 5)]
    (tracks,) = read(tmp_path, frames)
    assert tracks.fps == 25 and tracks.seen.any(1).tolist() == [True, True, True, False, True, True]
    assert told is None or told in tracks.notes
    (numbered,) = read(tmp_path, [{**frame, "frame": i} for i, frame in enumerate(frames[:3])])
    assert numbered.fps == 25 and numbered.num_frames == 3
    (said,) = read(tmp_path, {"fps": 24, "frames": frames})
    assert said.fps == 24 and said.num_frames == 6
    (lost,) = read(tmp_path, [*frames[:3], {key: None, "pose_landmarks": marks(POSE[0])}])
    assert lost.fps == 25 and lost.num_frames == 4


def test_the_rate_is_that_of_every_so_many_frames(tmp_path):
    frames = [{"frame": 5 * t, "pose_landmarks": marks(p)} for t, p in enumerate(POSE)]
    (tracks,) = read(tmp_path, {"fps": 30, "frames": frames})
    assert tracks.fps == 6 and tracks.num_frames == 4
    assert any("in steps of 5: each step is taken as one frame, at 1/5 of the video's fps" in n for n in tracks.notes)
    (told,) = read(tmp_path, {"fps": 30, "frames": frames}, fps=12)
    assert told.fps == 12
    timed = [{**frame, "timestamp_ms": 1000 * t / 6} for t, frame in enumerate(frames)]
    for rate in (6, 30):  # of these frames, or of all
        (tracks,) = read(tmp_path, {"fps": rate, "frames": timed})
        assert tracks.fps == 6


@pytest.mark.parametrize("nobody", [{"pose_landmarks": None}, {"pose_landmarks": []}, {"pose_landmarks": [[]]}])
def test_frames_without_anybody(tmp_path, nobody):
    (tracks,) = read(tmp_path, [nobody, *({"pose_landmarks": marks(p)} for p in POSE)])
    assert tracks.seen.any(1).tolist() == [False, True, True, True, True]


def test_several_people_are_followed(tmp_path):
    far = person(4, 33, at=(800.0, 700.0), confidence=0.5)
    frames = [[POSE[t], far[t]][:: 1 if t % 2 else -1] for t in range(4)]
    a, b = read(tmp_path, [{"pose_landmarks": [marks(p) for p in pair]} for pair in frames])
    assert same(a, POSE) and same(b, far)


def test_hands_without_a_pose(tmp_path):
    left = person(4, 21, at=(800.0, 500.0))
    pairs = zip(left, HAND, strict=True)
    frames = [{"left_hand_landmarks": marks(a * [1, 1, 0]), "right_hand_landmarks": marks(b)} for a, b in pairs]
    hands = read(tmp_path, frames)
    assert {h.skeleton.name for h in hands} == {"hand21"}
    assert any(same(h, HAND) for h in hands) and any(same(h, left) for h in hands)
    assert any("mirror the result of a left one" in n for n in hands[0].notes)
    right = SKELETONS["hand21"]
    own = Skeleton.from_edges(right.bones, [f"left_{joint}" for joint in right.joints])
    told = [n for hand in read(tmp_path, frames, skeleton=own) for n in hand.notes]
    assert not any("mirror the result" in n for n in told) and own.template != right.template


def test_handedness_tells_hands_apart(tmp_path):
    other = person(4, 21, at=(230.0, 320.0))
    frames = []
    for t in range(4):
        sides = [("Left", HAND[t]), ("Right", other[t])][:: 1 if t % 2 else -1]
        frames.append(
            {
                "hand_landmarks": [marks(h, False) for _, h in sides],
                "handedness": [[{"index": 0, "score": 0.9, "category_name": side}] for side, _ in sides],
            }
        )
    a, b = read(tmp_path, frames)
    assert {same(a, HAND), same(b, HAND)} == {same(a, other), same(b, other)} == {True, False}
    assert any("track ids" in n for n in a.notes)


# ---------------------------------------------------------------------- a person with hands

GUESSES = [f"{side}_{finger}" for side in ("left", "right") for finger in ("pinky", "index", "thumb")]
KEPT = [k for k, name in enumerate(NAMES) if name not in GUESSES]
LEFT, RIGHT = (HAND[..., :2] * [sign, 1] for sign in (-1, 1))
LEFT, RIGHT = (h - h[:, :1] + POSE[:, w, None, :2] for h, w in ((LEFT, 15), (RIGHT, 16)))
FACE = POSE[:, :1, :2] + np.random.default_rng(0).uniform(-5, 5, (1, 468, 2))
WHOLE = np.concatenate([POSE[:, KEPT, :2], LEFT, RIGHT], 1)
WHOLE_NAMES = [
    *(NAMES[k] for k in KEPT),
    *(f"{side}_hand_{joint}" for side in ("left", "right") for joint in HAND_NAMES),
]


def wide(points, *more):
    """Shares of the image, with further numbers of each landmark."""
    rest = [np.broadcast_to(m, points.shape[:2])[..., None] for m in more]
    return np.concatenate([points[..., :2] / 1000, *rest], -1)


def with_hands(key="{}_landmarks", inside=lambda m: m):
    both = zip(POSE, LEFT, RIGHT, strict=True)
    return [
        {
            key.format("pose"): inside(marks(p)),
            key.format("left_hand"): inside(marks(np.insert(a, 2, 0, -1))),
            key.format("right_hand"): inside(marks(np.insert(b, 2, 0, -1), False)),
        }
        for p, a, b in both
    ]


def test_a_pose_and_its_hands_are_one_person(tmp_path):
    """The hands were left out."""
    camel = [{f"{k.split('_')[0]}{'Hand' * ('hand' in k)}Landmarks": v for k, v in f.items()} for f in with_hands()]
    for frames in (
        with_hands(),
        with_hands("{}"),
        camel,
        with_hands(inside=lambda m: {"landmark": m}),
        with_hands("{}", lambda m: [[p["x"], p["y"], 0.1, *filter(None, [p.get("visibility")])] for p in m]),
    ):
        (tracks,) = read(tmp_path, frames)
        assert tracks.skeleton.joints[:69] == tuple(WHOLE_NAMES) and same(tracks, WHOLE)
        assert {"left_wrist-left_hand_wrist", "right_hand_ring_finger_dip-right_hand_ring_finger_tip"} < {
            *tracks.skeleton.bone_names
        }
        assert tracks.weights[:, :27].numpy() == pytest.approx(SEEN) and (tracks.weights[:, 27:69] == 1).all()
        assert any("guesses left_pinky, left_index, left_thumb, right_pinky" in n for n in tracks.notes)
        (pose,) = read(tmp_path, frames, skeleton="mediapipe33")
        assert pose.skeleton.name == "mediapipe33" and same(pose, POSE)
        hands = read(tmp_path, frames, skeleton="hand21")
        assert len(hands) == 2 and any(same(h, LEFT) for h in hands)


def test_a_hand_may_be_unseen_or_not_there(tmp_path):
    frames = with_hands()
    for frame in frames:
        del frame["left_hand_landmarks"]
        frame["face_landmarks"] = marks(np.insert(FACE[0], 2, 0, -1))
    frames[1]["right_hand_landmarks"] = None
    frames[2]["pose_landmarks"] = []
    (tracks,) = read(tmp_path, frames)
    own = [name for name in NAMES if name not in GUESSES[3:]]
    assert list(tracks.skeleton.joints[:51]) == own + WHOLE_NAMES[-21:]
    assert tracks.seen[:, :51].sum(1).tolist() == [51, 30, 21, 51]
    assert "the face is left out" in tracks.notes


def test_sides_of_a_mirror_are_those_of_the_wrists(tmp_path):
    frames = [
        {"pose_landmarks": [pose], "hand_landmarks": [a, b], "handedness": [[{"category_name": s}] for s in sides]}
        for sides in [("Right", "Left")]
        for pose, a, b in (f.values() for f in with_hands())
    ]
    (tracks,) = read(tmp_path, frames)
    assert same(tracks, WHOLE) and any("left and right hands are swapped" in n for n in tracks.notes)
    frames[1]["handedness"][0] = frames[1]["handedness"][1]
    (tracks,) = read(tmp_path, frames)
    assert tracks.seen[:, :69].sum(1).tolist() == [69, 27, 69, 69]
    assert any(n.startswith("hands of 1 frame are left out") for n in tracks.notes)


def test_hands_of_nobody_in_particular_are_left_out(tmp_path):
    frames = with_hands()
    unsided = [{"pose_landmarks": p, "hand_landmarks": [a, b]} for p, a, b in (f.values() for f in frames)]
    several = [{**frame, "pose_landmarks": [frame["pose_landmarks"]] * 2} for frame in frames]
    for other in (unsided, several):
        tracks = read(tmp_path, other)[0]
        assert same(tracks, POSE) and any("the hands are left out: only those of one" in n for n in tracks.notes)


FLAT = [wide(POSE, 0.1, 0.8).reshape(4, -1), *(wide(h, 0.1).reshape(4, -1) for h in (LEFT, RIGHT))]
ARRAYS = {
    "1662": np.concatenate([FLAT[0], wide(FACE, 0.1).reshape(4, -1), *FLAT[1:]], 1),
    "258": np.concatenate(FLAT, 1),
    "543, face first": np.concatenate([wide(h, -0.1) for h in (FACE, LEFT, POSE, RIGHT)], 1),
    "543, pose first": np.concatenate([wide(h, -0.1) for h in (POSE, FACE, LEFT, RIGHT)], 1),
    "543, without z": np.concatenate([wide(h) for h in (FACE, LEFT, POSE, RIGHT)], 1),
    "75 of 2": np.concatenate([wide(h) for h in (POSE, LEFT, RIGHT)], 1),
    "75 of 4": np.concatenate([wide(h, 0.1, v) for h, v in ((POSE, 0.8), (LEFT, 0), (RIGHT, 0))], 1),
    "225": np.concatenate([wide(h, -0.1) for h in (POSE, LEFT, RIGHT)], 1).reshape(4, -1),
}


@pytest.mark.parametrize("name", ARRAYS)
def test_npy_of_a_person_with_hands(tmp_path, name):
    array = ARRAYS[name]
    path = write_npy(tmp_path / "a.npy", array)
    (tracks,) = load_people(path, image_size=SIZE)
    assert tracks.skeleton.joints[:69] == tuple(WHOLE_NAMES) and np.allclose(tracks.points[:, :69], WHOLE)
    seen = SEEN if name in ("1662", "258", "75 of 4") else 1
    assert tracks.weights[:, :27].numpy() == pytest.approx(seen) and (tracks.weights[:, 27:69] == 1).all()
    assert ("the face is left out" in tracks.notes) == (name[:4] in ("1662", "543,"))
    assert same(load_tracks(path, image_size=SIZE, skeleton="mediapipe33"), POSE)


def test_npy_of_hands_that_are_not_there(tmp_path):
    array = ARRAYS["1662"].copy()
    array[:, -63:], array[1, -126:-63] = 0, 0
    (tracks,) = load_people(write_npy(tmp_path / "a.npy", array), image_size=SIZE)
    assert tracks.seen[:, :51].sum(1).tolist() == [51, 30, 51, 51]
    assert {*GUESSES[3:]} < {*tracks.skeleton.joints} and not {*GUESSES[:3]} & {*tracks.skeleton.joints}


@pytest.mark.parametrize("shape", [(4, 2, 21, 3), (4, 42, 3), (4, 126)])
def test_npy_of_two_hands(tmp_path, shape):
    array = np.concatenate([wide(LEFT, 0.2), wide(RIGHT, 0.2)], 1)
    a, b = load_people(write_npy(tmp_path / "a.npy", array.reshape(shape)), image_size=SIZE)
    assert {same(a, LEFT), same(b, LEFT)} == {same(a, RIGHT), same(b, RIGHT)} == {True, False}


def test_csv_of_numbered_landmarks_with_hands(tmp_path):
    (tmp_path / "a.csv").write_text(
        table([f"{c}{k}" for k in range(75) for c in "xy"], ARRAYS["75 of 2"].reshape(4, -1))
    )
    (tracks,) = load_people(tmp_path / "a.csv", image_size=SIZE)
    assert tracks.skeleton.joints[:69] == tuple(WHOLE_NAMES) and np.allclose(tracks.points[:, :69], WHOLE)


@pytest.mark.parametrize("names", ["numbers", "names"])
@pytest.mark.parametrize("visible", [True, False])
def test_csv_of_a_person_with_hands(tmp_path, names, visible):
    """Without visibilities it was called 3D motion."""
    parts = {"pose": (POSE, NAMES), "left_hand": (LEFT, HAND_NAMES), "right_hand": (RIGHT, HAND_NAMES)}
    head, columns = ["frame"], [np.arange(4)[:, None]]
    for part, (points, own) in parts.items():
        third = "xyzv" if visible and part == "pose" else "xyz"
        head += [f"{part}_{k if names == 'numbers' else name}_{c}" for k, name in enumerate(own) for c in third]
        columns.append(wide(points, 0.1, 0.8)[..., : len(third)].reshape(4, -1))
    (tmp_path / "a.csv").write_text(table(head, np.concatenate(columns, 1).tolist()))
    assert detect_format(tmp_path / "a.csv") == "mediapipe"
    with pytest.raises(FormatError, match="give image_size"):
        load_tracks(tmp_path / "a.csv")
    (tracks,) = load_people(tmp_path / "a.csv", image_size=SIZE)
    assert tracks.skeleton.joints[:69] == tuple(WHOLE_NAMES) and np.allclose(tracks.points[:, :69], WHOLE)
    assert tracks.weights[:, :27].numpy() == pytest.approx(SEEN if visible else 1)


def test_hands_on_another_body_are_no_landmarks(tmp_path):
    names = [*SKELETONS["coco17"].joints[:17], *(f"left_hand_{joint}" for joint in HAND_NAMES)]
    rows = person(4, 38)[..., :2].reshape(4, -1).tolist()
    (tmp_path / "a.csv").write_text(table([f"{name}_{c}" for name in names for c in "xy"], rows))
    assert detect_format(tmp_path / "a.csv") == "csv"
    assert list(load_tracks(tmp_path / "a.csv").skeleton.joints[:38]) == names


def long_table(parts):
    return [
        [t, *([f"{t}-{part}-{k}", part] if len(parts) > 1 else []), k, x / 1000, y / 1000, -0.1]
        for t in range(4)
        for part, points in parts.items()
        for k, (x, y) in enumerate(points[t, :, :2].tolist())
    ]


def test_long_csv_of_a_person_with_hands(tmp_path):
    """A table of a well-known contest."""
    head = ["frame", "row_id", "type", "landmark_index", "x", "y", "z"]
    rows = long_table({"face": FACE, "left_hand": LEFT, "pose": POSE, "right_hand": RIGHT})
    (tmp_path / "a.csv").write_text(table(head, rows))
    assert detect_format(tmp_path / "a.csv") == "mediapipe"
    (tracks,) = load_people(tmp_path / "a.csv", image_size=SIZE)
    assert tracks.skeleton.joints[:69] == tuple(WHOLE_NAMES) and np.allclose(tracks.points[:, :69], WHOLE)
    assert "the face is left out" in tracks.notes
    (tmp_path / "a.csv").write_text(table(head, [row for row in rows if "hand" in row[2]]))
    assert len(load_people(tmp_path / "a.csv", image_size=SIZE)) == 2


# ---------------------------------------------------------------------- tables


def test_csv(tmp_path):
    path = write_mediapipe_csv(tmp_path / "a.csv")
    assert detect_format(path) == "mediapipe"
    tracks = load_tracks(path, image_size=SIZE)
    assert same(tracks, POSE)
    assert tracks.weights.numpy() == pytest.approx(SEEN)


def test_csv_with_other_headers(tmp_path):
    text = write_mediapipe_csv(tmp_path / "a.csv").read_text()
    for change in (
        text.upper(),
        text.replace("_x", ".x").replace("_y", ".y").replace("_visibility", ".score"),
        text.replace(",", ";"),
        "\ufeff" + text.replace("frame", "frame_number"),
        text.replace("\r\n", "\n") + "\n",
    ):
        (tmp_path / "b.csv").write_text(change, encoding="utf-8", newline="")
        assert detect_format(tmp_path / "b.csv") == "mediapipe"
        assert same(load_tracks(tmp_path / "b.csv", image_size=SIZE), POSE)


def test_csv_of_numbered_landmarks(tmp_path):
    """As a popular tutorial writes them: pose and face in a row."""
    for count in (33, 501):
        header = ",".join(["class", *(f"{c}{i}" for i in range(1, count + 1) for c in "xyzv")])
        rows = [[x / 1000, y / 1000, 0, v] for pose in POSE for x, y, v in pose.tolist()]
        lines = [np.ravel(rows[33 * t : 33 * (t + 1)] + [[0.1, 0.1, 0, 0]] * (count - 33)).tolist() for t in range(4)]
        text = "\n".join([header, *("walk," + ",".join(map(str, line)) for line in lines)])
        (tmp_path / "a.csv").write_text(text)
        tracks = load_tracks(tmp_path / "a.csv", image_size=SIZE)
        assert same(tracks, POSE)
        assert any("the first 33 are read" in n for n in tracks.notes) == (count == 501)


@pytest.mark.parametrize(("count", "kind", "joints"), [(25, "csv", 25), (133, "csv", 133), (42, "mediapipe", 21)])
def test_numbered_joints_of_other_detectors_are_no_landmarks(tmp_path, count, kind, joints):
    """Those of BODY_25 were read as a hand's, those of two hands as a pose's."""
    rows = [pose[:, :2].ravel().tolist() for pose in person(4, count)]
    path = tmp_path / "a.csv"
    path.write_text(table([f"{axis}{i}" for i in range(count) for axis in "xy"], rows))
    tracks = load_tracks(path)
    assert (detect_format(path), tracks.skeleton.num_observed) == (kind, joints)
    assert np.allclose(tracks.points[:, :joints], person(4, count)[:, :joints, :2])
    assert any("the first 21 are read, as a hand" in n for n in tracks.notes) == (count == 42)


def table(columns, rows):
    return "\n".join([",".join(columns), *(",".join(map(str, row)) for row in rows)])


@pytest.mark.parametrize(
    ("joint", "names"), [("landmark", range(33)), ("landmark_index", range(1, 34)), ("name", NAMES)]
)
def test_long_csv_with_depths(tmp_path, joint, names):
    """They were called 3D motion."""
    names = list(names)
    rows = [[row[0], names[row[1]], *row[2:]] for row in long_table({"pose": POSE})]
    (tmp_path / "a.csv").write_text(table(["frame", joint, "x", "y", "z"], rows))
    assert detect_format(tmp_path / "a.csv") == "mediapipe"
    tracks = load_tracks(tmp_path / "a.csv", image_size=SIZE)
    assert tracks.skeleton.name == "mediapipe33" and same(tracks, POSE)
    assert load_motion(tmp_path / "a.csv", format="csv").num_frames == 4
    metres = [[*row[:2], 3 * (row[2] - 0.25), 3 * (row[3] - 0.35), row[4]] for row in rows]
    (tmp_path / "a.csv").write_text(table(["frame", "joint", "x", "y", "z"], metres))
    with pytest.raises(FormatError, match=r"3D motion \(csv\)"):
        load_tracks(tmp_path / "a.csv", image_size=SIZE)


def test_csv_of_some_landmarks(tmp_path):
    names = SKELETONS["coco17"].joints[:17]
    rows = [[t, *person(4, 17)[t].ravel().tolist()] for t in range(4)]
    text = table(["frame", *(f"{n}_{c}" for n in names for c in ("x", "y", "confidence"))], rows)
    (tmp_path / "a.csv").write_text(text)
    assert load_tracks(tmp_path / "a.csv").skeleton.name == "coco17"
    assert same(load_tracks(tmp_path / "a.csv"), person(4, 17))
    (tmp_path / "b.csv").write_text(text.replace("nose_", "mouth_left_"))
    tracks = load_tracks(tmp_path / "b.csv")
    assert tracks.skeleton.name == "mediapipe33"
    assert tracks.seen[0].sum() == 19  # with pelvis and neck
    assert np.allclose(tracks.points[:, 9], person(4, 17)[:, 0, :2])


@pytest.mark.parametrize("more", ["{}_world", "left_hand_{}"])
def test_the_pose_is_read_of_a_table_with_more_joints(tmp_path, more):
    """All were read as joints that move freely."""
    head = [f"{name}_{c}" for name in NAMES for c in ("x", "y", "z", "visibility")]
    head += [f"{more.format(name)}_{c}" for name in NAMES[:21] for c in "xyz"]
    rows = [[*(v for x, y, s in pose for v in (x / 1000, y / 1000, 0, s)), *[0.1] * 63] for pose in POSE]
    (tmp_path / "a.csv").write_text(table(head, rows))
    tracks = load_tracks(tmp_path / "a.csv", image_size=SIZE)
    assert tracks.skeleton.name == "mediapipe33" and same(tracks, POSE)
    assert tracks.notes[0].startswith(f"21 joints beside the pose left out: {more.format('nose')}, ")
    assert tracks.notes[1] == "columns of joints that are left out: z"


@pytest.mark.parametrize("prefix", ["landmark_", "pose_landmark_", "PoseLandmark."])
def test_landmarks_are_known_behind_a_prefix(tmp_path, prefix):
    """With z they were taken for 3D motion."""
    for names in (range(33), NAMES):
        head = [f"{prefix}{name}_{c}" for name in names for c in ("x", "y", "z", "visibility")]
        rows = [[v for x, y, s in pose for v in (x / 1000, y / 1000, 0, s)] for pose in POSE]
        (tmp_path / "a.csv").write_text(table(head, rows))
        tracks = load_tracks(tmp_path / "a.csv", image_size=SIZE)
        assert tracks.skeleton.name == "mediapipe33" and same(tracks, POSE)


def test_a_missing_column_is_told(tmp_path):
    header, *rows = [line.split(",") for line in write_mediapipe_csv(tmp_path / "a.csv").read_text().splitlines()]
    at = header.index("left_knee_y")
    (tmp_path / "b.csv").write_text(table(header[:at] + header[at + 1 :], [r[:at] + r[at + 1 :] for r in rows]))
    tracks = load_tracks(tmp_path / "b.csv", image_size=SIZE)
    assert "a column is missing, so its joint is left out: left_knee_y" in tracks.notes
    assert tracks.skeleton.name == "mediapipe33" and not tracks.seen[:, tracks.skeleton.index("left_knee")].any()
    a, b = at - 1, at + 2
    (tmp_path / "b.csv").write_text(table(header[:a] + header[b:], [r[:a] + r[b:] for r in rows]))
    lacking = "these joints of mediapipe33 have no columns x and y, so they are unseen: left_knee"
    assert lacking in load_tracks(tmp_path / "b.csv", image_size=SIZE).notes


def test_csv_of_several_people(tmp_path):
    far = person(4, 33, at=(800.0, 700.0), confidence=0.5)
    columns = ["frame", "person", *(f"{n}_{c}" for n in NAMES for c in ("x", "y", "visibility"))]
    rows = [[t, k, *pose[t].ravel().tolist()] for t in range(4) for k, pose in (("b", far), ("a", POSE))]
    (tmp_path / "a.csv").write_text(table(columns, rows))
    a, b = load_people(tmp_path / "a.csv")
    assert same(a, POSE) and same(b, far)


def test_blank_cells_are_unseen(tmp_path):
    lines = write_mediapipe_csv(tmp_path / "a.csv").read_text().splitlines()
    cells = lines[2].split(",")
    lines[2] = ",".join([cells[0], "", "nan", *cells[3:]])
    lines[3] = "2" + "," * (len(cells) - 1)
    (tmp_path / "a.csv").write_text("\n".join(lines))
    tracks = load_tracks(tmp_path / "a.csv", image_size=SIZE)
    assert tracks.seen[:, :33].sum(1).tolist() == [33, 32, 0, 33]


@pytest.mark.parametrize(
    ("array", "note"),
    [
        (POSE[:, :, [0, 1, 2, 2]], None),
        (POSE[:, :, [0, 1, 2, 2]].reshape(4, 132), None),
        (POSE[:, :, :2], None),
        (POSE.reshape(4, 99), "third number of each landmark"),
        (np.concatenate([POSE[:, :, [0, 1, 2, 2]].reshape(4, 132), np.zeros((4, 1530))], 1), "the face is left out"),
    ],
    ids=["4", "flat", "2", "3", "holistic"],
)
def test_npy(tmp_path, array, note):
    array = array.astype("f4")
    array[..., :2] = array[..., :2]
    path = write_npy(tmp_path / "a.npy", array)
    assert detect_format(path) == "mediapipe"
    tracks = load_tracks(path)
    assert np.allclose(tracks.points[:, :33], POSE[..., :2], atol=1e-3)
    assert note is None or any(note in n for n in tracks.notes)
    assert tracks.weights.numpy() == pytest.approx(1 if array.shape[-1] == 2 else SEEN)


def test_npy_of_depths_and_of_hands(tmp_path):
    deep = POSE.copy()
    deep[..., 2] = np.linspace(-0.5, 0.5, 33)
    assert (load_tracks(write_npy(tmp_path / "a.npy", deep)).weights == 1).all()
    for hand in (HAND[..., :2], HAND, HAND.reshape(4, 63)):  # a hand has no visibilities: the third is z
        tracks = load_tracks(write_npy(tmp_path / "a.npy", hand))
        assert same(tracks, HAND) and (tracks.weights == 1).all()
    blank = POSE.copy()
    blank[1] = np.nan
    assert load_tracks(write_npy(tmp_path / "a.npy", blank)).seen.any(1).tolist() == [True, False, True, True]


# ---------------------------------------------------------------------- files that are none

GOOD = {"frame": 0, "pose_landmarks": marks(POSE[0])}
BROKEN_JSON = [
    (3, "expected a list of frames with landmarks, got other JSON"),
    ([3], "frame 0: expected landmarks, got 3"),
    ([], "landmarks in at least one of 0 frames"),
    ([{"pose_landmarks": []}], "landmarks in at least one of 1 frames, got none"),
    ([{"a": 1}], r"frame 0: expected 'pose_landmarks' or 'hand_landmarks', got the keys a"),
    ([GOOD, GOOD], "frame 0: expected every frame once, got frame 0 again"),
    ([{**GOOD, "frame": "x"}], "entry 0: 'frame': expected a whole number, got x"),
    ([{"pose_landmarks": marks(POSE[0])[:20]}], "33 landmarks of a pose or 21 of a hand, got 20"),
    ([{"pose_landmarks": "abc"}], "expected a list of landmarks, got abc"),
    ([{"pose_landmarks": [1, 2]}], "expected a list of landmarks, got 1"),
    ([{"pose_landmarks": {"a": 1}}], "got an object with the keys a"),
    (
        [{"pose_landmarks": [*marks(POSE[0])[:32], {"x": 1}]}],
        "entry 32: expected a landmark with 'x' and 'y', got the keys",
    ),
    ([{"pose_landmarks": [*marks(POSE[0])[:32], 7]}], "entry 32: expected an object"),
    ([{"pose_landmarks": [*marks(POSE[0])[:32], {"x": "a", "y": 1}]}], "expected a number, got text"),
    ([{"pose_landmarks": [*marks(POSE[0])[:32], {"x": 1e300, "y": 1}]}], "is 1e"),
]


@pytest.mark.parametrize(("data", "message"), BROKEN_JSON)
def test_json_that_is_none_is_told(tmp_path, data, message):
    path = write_json(tmp_path / "broken.json", data)
    with pytest.raises(KcsError, match=message) as caught:
        load_people(path, format="mediapipe", image_size=SIZE)
    assert "broken.json" in str(caught.value)


def test_messages_within_messages_end(tmp_path):
    nest = marks(POSE[0])
    for _ in range(300):
        nest = {"landmark": nest}
    (tmp_path / "a.json").write_text(json.dumps([{"pose_landmarks": nest}]))
    with pytest.raises(FormatError, match="a.json"):
        load_people(tmp_path / "a.json", image_size=SIZE)


HEADER = ",".join(["frame", *(f"{n}_{c}" for n in NAMES for c in "xy")])
ROW = ",".join(["0.5"] * 66)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a,b\n1,2\n", "expected columns such as nose_x, nose_y, got 'a,b'"),
        (f"{HEADER}\n", "landmarks in at least one of 0 frames"),
        (f"{HEADER}\n0,{ROW}\n1,2\n", "row 3: expected 67 values as in the first row, got 2"),
        (f"{HEADER}\n0,{ROW}\n0,{ROW}\n", "row 3: expected every frame once, or a column 'person', got frame 0 again"),
        (f"{HEADER}\nx,{ROW}\n", "row 2: 'frame': expected a number, got 'x'"),
        (f"{HEADER}\n0.5,{ROW}\n", "row 2: 'frame': expected a whole number, got 0.5"),
        (f"{HEADER}\n,{ROW}\n", "row 2: 'frame': expected a whole number, got $"),
        (f"{HEADER}\n0,a{ROW}\n", "row 2: 'nose_x': expected a number, got 'a0.5'"),
        (f"{HEADER}\n0,inf{ROW[3:]}\n", "row 2: 'nose_x': expected a coordinate or a visibility, got inf"),
        (f"{HEADER}\n0,{'9' * 200_000},{ROW[4:]}\n", "text that does not parse"),
    ],
)
def test_csv_that_is_none_is_told(tmp_path, text, message):
    (tmp_path / "broken.csv").write_text(text)
    with pytest.raises(KcsError, match=message) as caught:
        load_people(tmp_path / "broken.csv", format="mediapipe", image_size=SIZE)
    assert "broken.csv" in str(caught.value)


def test_npy_that_is_none_is_told(tmp_path):
    def told(array, message, **options):
        path = tmp_path / "broken.npy"
        np.save(path, array, **options)
        with pytest.raises(KcsError, match=message):
            load_people(path, format="mediapipe", image_size=SIZE)
        return path.read_bytes()

    told(np.zeros((4, 17, 2)), r"\(frames, 33, 21, 42, 75 or 543, 2 to 5\), got shape \(4, 17, 2\)")
    told(np.array([{"a": 1}], object), "got none of numbers", allow_pickle=True)
    told(np.full((4, 33, 2), 1e12), "numbers beyond")
    told(np.full((4, 33, 2), np.inf), "numbers beyond")
    told(np.full((4, 33, 2), np.nan), "landmarks in at least one of 4 frames")
    good = told(np.zeros((4, 33, 2)), "landmarks in at least one of 4 frames")
    (tmp_path / "cut.npy").write_bytes(good[:-9])
    with pytest.raises(FormatError, match=r"cut\.npy: is damaged or truncated"):
        load_people(tmp_path / "cut.npy", image_size=SIZE)
    (tmp_path / "large.npy").write_bytes(good.replace(b"(4, 33, 2)", b"(999999999, 33, 2)")[: len(good)])
    with pytest.raises(FormatError, match=r"large\.npy"):
        load_people(tmp_path / "large.npy", format="mediapipe", image_size=SIZE)


def test_a_folder_is_none(tmp_path):
    (tmp_path / "a.csv").write_text(HEADER)
    with pytest.raises(FormatError, match="expected a file of landmarks, got a folder"):
        load_people(tmp_path, format="mediapipe", image_size=SIZE)
