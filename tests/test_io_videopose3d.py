"""VideoPose3D's pickles: refused unless trusted, and even then nothing of them is run."""

import io
import os
import pickle
import pickletools
import subprocess
import sys
import zipfile

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from samples import person, write_videopose3d

from kcs_torch.errors import FormatError, KcsError
from kcs_torch.io import detect_format, load_people, load_tracks
from kcs_torch.io.containers.pickles import load_arrays, opened

A, B = person(6, 17)[..., :2], person(9, 17, at=(900.0, 300.0))[..., :2]


def member(value, protocol=4) -> bytes:
    """An .npy file of one pickled object."""
    array = np.empty((), object)
    array[()] = value
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": "|O", "fortran_order": False, "shape": ()})
    return file.getvalue() + pickle.dumps(array, protocol)


def write_raw(path, raw: bytes):
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("positions_2d.npy", raw)
    return path


# ---------------------------------------------------------------------- what is read


def test_it_is_refused_unless_trusted(tmp_path):
    path = write_videopose3d(tmp_path / "a.npz")
    assert detect_format(path) == "videopose3d"
    with pytest.raises(FormatError, match=r"a\.npz: .*run code as it is read.* trust=True .*--trust"):
        load_people(path)
    assert load_tracks(path, trust=True).num_frames == 4


def test_every_subject_action_and_camera_is_somebody(tmp_path):
    positions = {"S1": {"Walking 1": [A.astype("f4"), np.asfortranarray(B)]}, "S9": {"Eating": [A[:5].astype(">f8")]}}
    people = load_people(write_videopose3d(tmp_path / "a.npz", positions), trust=True)
    assert [(p.num_frames, p.source.partition("npz: ")[2]) for p in people] == [
        (9, "S1: Walking 1: camera 1"),
        (6, "S1: Walking 1: camera 0"),
        (5, "S9: Eating: camera 0"),
    ]
    for tracks, truth in zip(people, (B, A, A[:5]), strict=True):
        assert np.allclose(tracks.points, truth, atol=1e-3)
        assert tracks.skeleton.name == "h36m17"  # by the twins that the file names


@pytest.mark.parametrize(
    ("metadata", "name"),
    [
        ({"keypoints_symmetry": [[1, 3, 5, 7, 9, 11, 13, 15], [2, 4, 6, 8, 10, 12, 14, 16]]}, "coco17"),
        ({"keypoints_symmetry": np.array([[4, 5, 6, 11, 12, 13], [1, 2, 3, 14, 15, 16]])}, "h36m17"),
        ({"keypoints_symmetry": [[1], ["x"]]}, "coco17"),
        ({"keypoints_symmetry": 3}, "coco17"),
        ({"keypoints_symmetry": [[1, 2, 3]]}, "coco17"),
        ("text", "coco17"),
    ],
    ids=str,
)
def test_the_twins_tell_the_skeleton(tmp_path, metadata, name):
    path = write_videopose3d(tmp_path / "a.npz", {"clip.mp4": {"custom": [A]}}, metadata=metadata)
    tracks = load_tracks(path, trust=True)
    assert tracks.skeleton.name == name
    assert np.allclose(tracks.points[:, :17], A)


def test_a_video_tells_the_size_of_its_image(tmp_path):
    positions = {"a.mp4": {"custom": [A]}, "b.mp4": {"custom": [B]}, "c.mp4": {"custom": [A[:3]]}}
    videos = {"a.mp4": {"w": 1280, "h": 720}, "b.mp4": {"w": np.int64(1920), "h": np.float64(1080)}, "c.mp4": {"w": 0}}
    path = write_videopose3d(tmp_path / "a.npz", positions, metadata={"video_metadata": videos})
    assert [p.image_size for p in load_people(path, trust=True)] == [(1920, 1080), (1280, 720), None]
    assert load_tracks(path, trust=True, image_size=(1600, 900)).image_size == (1600, 900)
    for videos in (None, "none", {"a.mp4": "large"}, {"a.mp4": {"w": "x", "h": [1]}}, {3: {"w": 1280, "h": 720}}):
        path = write_videopose3d(tmp_path / "b.npz", positions, metadata={"video_metadata": videos})
        assert [p.image_size for p in load_people(path, trust=True)] == [None] * 3


