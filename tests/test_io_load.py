"""Formats by content, the lists of formats, and choosing people."""

import gzip
import io
import pickle
import re
import shutil
import sys

import numpy as np
import pytest
from samples import SAMPLES

import kcs_torch as kt
from kcs_torch.errors import FormatError, OptionError, SkeletonError
from kcs_torch.io import READERS, WRITERS, Reader, Writer, detect_format, load_people, load_tracks
from kcs_torch.io.registry import Probe, need


@pytest.fixture
def samples(tmp_path):
    """One path of every format."""
    paths = {}
    for name, writers in SAMPLES.items():
        (folder := tmp_path / name).mkdir()
        paths[name] = writers[0](folder)
    return paths


def test_there_is_a_sample_of_every_format(samples):
    assert set(samples) == set(READERS)


def test_exactly_one_reader_recognises_each_sample(samples):
    for name, path in samples.items():
        assert [r.name for r in READERS.values() if r.recognises(Probe(path))] == [name]


def test_content_decides_and_not_the_name(samples, tmp_path):
    for name, path in samples.items():
        other = path.rename(tmp_path / f"{name}.csv")
        assert detect_format(other) == name
        assert load_tracks(other, trust=True).num_frames == 4


def test_every_format_takes_the_size_of_the_image(samples):
    """Also where the coordinates are pixels, which it left alone."""
    units = set()
    for name, path in samples.items():
        assert all(tracks.image_size is None for tracks in load_people(path, trust=True)), name
        for tracks in load_people(path, trust=True, image_size=(1920, 1080)):
            assert tracks.image_size == ((1920, 1080) if tracks.units == "px" else None), name
            assert not any("pixels already" in note or "lie outside" in note for note in tracks.notes), name
            units.add(tracks.units)
    assert "px" in units


def test_an_image_that_most_joints_lie_outside_is_none(samples):
    (tracks,) = load_people(samples["openpose"], image_size=(100, 200))
    told = "most joints lie outside an image of 100 x 200 pixels: its size (image_size, --image-size) is left out"
    assert tracks.image_size is None and any(note.startswith(told) for note in tracks.notes)


def test_lists_of_formats():
    assert all(isinstance(r, Reader) and r.name == name for name, r in READERS.items())
    assert all(isinstance(w, Writer) and w.suffix == suffix for suffix, w in WRITERS.items())
    for entry in [*READERS.values(), *WRITERS.values()]:
        assert entry.summary
        assert "\n" not in entry.summary


def test_a_new_format_is_one_new_file(tmp_path, monkeypatch):
    from kcs_torch.io import formats
    from kcs_torch.io.registry import discover

    (tmp_path / "morse.py").write_text(
        "from kcs_torch.io.registry import Reader\n"
        "READERS = (Reader('morse', 'dots and dashes', lambda probe: False, lambda path, options: []),)\n"
    )
    monkeypatch.setattr(formats, "__path__", [*formats.__path__, str(tmp_path)])
    readers, writers = discover()
    sys.modules.pop("kcs_torch.io.formats.morse")
    assert set(readers) == {*READERS, "morse"}
    assert set(writers) == set(WRITERS)


