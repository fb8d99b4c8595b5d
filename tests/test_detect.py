"""Detection in videos, with stand-ins for OpenCV, MediaPipe, rtmlib and onnxruntime: what is asked of them, and what is
made of their answers. That the real ones answer so is tried by hand, as the tests do not install them.
"""

import json
import sys
from enum import IntEnum
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from command_line import run
from conftest import moving_body

import kcs_torch as kt
from kcs_torch.detect import DETECTORS, detect_video
from kcs_torch.detect.detector import EXTRAS
from kcs_torch.io.video import VIDEO_SUFFIXES, is_video, looks_like_video

WIDTH, HEIGHT, FRAMES = 640, 480, 40
MP4 = b"\x00\x00\x00\x18ftypmp42" + bytes(64)


def module(name, **members):
    made = ModuleType(name)
    made.__dict__.update(members)
    return made


class FakeCapture:
    """cv2.VideoCapture of a video whose frame k has k in its blue channel and 255 in its red one."""

    fps, frames, opened, size = 25.0, FRAMES, True, (WIDTH, HEIGHT)
    released = 0

    def __init__(self, path):
        assert Path(path).is_absolute()  # a relative name might be taken for a pattern or an address
        self.at = -1

    def isOpened(self):
        return self.opened

    def get(self, key):
        return {"width": self.size[0], "height": self.size[1], "fps": self.fps, "count": float(self.frames)}[key]

    def grab(self):
        self.at += 1
        return self.at < self.frames

    def retrieve(self):
        image = np.zeros((self.size[1], self.size[0], 3), np.uint8)
        image[..., 0], image[..., 2] = self.at, 255
        return True, image

    def release(self):
        type(self).released += 1


@pytest.fixture
def video(tmp_path, monkeypatch):
    """A file that begins like a video, and OpenCV that reads it."""
    capture = type("Capture", (FakeCapture,), {})
    cv2 = module(
        "cv2",
        VideoCapture=capture,
        CAP_PROP_FRAME_WIDTH="width",
        CAP_PROP_FRAME_HEIGHT="height",
        CAP_PROP_FPS="fps",
        CAP_PROP_FRAME_COUNT="count",
    )
    monkeypatch.setitem(sys.modules, "cv2", cv2)
    path = tmp_path / "clip.mp4"
    path.write_bytes(MP4)
    return SimpleNamespace(path=path, capture=capture, folder=tmp_path)


def moves(skeleton="mediapipe33"):
    """A moving body within the pictures: pixels (T, N, 2)."""
    body = kt.SKELETONS[skeleton]
    points = moving_body(body, FRAMES)[:, : body.num_observed, :2].numpy()
    points = points - points.mean((0, 1))
    return points * (150 / np.abs(points).max()) + [WIDTH / 2, HEIGHT / 2]


def landmarks(xy, visibility):
    return SimpleNamespace(
        landmark=[
            SimpleNamespace(x=x / WIDTH, y=y / HEIGHT, z=9.9, visibility=v)
            for (x, y), v in zip(xy, visibility, strict=True)
        ]
    )


@pytest.fixture
def mediapipe(monkeypatch):
    """MediaPipe that sees what ``answers.pose`` and ``answers.hands`` say of a frame's number."""
    answers = SimpleNamespace(pose=lambda k: None, hands=lambda k: None, closed=0, options=[])

    class Model:
        def __init__(self, which, **options):
            self.which = which
            answers.options.append(options)

        def process(self, image):
            assert image[0, 0, 0] == 255 and image.flags.c_contiguous  # red first
            found = getattr(answers, self.which)(int(image[0, 0, 2]))
            return SimpleNamespace(pose_landmarks=found, multi_hand_landmarks=found)

        def close(self):
            answers.closed += 1

    def names(skeleton):
        body = kt.SKELETONS[skeleton]
        upper = [name.upper() for name in body.joints[: body.num_observed]]
        return IntEnum("Landmark", {name: i for i, name in enumerate(upper)})

    pose = SimpleNamespace(Pose=lambda **o: Model("pose", **o), PoseLandmark=names("mediapipe33"))
    hands = SimpleNamespace(Hands=lambda **o: Model("hands", **o), HandLandmark=names("hand21"))
    monkeypatch.setitem(
        sys.modules, "mediapipe", module("mediapipe", solutions=SimpleNamespace(pose=pose, hands=hands))
    )
    return answers


