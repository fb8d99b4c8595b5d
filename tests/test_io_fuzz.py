"""Damaged and malicious files: readers give tracks or an error of ours, in bounded time and memory, and run nothing."""

import io
import json
import os
import pickle
import signal
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from animal_samples import (
    deeplabcut_columns,
    deeplabcut_values,
    sleap_points,
    write_deeplabcut_fixed,
    write_deeplabcut_table,
    write_sleap_hdf5,
)
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mutants import Canary, canary_pickle, mutate, npz_bytes, trick_npz
from samples import MOTION_SAMPLES, SAMPLES, person, write_openpose

import kcs_torch as kt
from kcs_torch.errors import FormatError, KcsError
from kcs_torch.io import MOTION_READERS, READERS, detect_format, load_motion, load_people, load_tracks

INPUTS = int(os.environ.get("KCS_FUZZ_INPUTS", "10000"))
HERE = Path(__file__).parent


@pytest.fixture(autouse=True)
def no_hang():
    """A test of this file that waits for ever, at a FIFO say, is ended."""

    def end(*_):
        raise TimeoutError("a reader waits for ever")

    before = signal.signal(signal.SIGALRM, end)
    signal.alarm(1200)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def test_every_reader_has_samples():
    assert set(SAMPLES) == set(READERS)
    assert set(MOTION_SAMPLES) == set(MOTION_READERS)


def test_ten_thousand_damaged_files(tmp_path):
    """The campaign, in a process of its own whose memory is bounded."""
    pytest.importorskip("h5py")
    pytest.importorskip("ezc3d")
    done = subprocess.run(
        [sys.executable, str(HERE / "fuzz_readers.py"), "--count", str(INPUTS), "--keep", str(tmp_path / "kept")],
        capture_output=True,
        text=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )
    assert done.returncode == 0, done.stderr[-3000:]
    report = json.loads(done.stdout.splitlines()[-1])
    first = report["failures"][:1]
    assert not first, (
        f"{report['failed']} failures; the first, kept in {tmp_path}:\n{first[0]['error']}\n{first[0]['trace']}"
    )
    assert report["inputs"] == INPUTS
    assert report["readers"] == sorted(READERS)
    assert report["motion_readers"] == sorted(MOTION_READERS)
    assert not report["canary"], "code of a file was run"
    assert report["memory"] < 2048
    for label, counts in report["outcomes"].items():
        assert counts["inputs"] >= INPUTS // 150, label
        assert counts.get("FormatError", 0) > 0, label


TEXTS = [
    (name, motion, i)
    for samples, motion in ((SAMPLES, False), (MOTION_SAMPLES, True))
    for name, writers in samples.items()
    for i in range(len(writers))
]


@pytest.mark.parametrize(("name", "motion", "index"), TEXTS)
def test_hypothesis_finds_no_other_error(tmp_path, name, motion, index):
    """The same changes, drawn by hypothesis: what fails is made small."""
    path = (MOTION_SAMPLES if motion else SAMPLES)[name][index](tmp_path)
    if path.is_dir():
        path = sorted(path.iterdir())[0]
    raw = path.read_bytes()
    if raw.startswith((b"\x89HDF", b"MATLAB 7.3")) or path.suffix == ".c3d":
        pytest.skip("read by another process, too slow here; the campaign has them")
    read = load_motion if motion else load_people

    @settings(max_examples=50, deadline=None, suppress_health_check=list(HealthCheck))
    @given(st.randoms(use_true_random=False))
    def check(rng):
        path.write_bytes(mutate(raw, rng) or b"x")
        try:
            read(path, format=name)
        except KcsError as error:
            assert str(error)

    check()


# ---------------------------------------------------------------------- code in files


def canary_files(canary):
    """Files that run code where they are unpickled or evaluated."""
    evil = np.array([Canary(canary)], object)
    points = np.ones((4, 3, 2))
    np.save(array := io.BytesIO(), evil, allow_pickle=True)
    yield "points.npz", npz_bytes({"points2d": evil})
    yield "names.npz", npz_bytes({"points2d": points, "joint_names": evil})
    yield "motion.npz", npz_bytes({"points3d": evil})
    yield "videopose3d.npz", npz_bytes({"positions_2d": evil})
    yield "videopose3d_2.npz", npz_bytes({"positions_2d": evil, "metadata": evil})
    yield "header.npz", trick_npz("header", canary)
    yield "member.npz", trick_npz("pickle", canary)
    yield "array.npy", array.getvalue()
    for protocol in range(pickle.HIGHEST_PROTOCOL + 1):
        for suffix in (".pkl", ".npz", ".npy", ".mat", ".h5", ".json", ".csv"):
            yield f"raw{protocol}{suffix}", canary_pickle(canary, protocol)


