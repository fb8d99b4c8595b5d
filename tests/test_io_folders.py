"""Natural order and frame numbers of a folder's files."""

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kcs_torch.errors import FormatError
from kcs_torch.io.folders import frame_numbers, frames_of_files, natural_key, sibling_files


def test_natural_order():
    names = ["f10.json", "f9.json", "f1.json", "f1b.json", "10.json", "9.json", "g.json"]
    expected = ["9.json", "10.json", "f1.json", "f1b.json", "f9.json", "f10.json", "g.json"]
    assert sorted(names, key=natural_key) == expected


@given(st.lists(st.text(max_size=8)))
def test_any_names_can_be_sorted(names):
    assert sorted(sorted(names, key=natural_key)) == sorted(names)


@pytest.mark.parametrize(
    ("numbers", "frames", "note"),
    [
        ([], [], None),
        ([12], [0], "frame 0 is file 12"),
        ([None], [0], None),
        ([0, 1, 2], [0, 1, 2], None),
        ([1, 2, 3], [0, 1, 2], None),
        ([5, 6, 7], [0, 1, 2], "frame 0 is file 5"),
        ([5, 6, 9], [0, 1, 4], "2 of 5 frames have no file (numbers 7, 8): unseen"),
        ([0, 5, 10], [0, 1, 2], "in steps of 5"),
        ([0, 5, 15], [0, 1, 3], "1 of 4 frames has no file (number 10): unseen"),
        ([None, 1, 2], [0, 1, 2], "no frame numbers"),
        ([3, 2, 4], [0, 1, 2], "the numbers of the file names do not ascend: frames are taken in the order"),
        ([7, 8, 8, 9], [0, 1, 2, 3], "number 8 stands for several of the file names: each of these is taken"),
        ([7, 7, 7, 9, 9], [0, 1, 2, 3, 4], "numbers 7, 9 stand for several"),
        ([1, 1700000000000, 1700000000001], [0, 1, 2], "too far apart"),
    ],
)
def test_frame_numbers(numbers, frames, note):
    notes = []
    found, step = frame_numbers(numbers, notes)
    assert found == frames and step == (5 if numbers[1:2] == [5] else 1)
    assert any(note in n for n in notes) if note else notes == []


def test_who_has_no_number_is_named():
    notes = []
    assert frame_numbers([1, 2, None, None], notes, called=["f1", "f2", "f2 (1)", "f2 copy"])[0] == [0, 1, 2, 3]
    assert notes[0].startswith("'f2 (1)', 'f2 copy' hold no frame number, unlike the other file names: frames are")
    frame_numbers([None, None], notes, called=["a", "b"])
    assert notes[1].startswith("the file names hold no frame numbers: ")


@given(st.lists(st.none() | st.integers(0, 10**30), max_size=20))
def test_frame_numbers_ascend_from_zero(numbers):
    frames, _ = frame_numbers(numbers, [])
    assert len(frames) == len(numbers)
    assert frames[:1] in ([], [0])
    assert all(a < b for a, b in itertools.pairwise(frames))
    assert max(frames, default=0) <= 20 * max(len(frames), 1)


def test_files_of_several_recordings_are_refused(tmp_path):
    names = lambda *names: [tmp_path / f"{name}.json" for name in names]  # noqa: E731
    assert frames_of_files(names("cam1_3_keypoints", "cam1_4", "cam1_7"), tmp_path, notes := []) == [0, 1, 4]
    assert notes[0] == "frame 0 is file cam1_3_keypoints.json"
    for several in (names("cam1_0", "cam10_0"), names("a_0", "a_1", "b_2")):
        with pytest.raises(FormatError, match=r"2 kinds of file names: give '.*_\*' or '.*_\*'"):
            frames_of_files(several, tmp_path, [])
    with pytest.raises(FormatError, match=r"expected one file a frame, got f2\.json and f02\.json"):
        frames_of_files(names("f1", "f2", "f02"), tmp_path, [])


def test_sibling_files(tmp_path):
    for name in ("cam1_2.json", "cam1_10.json", "cam2_1.json", ".hidden.json", "note[1].txt"):
        (tmp_path / name).write_text("")
    (tmp_path / "cam1_folder").mkdir()
    names = lambda path: [f.name for f in sibling_files(path)]  # noqa: E731
    assert names(tmp_path) == ["cam1_2.json", "cam1_10.json", "cam2_1.json", "note[1].txt"]
    assert names(tmp_path / "cam1") == ["cam1_2.json", "cam1_10.json"]
    assert names(tmp_path / "cam*_1*.json") == ["cam1_10.json", "cam2_1.json"]
    assert names(tmp_path / "note[") == ["note[1].txt"]
    assert names(tmp_path / "cam1_2.json") == names(tmp_path / "absent") == names(tmp_path / "x" / "y") == []