def saved(array):
    file = io.BytesIO()
    np.save(file, array, allow_pickle=True)
    return file.getvalue()


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.json", b"{", "got text that is not JSON"),
        ("a.json", b'{"a": 1}', "got JSON with other content .*pose_landmarks"),
        *[("a.json", nothing, "got JSON with nothing in it") for nothing in (b"{}", b"[]", b" \n")],
        ("a.json", b"[" * 100_000, "nested too deeply"),
        ("a.csv", b"x,y\n1,2\n", "a table that begins with 'x,y'"),
        ("a.csv", b"1.5,2e-3\n1,2\n", "a table without names above its columns, that begins with '1.5,2e-3'"),
        ("a.csv", b"a_x,a_y,a_z,b_x,b_y,b_z\n", "3D motion .*if z are depths of a detector's, leave these columns out"),
        ("a.pkl", pickle.dumps([1]), "a pickle, .* json.dump"),
        ("a.npy", saved(np.zeros((4, 17, 2))), r"a single array: .*savez.* \(frames, 33, 21, 42, 75 or 543, 2 to 5\)"),
        ("a.npy", saved(np.array([{}])), "an array of Python objects, .* json.dump"),
        ("a.h5", b"\x89HDF\r\n\x1a\n" + bytes(50), r"an HDF5 file that cannot be read \(damaged"),
        ("a.json.gz", gzip.compress(b"{}", mtime=0), "a compressed file: unpack it first, with gunzip"),
        ("a.csv", "a_x,a_y,b_x,b_y".encode("utf-16"), "text in UTF-16, .* save it in UTF-8"),
        ("a.zip", b"PK\x03\x04" + bytes(50), "a binary file with other content"),
        ("a.txt", b"", "an empty file"),
    ],
)
def test_what_nobody_recognises_is_described(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(FormatError, match=message) as caught:
        load_tracks(tmp_path / name)
    assert name in str(caught.value)


def test_nothing_there(tmp_path):
    with pytest.raises(FormatError, match="there is no such file or folder"):
        load_tracks(tmp_path / "absent.npz")
    with pytest.raises(FormatError, match="there is no such file or folder"):
        load_tracks(tmp_path / "absent" / "deeper.npz")
    with pytest.raises(FormatError, match="there is no such file or folder"):
        load_tracks("a\0b")
    with pytest.raises(FormatError, match="neither"):
        load_tracks("/dev/null")


def test_folders_of_folders_name_them(tmp_path):
    for name in ("vid10", "vid2", ".hidden"):
        (tmp_path / "sub" / name).mkdir(parents=True)
    message = "expected a folder with tracks, got one that holds only folders (vid2, vid10): give one of them, such as "
    with pytest.raises(FormatError, match=re.escape(message + str(tmp_path / "sub" / "vid2"))):
        load_tracks(tmp_path / "sub")


def test_folders_of_clips_name_them(tmp_path, samples):
    clip = samples["npz"]
    for name in ("walk.npz", "run.npz", "jump.npz"):
        shutil.copy(clip, tmp_path / name)
    (tmp_path / "notes.txt").write_text("hello")
    words = r"each a clip of its own, such as jump\.npz \(npz\) and run\.npz \(npz\): give one of them"
    with pytest.raises(FormatError, match=words):
        load_tracks(tmp_path)


@pytest.mark.parametrize("path", [None, 3, b"w.npz", ["w.npz"]])
def test_what_is_no_path_is_told(path):
    for read in (load_people, load_tracks, kt.load_motion, kt.io.load_reconstruction):
        with pytest.raises(FormatError, match="^path: expected the name of a file or folder, got"):
            read(path)


def test_a_file_that_the_system_refuses(tmp_path, monkeypatch):
    from pathlib import Path

    (tmp_path / "a.npz").write_bytes(b"PK")

    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(FormatError, match=r"a\.npz: cannot be read: Permission denied"):
        load_tracks(tmp_path / "a.npz")


def test_a_wrong_format_name_is_answered_with_the_right_ones(samples):
    with pytest.raises(OptionError, match="unknown format 'opnpose': did you mean 'openpose'"):
        load_tracks(samples["openpose"], format="opnpose")


def test_a_format_that_the_file_is_not(samples):
    with pytest.raises(FormatError, match=r"a\.mat: expected an \.npz archive"):
        load_tracks(samples["mat"], format="npz")
    with pytest.raises(FormatError, match=r"a\.npz: expected JSON"):
        load_tracks(samples["npz"], format="openpose")
    for name in ("npz", "mat"):
        with pytest.raises(FormatError, match="json"):
            load_tracks(samples["openpose"], format=name)


@pytest.mark.parametrize("person_", [-1, 1.0, "0", True])
def test_a_wrong_person_is_told(samples, person_):
    with pytest.raises(OptionError, match="person: expected None or a number from 0"):
        load_tracks(samples["npz"], person=person_)


def test_a_person_too_many_is_told(samples):
    for number in (0, np.int64(0)):
        assert load_tracks(samples["npz"], person=number).num_frames == 4
    with pytest.raises(FormatError, match=r"person: expected 0, as there is one person, got 1"):
        load_tracks(samples["npz"], person=1)


@pytest.mark.parametrize("threshold", [-0.1, 1.5, float("nan"), "high"])
def test_a_wrong_threshold_is_told(samples, threshold):
    with pytest.raises(OptionError, match="threshold: expected a number from 0 to 1"):
        load_people(samples["npz"], threshold=threshold)


@pytest.mark.parametrize("fps", [0, -25, float("inf"), float("nan"), "30"])
def test_a_wrong_rate_is_told(samples, fps):
    with pytest.raises(OptionError, match=r"^fps \(--fps\): expected a positive number, got .*; leave it out where"):
        load_people(samples["npz"], fps=fps)


def test_a_wrong_skeleton_is_told(samples):
    with pytest.raises(SkeletonError, match="did you mean 'coco17'"):
        load_tracks(samples["npz"], skeleton="coc17")
    with pytest.raises(SkeletonError, match="25 joints fit body25"):
        load_tracks(samples["npz"], skeleton="coco17")


def test_the_public_name_is_the_same_function():
    assert kt.load_tracks is load_tracks


def test_a_missing_package_is_told(monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(FormatError, match=r"a\.mat: needs the package h5py .*: pip install h5py"):
        need("h5py", "a.mat", FormatError)