@pytest.mark.parametrize("format", [None, *READERS, *(f"motion {m}" for m in MOTION_READERS)])
def test_no_code_of_a_file_is_run(tmp_path, format):
    canary = tmp_path / "canary"
    read, name = (load_motion, format[7:]) if format and format.startswith("motion ") else (load_people, format)
    for file, raw in canary_files(canary):
        (tmp_path / file).write_bytes(raw)
        with pytest.raises(KcsError):
            read(tmp_path / file, format=name)
        if read is load_people:
            with pytest.raises(KcsError):
                read(tmp_path / file, format=name, trust=True)
        if name is None:
            with pytest.raises(KcsError):
                load_motion(tmp_path / file)
    assert not canary.exists()


def test_no_code_of_hdf5_attributes_is_run(tmp_path):
    h5py = pytest.importorskip("h5py")
    canary = tmp_path / "canary"
    columns = deeplabcut_columns()
    path = write_deeplabcut_table(tmp_path / "a.h5", columns, deeplabcut_values(columns))
    with h5py.File(path, "r+") as file:
        for key in ("info", "non_index_axes", "data_columns", "index_cols", "values_cols", "metadata", "encoding"):
            file["df_with_missing"].attrs[key] = np.bytes_(canary_pickle(canary, 0))
        file["df_with_missing"].attrs["note"] = np.bytes_(b"bodyparts")
        file["df_with_missing/table"].attrs["values_block_0_meta"] = np.bytes_(canary_pickle(canary, 0))
    assert load_tracks(path).num_frames == 4  # only what is needed is looked at
    with h5py.File(path, "r+") as file:
        file["df_with_missing/table"].attrs["values_block_0_kind"] = np.bytes_(canary_pickle(canary, 0))
    for read in (load_tracks, load_motion):
        with pytest.raises(FormatError):
            read(path, format="deeplabcut")
    assert not canary.exists()
    pickle.loads(canary_pickle(canary, 0))  # it would have been there
    assert canary.exists()


# ---------------------------------------------------------------------- bombs


@pytest.mark.parametrize("read", [load_people, load_motion])
@pytest.mark.parametrize("kind", ["bomb", "claim"])
def test_zip_bombs_are_refused(tmp_path, kind, read):
    path = tmp_path / "bomb.npz"
    path.write_bytes(trick_npz(kind, None))
    assert path.stat().st_size < 10**6
    with pytest.raises(FormatError, match="refused as a zip bomb" if kind == "bomb" else "bomb|more than|damaged"):
        read(path, format="npz")


def test_hdf5_bombs_are_refused(tmp_path):
    pytest.importorskip("h5py")
    import h5py

    path = write_sleap_hdf5(tmp_path / "a.h5", sleap_points())
    with h5py.File(path, "r+") as file:
        del file["tracks"]
        file.create_dataset("tracks", (100, 2, 3, 400_000), "f8", chunks=(1, 2, 3, 1000), compression="gzip")
    assert path.stat().st_size < 10**6
    with pytest.raises(FormatError, match="refused as a bomb"):
        load_people(path)


def test_a_dataset_under_many_names_is_no_bomb(tmp_path):
    h5py = pytest.importorskip("h5py")
    columns = deeplabcut_columns()
    path = write_deeplabcut_fixed(tmp_path / "a.h5", columns, deeplabcut_values(columns))
    with h5py.File(path, "r+") as file:
        group = file["df_with_missing"]
        zeros = group.create_dataset(
            "zeros", (10**6, 9), "f8", chunks=(10**6, 9), compression="gzip", compression_opts=1
        )
        zeros[:] = 0
        for i in range(1, 200):  # 14 GB, together
            group[f"block{i}_values"] = zeros
        for i in range(200):
            file[f"g{i}"] = group
    with pytest.raises(FormatError, match="refused as a bomb"):
        load_tracks(path, format="deeplabcut")


@pytest.mark.parametrize(
    "text",
    [
        "[" * 10**6,
        '{"people": [' * 10**5,
        '{"people": [{"pose_keypoints_2d": [' + "9" * 10**5 + "]}]}",
        '[{"image_id": ' + "9" * 10**5 + ', "keypoints": [1, 2, 3]}]',
        '[{"image_id": "' + "9" * 10**5 + '.jpg", "keypoints": [1, 2, 1, 3, 4, 1]}]',
        '[{"frame_id": 99999999999, "instances": [{"keypoints": [[1, 2], [3, 4]]}]}]',
        '[{"image_id": 0, "keypoints": [1, 2, 1, 3, 4, 1]}, {"image_id": 9999999999, "keypoints": [1, 2, 1, 3, 4, 1]}]',
    ],
)
def test_json_that_claims_much_needs_little(tmp_path, text):
    (tmp_path / "a.json").write_text(text)
    for name in READERS:
        try:
            people = load_people(tmp_path / "a.json", format=name)
        except KcsError as error:
            assert len(str(error)) < 3000
        else:
            assert sum(p.points.numel() for p in people) < 1000