@pytest.mark.parametrize("stray", [1.0, 5.0])
def test_shares_have_no_size(tmp_path, stray):
    """It was left out without a word where a joint was far away."""
    shares = A / 1000
    shares[0, 0] *= stray / shares[0, 0].max()
    path = write_videopose3d(tmp_path / "c.npz", {"S1": {"Walk": [shares]}})
    said = "the coordinates are shares of the image: they are taken as they are"
    assert said in load_tracks(path, trust=True).notes
    tracks = load_tracks(path, trust=True, image_size=(1600, 900))
    assert tracks.image_size is None and f"{said}, and the image's size is left out" in tracks.notes


def test_scores_are_confidences(tmp_path):
    path = write_videopose3d(tmp_path / "a.npz", {"S1": {"Walk": [person(4, 17)]}})
    assert np.allclose(load_tracks(path, trust=True).weights, 0.8)


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_every_protocol(tmp_path, protocol):
    positions = {"S1": {"Walk": [A.astype("f4"), A.astype("i8")]}, np.str_("S2"): {np.int64(3): (B,)}}
    people = load_people(write_raw(tmp_path / "a.npz", member(positions, protocol)), trust=True)
    assert [p.num_frames for p in people] == [9, 6, 6]
    assert np.allclose(people[0].points[:, :17], B)


# ---------------------------------------------------------------------- what is refused


class Evil:
    def __init__(self, function, *arguments):
        self.call = (function, arguments)

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize(
    ("raw", "message"),
    [
        (b"\x80\x02})" + b"\x85" * 10**6 + b"K\x01s.", "no texts"),  # a key whose hash would take all of the stack
        (b"\x80\x02})" + b"\x85" * 10**6 + b"K\x01d.", "is damaged"),
        (b"(" + b")" + b"\x85" * 10**6 + b"I1\nd.", "no texts"),
        (b"\x80\x04\x8f.", "a set"),
        (b"\x80\x04(K\x01\x91.", "a set"),
        (b"\x80\x02K\x01r\xff\xff\xff\xff.", "got int"),  # a memo of 2**32 places
        (b"K\x01p4294967295\n.", "got int"),
    ],
)
def test_pickles_that_crash_or_fill_the_memory_do_not(tmp_path, raw, message):
    header = b"{'descr': '|O', 'fortran_order': False, 'shape': (), }".ljust(117) + b"\n"
    array = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + raw
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as file:
        file.writestr("positions_2d.npy", array)
    with pytest.raises(FormatError, match=message):
        load_people(tmp_path / "a.npz", trust=True)


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
@pytest.mark.parametrize(
    "function", [os.system, os.mkdir, eval, getattr, subprocess.call, np.load], ids=lambda function: function.__name__
)
def test_nothing_is_run(tmp_path, protocol, function):
    canary = tmp_path / "canary"
    positions = {"S1": {"Walk": [A]}, "S2": Evil(function, f"touch {canary}")}
    path = write_raw(tmp_path / "a.npz", member(positions, protocol))
    with pytest.raises(FormatError, match=r"a\.npz: 'positions_2d': asks for .*, which is no array: refused"):
        load_people(path, trust=True)
    assert not canary.exists()


@pytest.mark.parametrize("wrong", [b"O8", b"V8", b"M8", b"f3", b"S99999", b"f8,O"])
def test_arrays_of_pointers_are_not_made(wrong):
    """numpy's own unpickling can be made to take the file's bytes for pointers."""
    raw = pickle.dumps(np.zeros(2), 4)
    changed = raw.replace(b"\x8c\x02f8", b"\x8c" + bytes([len(wrong)]) + wrong)
    assert changed != raw
    with pytest.raises(FormatError, match="^f: "):
        load_arrays(io.BytesIO(changed), "f")