# ---------------------------------------------------------------------- MediaPipe


def test_pose_comes_in_pixels_with_its_visibility(video, mediapipe):
    truth = moves()
    visibility = np.linspace(0, 1, 33)
    mediapipe.pose = lambda k: landmarks(truth[k], visibility)
    done = []
    (tracks,) = detect_video(video.path, progress=lambda k, total: done.append((k, total)))
    assert tracks.skeleton.name == "mediapipe33" and tracks.fps == 25 and tracks.units == "px"
    assert tracks.image_size == (WIDTH, HEIGHT)
    expected = 0.3 + 0.7 * visibility  # as of files
    np.testing.assert_allclose(tracks.weights[:, :33], np.broadcast_to(expected, (FRAMES, 33)))
    np.testing.assert_allclose(tracks.points[:, :33], truth, atol=1e-9)
    assert tracks.source == str(video.path)
    assert tracks.notes[0] == "MediaPipe Pose on 40 frames of 640 x 480 pixels"
    assert any("counts as confidence 0.3 + 0.7 v, and outside the image as 0" in note for note in tracks.notes)
    assert done == [(k + 1, FRAMES) for k in range(FRAMES)]
    assert mediapipe.closed == 1 and video.capture.released == 1
    assert mediapipe.options == [{"static_image_mode": False, "model_complexity": 1}]  # the model that is shipped


@pytest.mark.parametrize(("start", "stop", "told"), [(0, None, True), (5, 30, True), (5, 20, False), (0, 60, True)])
def test_a_video_that_breaks_off_is_told(video, mediapipe, start, stop, told):
    """Its 21st frame cannot be decoded."""
    truth = moves()
    mediapipe.pose = lambda k: landmarks(truth[k], np.ones(33))
    whole = video.capture.retrieve
    video.capture.retrieve = lambda self: (self.at != 20, whole(self)[1])
    (tracks,) = detect_video(video.path, start=start, stop=stop)
    early = f"only 20 of {FRAMES if stop is None else stop} frames could be read: the video ends there, or is damaged"
    assert (early in tracks.notes) == told and tracks.num_frames == 20 - start


def test_landmarks_outside_the_picture_are_unseen(video, mediapipe):
    truth = moves()
    truth[10, 15] = [-5, 100]
    truth[11, 16] = [100, HEIGHT + 1]
    mediapipe.pose = lambda k: landmarks(truth[k], np.ones(33))
    (tracks,) = detect_video(video.path)
    assert (~tracks.seen[:, :33]).nonzero().tolist() == [[10, 15], [11, 16]]


def test_frames_without_anybody_are_unseen(video, mediapipe):
    truth = moves()
    mediapipe.pose = lambda k: None if 20 <= k < 25 else landmarks(truth[k], np.ones(33))
    (tracks,) = detect_video(video.path)
    assert np.flatnonzero(~tracks.seen.any(1)).tolist() == [20, 21, 22, 23, 24]


def test_where_the_detector_goes_over_to_somebody_else_a_new_track_begins(video, mediapipe):
    truth = moves() * 0.4
    truth[25:] += [380, 200]
    mediapipe.pose = lambda k: landmarks(truth[k], np.ones(33))
    first, second = detect_video(video.path)
    assert np.flatnonzero(first.seen.any(1)).tolist() == list(range(25))
    assert np.flatnonzero(second.seen.any(1)).tolist() == list(range(25, 40))
    assert "in sight from frame 0 to 24 only: `kcs-torch lift --frames seen` leaves the rest out" in first.notes
    assert "in sight from frame 25 to 39 only: `kcs-torch lift --frames seen` leaves the rest out" in second.notes


def test_two_hands_are_followed(video, mediapipe):
    left, right = moves("hand21") * 0.3, moves("hand21") * 0.3 + [350, 100]
    pair = lambda k: [left[k], right[k]] if k % 2 else [right[k], left[k]]  # noqa: E731
    mediapipe.hands = lambda k: [landmarks(xy, np.zeros(21)) for xy in pair(k)]
    people = detect_video(video.path, what="hands")
    assert len(people) == 2 and all(p.skeleton.name == "hand21" and bool(p.seen.all()) for p in people)
    truth = sorted([left, right], key=lambda a: a[0, 0, 0])
    found = sorted((p.points.numpy() for p in people), key=lambda a: a[0, 0, 0])
    np.testing.assert_allclose(found, truth, atol=1e-9)