@pytest.mark.parametrize("rows", ["0,1,2,3,4\n999999999999,1,2,3,4\n", "0,1,2,3,4\n" + "9" * 1000 + ",1,2,3,4\n"])
def test_csv_with_a_far_frame_needs_little(tmp_path, rows):
    (tmp_path / "a.csv").write_text(f"scorer,s,s,s,s\nbodyparts,a,a,b,b\ncoords,x,y,x,y\n{rows}")
    assert load_tracks(tmp_path / "a.csv").num_frames == 2


# ---------------------------------------------------------------------- paths


def test_names_of_members_lead_nowhere(tmp_path):
    (inner := tmp_path / "inner").mkdir()
    path = inner / "path.npz"
    path.write_bytes(trick_npz("path", None))
    for read in (load_people, load_motion):
        with pytest.raises(FormatError, match="points"):
            read(path, format="npz")
    path.write_bytes(trick_npz("twice", None))
    try:
        assert load_tracks(path).num_frames == 4
    except FormatError as error:
        assert "points2d" in str(error)
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["inner", "path.npz"]
    assert not Path("/tmp/points2d.npy").exists()


def odd_members(folder):
    """What a folder may hold that is no file: reading from some of it would wait for ever, or never end."""
    os.mkfifo(folder / "clip_000000000001_keypoints.json")
    (folder / "clip_000000000002_keypoints.json").symlink_to("/dev/zero")
    (folder / "clip_000000000003_keypoints.json").symlink_to(folder / "nowhere.json")
    (folder / "clip_000000000004_keypoints.json").symlink_to(folder / "clip_000000000004_keypoints.json")
    (folder / "clip_000000000005_keypoints.json").mkdir()
    (folder / "clip_000000000006_keypoints.json").symlink_to(folder)
    with socket.socket(socket.AF_UNIX) as listener:
        here = os.getcwd()
        os.chdir(folder)  # names of sockets are short
        try:
            listener.bind("clip_000000000007_keypoints.json")
        finally:
            os.chdir(here)


def test_a_folder_is_read_for_its_files_only(tmp_path):
    folder = write_openpose(tmp_path / "json", [p[None] for p in person()], frames=[0, 8, 9, 10])
    odd_members(folder)
    assert detect_format(folder) == "openpose"
    assert load_tracks(folder).seen.any(1).nonzero().flatten().tolist() == [0, 8, 9, 10]


@pytest.mark.parametrize("format", [None, *READERS])
def test_a_folder_without_files_is_told(tmp_path, format):
    odd_members(tmp_path)
    with pytest.raises(FormatError):
        load_people(tmp_path, format=format)
    with pytest.raises(FormatError):
        load_people(tmp_path / "clip*", format=format)


@pytest.mark.parametrize("format", [None, *READERS, *(f"motion {m}" for m in MOTION_READERS)])
def test_what_is_no_file_is_told_at_once(tmp_path, format):
    odd_members(tmp_path)
    read, name = (load_motion, format[7:]) if format and format.startswith("motion ") else (load_people, format)
    odd = [
        *tmp_path.iterdir(),
        "/dev/zero",
        "/dev/null",
        "/dev/stdin",
        "",
        "\0",
        "x" * 5000,
        "/proc/self/mem",
        "/",
        "~",
    ]
    for path in odd:
        with pytest.raises(KcsError):
            read(path, format=name)


def test_the_skeleton_beside_a_motion_is_a_file(tmp_path):
    path = MOTION_SAMPLES["amc"][0](tmp_path)
    (tmp_path / "35.asf").unlink()
    os.mkfifo(tmp_path / "35.asf")
    with pytest.raises(FormatError, match="expected its skeleton beside it"):
        load_motion(path)


def test_a_result_is_not_written_through_a_link_elsewhere(tmp_path):
    """Writing replaces a link, and leaves what it pointed to as it was."""
    target = tmp_path / "precious.npz"
    target.write_bytes(b"precious")
    (tmp_path / "out.npz").symlink_to(target)
    kt.save(load_tracks(SAMPLES["npz"][0](tmp_path)), tmp_path / "out.npz")
    assert load_tracks(tmp_path / "out.npz").num_frames == 4
    assert target.read_bytes() == b"precious" or (tmp_path / "out.npz").is_symlink()
