"""MATLAB files of version 7.3: read in a process of its own, which damaged files may crash."""

import random
import sys

import numpy as np
import pytest

from kcs_torch.errors import FormatError, KcsError
from kcs_torch.io import load_tracks
from kcs_torch.io.containers import hdf5
from kcs_torch.io.containers.hdf5 import read_hdf5
from kcs_torch.io.workers import ask
from kcs_torch.types import Tracks

h5py = pytest.importorskip("h5py")
WANTED = ("W", "points2d", "confidence", "edges", "fps")
W = np.random.default_rng(0).normal(size=(10, 3))


def save(path, fill):
    """A file as MATLAB writes it: 512 bytes of header, then HDF5 with the dimensions reversed."""
    with h5py.File(path, "w", userblock_size=512) as file:
        fill(file)
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")
    return path


def rich(file):
    """W, and what people keep beside it."""
    file.create_dataset("W", data=W.T, chunks=(3, 5), compression="gzip").attrs["MATLAB_class"] = np.bytes_("double")
    file["edges"] = np.array([[1, 2], [2, 3]], dtype="u1").T
    file["fps"] = [[25.0]]
    file["flag"] = np.array([[True]])
    file["title"] = np.array("walk", dtype=h5py.string_dtype())
    file.create_group("settings")["a"] = np.arange(3.0)
    cells = file.create_dataset("cells", (2, 1), dtype=h5py.ref_dtype)
    cells[0, 0] = file["settings"]["a"].ref


def pretend(tmp_path, monkeypatch, code):
    """Let a script of ours answer instead of the worker."""
    (tmp_path / "hdf5.py").write_text(code)
    monkeypatch.setattr(ask, "__file__", str(tmp_path / "ask.py"))


def test_reads_w_among_variables_of_every_class(tmp_path):
    path = save(tmp_path / "rich.mat", rich)
    shapes, values = read_hdf5(path, WANTED, 1000)
    np.testing.assert_array_equal(values["W"], W)
    np.testing.assert_array_equal(values["edges"], [[1, 2], [2, 3]])
    assert shapes["W"] == (10, 3) and shapes["cells"] == (1, 2) and shapes["title"] == () and "settings" not in shapes
    tracks = load_tracks(path)
    assert tracks.fps == 25 and tracks.skeleton.bones == ((0, 1), (1, 2))


@pytest.mark.parametrize(
    ("fill", "message"),
    [
        (lambda f: f.create_dataset("W", data="text"), "'W': expected real numbers, got object"),
        (lambda f: f.create_dataset("W", data=W * 1j), "'W': expected real numbers, got complex"),
        (lambda f: f.create_dataset("W", dtype="f8", shape=None), "'W': expected real numbers"),
        (lambda f: f.create_dataset("W", (1001, 1), "f8"), r"'W': \(1, 1001\) are more numbers"),
        (lambda f: f.create_dataset("W", (2**40, 0), "f8"), "are more numbers"),
        (
            lambda f: f.create_dataset("W", (2, 3), "f8", external=[("other", 0, 48)]),
            "'W': expected its numbers in this",
        ),
        (lambda f: f.__setitem__("W", h5py.ExternalLink("other.mat", "/W")), r"expected W .*got nothing"),
        (lambda f: f.__setitem__("W", h5py.SoftLink("/W")), r"expected W .*got nothing"),
    ],
)
def test_what_it_does_not_read_is_told(tmp_path, fill, message, monkeypatch):
    from kcs_torch.io.formats import mat

    monkeypatch.setattr(mat, "LIMIT", 1000)
    save(tmp_path / "other.mat", rich)
    path = save(tmp_path / "bad.mat", fill)
    with pytest.raises(FormatError, match=message) as caught:
        load_tracks(path)
    assert str(caught.value).startswith(f"{path}: ")


def test_room_is_not_made_for_what_is_not_in_the_file(tmp_path, monkeypatch):
    monkeypatch.setattr(hdf5, "LARGE", 10**6)
    path = save(tmp_path / "bomb.mat", lambda f: f.create_dataset("W", (10**4, 10**4), "f8", chunks=(100, 100)))
    with pytest.raises(FormatError, match=r"'W': expected up to \d+ bytes .* refused as a bomb"):
        read_hdf5(path, WANTED, 10**9)


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("import os; os.abort()", "ended with status"),
        ("print('no json')", "failed on it"),
        ("", "failed on it"),
        ("print('{}')", "failed on it: 'shapes'"),
        ("print('[]')", "failed on it"),
        ("""print('{"shapes": {"W": [2, 3]}, "read": ["W"]}')""", "failed on it: buffer"),
        ("""print('{"shapes": {"W": [-2, -3]}, "read": ["W"]}', 9 * '12345678')""", "failed on it"),
    ],
)
def test_a_crash_costs_no_more_than_the_file(tmp_path, monkeypatch, code, message):
    pretend(tmp_path, monkeypatch, code)
    path = save(tmp_path / "file.mat", rich)
    with pytest.raises(FormatError, match=message) as caught:
        read_hdf5(path, WANTED, 1000)
    assert str(caught.value).startswith(f"{path}: damaged: ")


def test_it_does_not_wait_for_ever(tmp_path, monkeypatch):
    pretend(tmp_path, monkeypatch, "while True: pass")
    monkeypatch.setattr(ask, "PATIENCE", 0.2)
    with pytest.raises(FormatError, match="no answer in 0 seconds"):
        read_hdf5(save(tmp_path / "file.mat", rich), WANTED, 1000)


def test_finds_h5py_where_this_process_does_and_loads_no_torch(tmp_path, monkeypatch):
    code = "import json, sys; print(json.dumps({'error': str([sys.path, 'torch' in sys.modules])}))"
    pretend(tmp_path, monkeypatch, code)
    monkeypatch.syspath_prepend(str(tmp_path / "extra"))
    with pytest.raises(FormatError, match=r"extra.*False"):
        read_hdf5(save(tmp_path / "file.mat", rich), WANTED, 1000)
    assert "extra" in sys.path[0]


def test_damaged_files_give_tracks_or_our_errors(tmp_path):
    good = save(tmp_path / "good.mat", rich).read_bytes()
    used = [i for i in range(512, len(good)) if good[i]]  # most bytes are not
    outcomes = set()
    for seed in range(15):
        rng = random.Random(seed)
        raw = bytearray(good)
        for _ in range(rng.randint(1, 4)):
            raw[rng.choice(used) + rng.randint(-2, 0)] = rng.choice([0, 1, 0x80, 0xFF, rng.randrange(256)])
        path = tmp_path / "file.mat"
        path.write_bytes(raw[: rng.randint(520, len(raw))] if rng.random() < 0.1 else raw)
        try:
            outcomes.add(type(load_tracks(path)))
        except KcsError as error:
            outcomes.add(KcsError)
            assert "file.mat" in str(error)
    assert outcomes == {Tracks, KcsError}