def test_a_part_of_the_video(video, mediapipe):
    truth = moves()
    mediapipe.pose = lambda k: landmarks(truth[k], np.ones(33))
    (tracks,) = detect_video(video.path, start=10, stop=22, fps=50)
    np.testing.assert_allclose(tracks.points[:, :33], truth[10:22], atol=1e-9)
    assert tracks.fps == 50 and "from frame 10" in tracks.notes[0]
    with pytest.raises(kt.FormatError, match="expected frames from 50, got a video of 40"):
        detect_video(video.path, start=50)


@pytest.mark.parametrize("fps", [0.0, float("nan"), 90000.0])
def test_a_video_without_a_rate(video, mediapipe, fps):
    truth = moves()
    mediapipe.pose = lambda k: landmarks(truth[k], np.ones(33))
    video.capture.fps = fps
    (tracks,) = detect_video(video.path)
    assert tracks.fps is None and "give fps=..." in tracks.notes[-1]


def test_another_skeleton_takes_its_joints_by_name(video, mediapipe):
    truth = moves()
    mediapipe.pose = lambda k: landmarks(truth[k], np.ones(33))
    (tracks,) = detect_video(video.path, skeleton="coco17")
    names = kt.SKELETONS["mediapipe33"].joints
    order = [names.index(j) for j in kt.SKELETONS["coco17"].joints[:17]]
    np.testing.assert_allclose(tracks.points[:, :17], truth[:, order], atol=1e-9)


def test_the_model_is_closed_when_something_goes_wrong(video, mediapipe):
    def fail(k):
        raise KeyboardInterrupt

    mediapipe.pose = fail
    with pytest.raises(KeyboardInterrupt):
        detect_video(video.path)
    assert mediapipe.closed == 1 and video.capture.released == 1


# ---------------------------------------------------------------------- rtmlib

KINDS = {
    "pose.onnx": ([1, 3, 256, 192], {"simcc_x": ["batch", 17, 384], "simcc_y": ["batch", 17, 512]}),
    "halpe.onnx": ([1, 3, 384, 288], {"simcc_x": [1, 26, 576], "simcc_y": [1, 26, 768]}),
    "whole.onnx": ([1, 3, 256, 192], {"simcc_x": [1, 133, 384], "simcc_y": [1, 133, 512]}),
    "hand.onnx": ([1, 3, 256, 256], {"simcc_x": [1, 21, 512], "simcc_y": [1, 21, 512]}),
    "odd.onnx": ([1, 3, 256, 192], {"simcc_x": [1, 14, 384], "simcc_y": [1, 14, 512]}),
    "rtmo.onnx": ([1, 3, 640, 640], {"dets": [1, "n", 5], "keypoints": [1, "n", 17, 3]}),
    "yolox.onnx": ([1, 3, 416, 640], {"dets": [1, "n", 5], "labels": [1, "n"]}),
    "rtmdet_m.onnx": ([1, 3, 640, 640], {"dets": [1, "n", 5], "labels": [1, "n"]}),
    "raw.onnx": ([1, 3, 640, 640], {"output": [1, 8400, 85]}),
    "classes.onnx": ([1, 3, 224, 224], {"probabilities": [1, 1000]}),
    "flexible.onnx": ([1, 3, "height", "width"], {"dets": [1, "n", 5]}),
}


@pytest.fixture
def rtmlib(monkeypatch, tmp_path):
    """rtmlib and onnxruntime as they answer for the files of KINDS."""
    calls = SimpleNamespace(opened=[], boxes=[], people=lambda k: [[0, 0, 9, 9]], poses=None)

    class Session:
        def __init__(self, path, providers):
            assert providers == ["CPUExecutionProvider"]
            if Path(path).read_bytes() != b"onnx":
                raise RuntimeError("INVALID_PROTOBUF: parsing failed\nand more")
            self.inputs, self.outputs = KINDS[Path(path).name]

        def get_inputs(self):
            return [SimpleNamespace(name="input", shape=self.inputs)]

        def get_outputs(self):
            return [SimpleNamespace(name=n, shape=s) for n, s in self.outputs.items()]

    def tool(kind):
        class Tool:
            def __init__(self, path, model_input_size, backend, device):
                print("load", path)  # as the real one does
                assert (backend, device) == ("onnxruntime", "cpu")
                calls.opened.append((kind, Path(path).name, model_input_size))

            def __call__(self, image, bboxes=None):
                assert image[0, 0, 2] == 255  # blue first
                frame = int(image[0, 0, 0])
                if kind in ("YOLOX", "RTMDet"):
                    return np.array(calls.people(frame), float)
                calls.boxes.append(bboxes)
                return calls.poses(frame)

        return Tool

    tools = {kind: tool(kind) for kind in ("RTMPose", "RTMO", "YOLOX", "RTMDet")}
    monkeypatch.setitem(sys.modules, "rtmlib", module("rtmlib", **tools))
    monkeypatch.setitem(sys.modules, "onnxruntime", module("onnxruntime", InferenceSession=Session))
    for name in KINDS:
        (tmp_path / name).write_bytes(b"onnx")
    calls.file = lambda name: tmp_path / name
    return calls