def test_a_pickle_cannot_change_the_stand_ins():
    raw = pickle.dumps(np.zeros(2), 2)
    function = b"cnumpy.core.multiarray\n_reconstruct\n"
    build = function + b"}X\x01\x00\x00\x00aK\x01sb."  # sets an attribute of what find_class returned
    load_arrays(io.BytesIO(build), "f")
    from kcs_torch.io.containers import pickles

    assert not any(hasattr(f, "a") for f in pickles._STAND_INS.values())
    assert np.array_equal(load_arrays(io.BytesIO(raw), "f"), np.zeros(2))


@pytest.mark.parametrize(
    ("positions", "message"),
    [
        ({}, "arrays .frames, joints, 2., got none"),
        ({"S1": {"Walk": []}}, "got none"),
        (
            {"S1": {"Walk": [A[0]]}},
            r"S1: Walk: camera 0: expected an array of shape \(frames, joints, 2\), got \(17, 2\)",
        ),
        ({"S1": {"Walk": "x"}}, r"S1: Walk: expected .* arrays, got str"),
        ({"S1": {"Walk": [None]}}, "camera 0: expected .* arrays, got NoneType"),
        ({"S1": {"Walk": [A + 1e12]}}, "expected pixels, got numbers beyond"),
        ({"S1": {"Walk": [A * np.nan]}}, "no joint is seen"),
        ({"S1": {"Walk": [A[:, :9]]}}, "got 9, which the file does not name"),
        ({"S1": {"Walk": [[[[[A]]]]]}}, "a deeper nest"),
        ({"S1": {"Walk": [A] * 50}}, "claims 81600 bytes of arrays, more than it holds: refused"),
    ],
)
def test_what_is_none_is_told(tmp_path, positions, message):
    path = write_videopose3d(tmp_path / "broken.npz", positions)
    with pytest.raises(KcsError, match=message) as caught:
        load_people(path, trust=True)
    assert "broken.npz" in str(caught.value)


def test_a_nest_that_never_ends(tmp_path):
    level: list = []
    for _ in range(5):
        level = [level] * 100
    with pytest.raises(FormatError, match="100000 arrays: refused|deeper nest"):
        load_people(write_raw(tmp_path / "a.npz", member({"S1": level[0]})), trust=True)
    loop: list = []
    loop.append(loop)
    with pytest.raises(FormatError, match="deeper nest"):
        load_people(write_raw(tmp_path / "a.npz", member({"S1": loop})), trust=True)


def test_other_archives(tmp_path):
    np.savez(tmp_path / "a.npz", positions_2d=A)
    with pytest.raises(FormatError, match="'positions_2d': expected pickled objects, got an array of float64"):
        load_people(tmp_path / "a.npz", trust=True)
    np.savez(tmp_path / "b.npz", positions_3d=A)
    assert detect_format(tmp_path / "b.npz") == "npz"
    with pytest.raises(FormatError, match="expected an array 'positions_2d', got positions_3d"):
        load_people(tmp_path / "b.npz", format="videopose3d", trust=True)
    (tmp_path / "c.npz").write_bytes(b"PK\x03\x04 and no more")
    with pytest.raises(FormatError, match="damaged or truncated"):
        load_people(tmp_path / "c.npz", format="videopose3d", trust=True)


PICKLED = pickle.dumps({"S1": {"Walk": [A[:2].astype("f4"), np.array([1, 2])]}}, 2)
PLACES = [place for *_, place in pickletools.genops(PICKLED)]


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(st.tuples(st.sampled_from(PLACES) | st.integers(0, len(PICKLED) - 1), st.integers(0, 255)), max_size=4))
def test_damaged_pickles_give_a_value_or_our_error(changes):
    raw = bytearray(PICKLED)
    for place, byte in changes:
        raw[place] = byte
    try:
        found = load_arrays(io.BytesIO(bytes(raw)), "f")
    except FormatError as error:
        assert str(error).startswith("f: ") and len(str(error)) < 1000
    else:
        opened(found)


def test_loading_runs_no_import(tmp_path):
    """Modules that a pickle names are not even imported."""
    path = write_raw(tmp_path / "a.npz", member({"S1": Evil(os.system, "x")}).replace(b"posix", b"antig"))
    before = set(sys.modules)
    with pytest.raises(FormatError, match=r"asks for antig\.system"):
        load_people(path, trust=True)
    assert "antig" not in set(sys.modules) - before