def crowd(truth, shifts, scores=0.9):
    """What a pose model gives: the motion at several places."""
    return lambda k: (np.stack([truth[k] + s for s in shifts]), np.full((len(shifts), truth.shape[1]), scores))


def test_rtmpose_after_a_person_detector(video, rtmlib, capsys):
    truth = moves("coco17") * 0.5
    rtmlib.people = lambda k: [] if k == 7 else [[1, 2, 3, 4], [5, 6, 7, 8]]
    rtmlib.poses = crowd(truth, ([0, 0], [300, 0]))
    people = detect_video(video.path, models=[rtmlib.file("pose.onnx"), rtmlib.file("yolox.onnx")])
    assert sorted(rtmlib.opened) == [("RTMPose", "pose.onnx", (192, 256)), ("YOLOX", "yolox.onnx", (416, 640))]
    assert len(rtmlib.boxes) == FRAMES - 1  # a picture without people is not taken for one whole person
    np.testing.assert_array_equal(rtmlib.boxes[0], [[1, 2, 3, 4], [5, 6, 7, 8]])
    found = sorted((p.points[:, :17].numpy() for p in people), key=lambda a: a[0, 0, 0])
    for points, shift in zip(found, (0, 300), strict=True):
        np.testing.assert_allclose(np.delete(points, 7, 0), np.delete(truth + np.array([shift, 0]), 7, 0), atol=1e-9)
    assert all(not p.seen[7].any() and float(p.weights.max()) == pytest.approx(0.9) for p in people)
    assert any("yolox.onnx is" in n or "by yolox.onnx, taken for a YOLOX model" in n for n in people[0].notes)
    assert capsys.readouterr().out == ""


def test_rtmdet_is_told_by_its_name_and_either_order_will_do(video, rtmlib):
    rtmlib.poses = crowd(moves("coco17"), ([0, 0],))
    for names in (["rtmdet_m.onnx", "pose.onnx"], ["raw.onnx", "pose.onnx"]):
        rtmlib.opened.clear()
        detect_video(video.path, detector="rtmlib", models=[rtmlib.file(n) for n in names])
        kind = "RTMDet" if "rtmdet" in names[0] else "YOLOX"
        assert (kind, names[0], (640, 640)) in rtmlib.opened


def test_rtmo_needs_no_person_detector(video, rtmlib):
    rtmlib.poses = crowd(moves("coco17") * 0.5, ([0, 0], [300, 0]), scores=1.2)
    people = detect_video(video.path, models=[rtmlib.file("rtmo.onnx")])
    assert len(people) == 2 and rtmlib.opened == [("RTMO", "rtmo.onnx", (640, 640))]
    assert float(people[0].weights.max()) == 1  # scores of these models may pass 1


@pytest.mark.parametrize(
    ("name", "joints", "skeleton", "what"),
    [("halpe.onnx", 26, "halpe26", "pose"), ("hand.onnx", 21, "hand21", "hands")],
)
def test_skeletons_follow_from_the_number_of_joints(video, rtmlib, name, joints, skeleton, what):
    truth = moves(skeleton)
    rtmlib.poses = crowd(truth, ([0, 0],))
    (tracks,) = detect_video(video.path, what=what, models=[rtmlib.file(name)])
    assert tracks.skeleton.name == skeleton
    np.testing.assert_allclose(tracks.points[:, :joints], truth, atol=1e-9)
    assert any("one person who fills it" in note for note in tracks.notes)


def test_whole_body_joints_are_taken_by_name(video, rtmlib):
    truth = np.tile(moves("coco17"), (1, 8, 1))[:, :133] + np.arange(133)[:, None]
    rtmlib.poses = crowd(truth, ([0, 0],))
    (tracks,) = detect_video(video.path, models=[rtmlib.file("whole.onnx")])
    body = kt.SKELETONS["wholebody63"]
    assert tracks.skeleton.name == body.name
    # COCO-WholeBody: 23 of body and feet, 68 of the face, then the hands, each with its root first.
    for joint, index in (("left_heel", 19), ("left_thumb1", 92), ("right_thumb1", 113), ("right_pinky_finger4", 132)):
        np.testing.assert_allclose(tracks.points[:, body.joints.index(joint)], truth[:, index], atol=1e-9)


RTMLIB_MISTAKES = {
    "no model": ([], "pose", "expected one or two ONNX files"),
    "three": (["pose.onnx"] * 3, "pose", "got 3"),
    "two poses": (["pose.onnx", "halpe.onnx"], "pose", "pose.onnx (finds a pose), halpe.onnx (finds a pose)"),
    "people only": (["yolox.onnx"], "pose", "yolox.onnx (finds people)"),
    "people before rtmo": (["yolox.onnx", "rtmo.onnx"], "pose", "rtmo.onnx (finds people and poses)"),
    "odd joints": (["odd.onnx"], "pose", "17, 21, 26, 133 joints, got 14"),
    "hands of a body": (["pose.onnx"], "hands", "leave out --what hands"),
    "pose of a hand": (["hand.onnx"], "pose", "add --what hands"),
    "something else": (["classes.onnx"], "pose", "got probabilities"),
    "no fixed size": (["flexible.onnx"], "pose", "of one size"),
}


@pytest.mark.parametrize("name", RTMLIB_MISTAKES)
def test_models_that_do_not_fit(video, rtmlib, name):
    files, what, message = RTMLIB_MISTAKES[name]
    with pytest.raises(kt.OptionError) as error:
        detect_video(video.path, detector="rtmlib", what=what, models=[rtmlib.file(f) for f in files])
    assert message in str(error.value)


def test_files_that_are_no_models(video, rtmlib):
    with pytest.raises(kt.FormatError, match=r"absent.onnx: expected an ONNX model, got no such file"):
        detect_video(video.path, models=["absent.onnx"])
    rtmlib.file("pose.onnx").write_bytes(b"other")
    with pytest.raises(kt.FormatError, match="cannot be read as an ONNX model: INVALID_PROTOBUF: parsing failed$"):
        detect_video(video.path, models=[rtmlib.file("pose.onnx")])


# ---------------------------------------------------------------------- mistakes


@pytest.mark.parametrize("name", DETECTORS)
def test_a_missing_detector_is_told_with_the_command(video, monkeypatch, name):
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(kt.OptionError, match="pip install ") as error:
        detect_video(video.path, detector=name, models=["a.onnx"] if name == "rtmlib" else [])
    assert f"extra '{EXTRAS[name]}'" in str(error.value) and name in str(error.value)


def test_the_commands_are_those_of_the_extras(root):
    import tomllib

    from kcs_torch.detect.detector import MEDIAPIPE

    extras = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    assert any(need.startswith(f"mediapipe=={MEDIAPIPE}") for need in extras[EXTRAS["mediapipe"]])
    assert {need.partition(">")[0] for need in extras[EXTRAS["rtmlib"]]} == {"rtmlib", "onnxruntime"}


def test_mediapipe_without_its_models(video, monkeypatch):
    monkeypatch.setitem(sys.modules, "mediapipe", module("mediapipe", __version__="0.10.35"))
    with pytest.raises(kt.OptionError, match=r"0\.10\.35 has no models: pip install mediapipe==0\.10\.21"):
        detect_video(video.path)


def test_nobody_is_an_error(video, mediapipe):
    with pytest.raises(kt.FormatError, match="MediaPipe Pose found nobody in 40 frames"):
        detect_video(video.path)


def test_a_video_that_cannot_be_decoded(video, mediapipe):
    video.capture.opened = False
    with pytest.raises(kt.FormatError, match="cannot be decoded"):
        detect_video(video.path)
    assert video.capture.released == 1


MISTAKES = {
    "detector": ({"detector": "mediapip"}, "did you mean 'mediapipe'"),
    "what": ({"what": "feet"}, "choices are hands, pose"),
    "models of mediapipe": ({"detector": "mediapipe", "models": ["a.onnx"]}, "brings its own models"),
    "frames": ({"start": 5, "stop": 5}, "got 5:5"),
    "negative frames": ({"start": -1}, "got -1:None"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_are_told(video, mediapipe, name):
    options, message = MISTAKES[name]
    with pytest.raises(kt.OptionError) as error:
        detect_video(video.path, **options)
    assert message in str(error.value)


def test_things_that_are_no_video(tmp_path):
    (tmp_path / "a.json").write_text("{}")
    with pytest.raises(kt.FormatError, match="expected a video"):
        detect_video(tmp_path / "a.json")
    with pytest.raises(kt.FormatError, match="got a folder"):
        detect_video(tmp_path)
    with pytest.raises(kt.FormatError, match="there is no such file"):
        detect_video("http://localhost/a.mp4")
    with pytest.raises(kt.FormatError, match="there is no such file"):
        detect_video("a\0.mp4")


# ---------------------------------------------------------------------- what a video is


@pytest.mark.parametrize(
    "head",
    [
        MP4,
        b"\x00\x00\x00\x14ftypqt  ",
        b"\x00\x00\x00\x08wide\x00\x00\x00\x00mdat",
        b"\x1a\x45\xdf\xa3rest",
        b"RIFF\x00\x00\x00\x00AVI LIST",
        b"\x00\x00\x01\xba",
        (b"\x47" + bytes(187)) * 3,
    ],
)
def test_videos_are_told_by_content(head, tmp_path):
    assert looks_like_video(head)
    (tmp_path / "noname").write_bytes(head)
    assert is_video(tmp_path / "noname")


@pytest.mark.parametrize(
    "head",
    [
        b"",
        b"{",
        b"PK\x03\x04",
        b"RIFF\x00\x00\x00\x00WAVE",
        b"\x00\x00\x00\x18ftypheic",
        b"GGGG",
        b"\x89HDF\r\n",
        b"scorer,",
    ],
)
def test_other_files_are_not(head, tmp_path):
    assert not looks_like_video(head)
    (tmp_path / "noname").write_bytes(head)
    assert not is_video(tmp_path / "noname")
    assert is_video(tmp_path / "noname") is is_video(tmp_path / "absent.mp4") is is_video(tmp_path) is False


def test_suffixes_help_where_content_says_nothing(tmp_path):
    for suffix in VIDEO_SUFFIXES:
        (tmp_path / f"a{suffix}").write_bytes(b"????")
        assert is_video(tmp_path / f"a{suffix.upper()}") or is_video(tmp_path / f"a{suffix}")


def test_no_file_of_tracks_is_taken_for_a_video(shared):
    files = [f for f in (shared / "data" / "raw_formats").rglob("*") if f.is_file()]
    assert files and not [f for f in files if is_video(f)]


def test_reading_a_video_as_tracks_says_what_to_do(video):
    with pytest.raises(kt.FormatError, match="got a video: find the joints in it first, with `kcs-torch detect"):
        kt.load_tracks(video.path)


# ---------------------------------------------------------------------- the command line


@pytest.fixture
def two_people(video, mediapipe):
    """One who moves, and another to whom the detector goes over."""
    truth = moves() * 0.4
    truth[25:] += [380, 200]
    mediapipe.pose = lambda k: landmarks(truth[k], np.ones(33))
    return truth


def test_detect_writes_what_load_tracks_reads(video, two_people):
    out = video.folder / "tracks.npz"
    done = run("detect", video.path, "-o", out)
    tracks = kt.load_tracks(out)
    assert tracks.skeleton.name == "mediapipe33" and tracks.fps == 25 and tracks.num_frames == FRAMES
    np.testing.assert_allclose(tracks.points[:25, :33], two_people[:25], atol=1e-6)
    for words in ("person 0 seen in 25 of 40 frames, 33 joints (mediapipe33), 25 frames a second", "2 people found"):
        assert words in done.stdout
    assert "MediaPipe Pose on 40 frames of 640 x 480 pixels" in tracks.notes


def test_detect_everybody(video, two_people):
    facts = json.loads(run("detect", video.path, "-o", video.folder / "t.npz", "--person", "all", "--json").stdout)
    assert [(p["person"], p["frames_seen"]) for p in facts["people"]] == [(0, 25), (1, 15)]
    assert kt.load_tracks(video.folder / "t_1.npz").seen.any(1).sum() == 15


def test_lift_of_a_video(video, two_people):
    out = video.folder / "walk.npz"
    words = ["--frames", "2:22", "-m", "sfam", "--gate", "--json"]
    (person,) = json.loads(run("lift", video.path, "-o", out, *words).stdout)["people"]
    assert person["frames"] == 20 and person["skeleton"] == "mediapipe33" and person["fps"] == 25
    assert any(note.startswith("MediaPipe Pose on 20 frames") for note in person["notes"])
    assert [note.split(":")[0] for note in person["cleaning"]] == ["gate"]
    np.testing.assert_allclose(kt.load_tracks(out).points[:, :33], two_people[2:22], atol=1e-6)


def test_lift_of_the_frames_in_which_somebody_is_in_sight(video, two_people):
    out = video.folder / "walk.npz"
    words = ["--person", 1, "--frames", "seen", "-m", "sfam", "--json"]
    (person,) = json.loads(run("lift", video.path, "-o", out, *words).stdout)["people"]
    assert person["cleaning"] == [
        "trim: frames 25 to 39 of 40; in the result and other notes the first of them is frame 0"
    ]
    np.testing.assert_allclose(kt.load_tracks(out).points[:, :33], two_people[25:], atol=1e-6)


def test_lift_of_a_video_by_ones_own_models(video, rtmlib):
    rtmlib.poses = crowd(moves("coco17"), ([0, 0],))
    words = ["--model", rtmlib.file("pose.onnx"), "--model", rtmlib.file("yolox.onnx"), "-m", "sfam", "--json"]
    done = run("lift", video.path, "-o", video.folder / "walk.npz", *words)
    (person,) = json.loads(done.stdout)["people"]
    assert person["skeleton"] == "coco17"


COMMAND_MISTAKES = {
    "suffix": (["detect", "VIDEO", "-o", "OUT.html"], "OutputError", "the suffix .npz"),
    "person": (["detect", "VIDEO", "-o", "OUT.npz", "--person", "7"], "FormatError", "as there are 2 people"),
    "person's name": (
        ["detect", "VIDEO", "-o", "OUT.npz", "--person", "bob"],
        "OptionError",
        "a number from 0, or all",
    ),
    "frames": (["detect", "VIDEO", "-o", "OUT.npz", "--frames", "9"], "OptionError", "such as 100:400"),
    "no video": (["detect", "absent.mp4", "-o", "OUT.npz"], "FormatError", "there is no such file"),
    "lift": (["lift", "VIDEO", "-o", "OUT.npz", "--detector", "yolo"], "OptionError", "choices are"),
    "lift's size": (["lift", "VIDEO", "-o", "OUT.npz", "--image-size", "9x9"], "OptionError", "which tells its own"),
    "lift's person": (["lift", "VIDEO", "-o", "OUT.npz", "--person", "2"], "FormatError", "as there are 2 people"),
}


@pytest.mark.parametrize("name", COMMAND_MISTAKES)
def test_mistakes_get_one_line_and_write_nothing(name, video, two_people):
    words, kind, hint = COMMAND_MISTAKES[name]
    place = {"VIDEO": video.path} | {w: video.folder / w for w in words if w.startswith("OUT")}
    done = run(*(place.get(w, w) for w in words), "--json", code=2)
    answer = json.loads(done.stdout)
    assert answer["type"] == kind and hint in answer["error"]
    assert done.stderr.count("\n") == 1
    assert [p.name for p in video.folder.iterdir()] == [video.path.name]


def test_lift_without_a_detector_names_the_extra(video, monkeypatch):
    monkeypatch.setitem(sys.modules, "mediapipe", None)
    done = run("lift", video.path, "-o", video.folder / "a.npz", code=2)
    assert "pip install mediapipe==0.10.21 (the extra 'detect')" in done.stderr and done.stderr.count("\n") == 1


def test_detect_refuses_to_replace_the_video(video, two_people):
    video.path.rename(video.folder / "clip.npz")
    done = run("detect", video.folder / "clip.npz", "-o", video.folder / "clip.npz", code=2)
    assert "replace" in done.stderr and (video.folder / "clip.npz").read_bytes() == MP4
