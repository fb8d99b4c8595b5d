"""C3D files: a real one, our own read back, and damaged ones, which must not take this process down."""

import os
import random
from dataclasses import replace

import ezc3d
import numpy as np
import pytest
import torch
from samples import walking_motion as walk

import kcs_torch as kt
from kcs_torch.errors import FormatError, OutputError
from kcs_torch.io import detect_motion_format, load_motion, save


def test_real_file(shared):
    path = shared / "data" / "raw_formats" / "c3d" / "runway03.c3d"
    motion = load_motion(path)
    assert (motion.num_frames, motion.num_joints, motion.fps, motion.units) == (379, 12, 200, "mm")
    assert motion.skeleton.joints[:3] == ("RCrest", "RHip", "RMTP")
    assert "never seen, left out: *12, *13, *14, *15" in motion.notes
    points = ezc3d.c3d(str(path))["data"]["points"][:3, :12].transpose(2, 1, 0)
    assert np.allclose(motion.points.numpy(), points[..., [0, 2, 1]] * [1, 1, -1])  # z is up, as the file says
    shoulder, ankle = motion.skeleton.index("RShoulder"), motion.skeleton.index("RAnkle")
    assert bool((motion.points[:, shoulder, 1] > motion.points[:, ankle, 1]).all())
    assert torch.allclose(load_motion(path, up="y").points, torch.from_numpy(points))


@pytest.mark.parametrize("up", ["y", "z"])
def test_what_is_written_is_read_back(tmp_path, up):
    motion = walk()
    weights = motion.weights.clone()
    weights[3, 4] = 0
    motion = replace(motion, weights=weights, points=motion.points * weights[..., None])
    path = save(motion, tmp_path / "w.c3d", up=up)
    back = load_motion(path)  # which reads the axes from the file
    assert torch.allclose(back.points, 1000 * motion.points, rtol=1e-6, atol=1e-4)
    assert torch.equal(back.seen, motion.seen)
    assert (back.skeleton, back.fps, back.units) == (motion.skeleton, 25, "mm")
    raw = ezc3d.c3d(str(path))["data"]["points"][:3].transpose(2, 1, 0)
    assert np.nanmax(raw[..., "xyz".index(up)]) == pytest.approx(1000 * float(motion.points[..., 1].max()), rel=1e-5)


def test_what_is_left_out_is_told(tmp_path):
    path = save(walk(4), tmp_path / "w.c3d")
    file = ezc3d.c3d(str(path))
    file["parameters"]["ANALOG"]["RATE"]["value"] = [250.0]
    file["parameters"]["ANALOG"]["LABELS"]["value"] = ["Fz1", "Fz2"]
    file["data"]["analogs"] = np.zeros((1, 2, 40))
    file["header"]["points"]["first_frame"] = 99
    file.write(str(path))
    notes = load_motion(path).notes
    assert "2 analog channels (of force plates, muscles, ...) are left out" in notes
    assert any("number 100;" in note for note in notes)


@pytest.mark.parametrize("fps", [23.976, 29.97, 59.94, 1000.0])
def test_rates_that_single_precision_rounds_come_back(tmp_path, fps):
    assert load_motion(save(replace(walk(3), fps=fps), tmp_path / "w.c3d")).fps == fps


def test_too_many_joints_are_refused(tmp_path):
    motion = kt.Motion.from_arrays(torch.zeros(2, 300, 3), fps=30, units="m")
    with pytest.raises(OutputError, match="up to 255 joints"):
        save(motion, tmp_path / "w.c3d")
    assert not list(tmp_path.iterdir())


def test_more_frames_than_the_header_counts(tmp_path):
    points, seen = torch.randn(2**17 + 40000, 2, 3), torch.ones(2**17 + 40000, 2)
    seen[65536, 1] = seen[70000] = 0
    motion = kt.Motion.from_arrays(points, seen, joint_names=["a", "b"], fps=100, units="mm", up="y")
    path = save(motion, tmp_path / "w.c3d")
    back = load_motion(path)
    assert back.notes == () and torch.equal(back.seen, motion.seen)
    assert torch.allclose(back.points, motion.points.double())
    words = {
        key: ezc3d.c3d(str(path))["parameters"]["TRIAL"][f"ACTUAL_{key}_FIELD"]["value"] for key in ("START", "END")
    }
    assert {key: (value % 2**16).tolist() for key, value in words.items()} == {"START": [1, 0], "END": [40000, 2]}
    with path.open("r+b") as file:
        file.truncate(path.stat().st_size // 2)
    cut = load_motion(path)
    assert 65535 < cut.num_frames < len(points) and "171072 frames" in cut.notes[0] and "cut short" in cut.notes[0]


def test_more_frames_than_anything_in_the_file_counts(tmp_path):
    """So ezc3d writes them; zeros fill the last block."""
    file, points = ezc3d.c3d(), np.ones((4, 3, 65550))
    points[:3] = np.random.RandomState(0).rand(3, 3, 65550)
    file["parameters"]["POINT"]["LABELS"]["value"] = ["a", "b", "c"]
    file["parameters"]["POINT"]["RATE"]["value"] = [100.0]
    file["data"]["points"] = points
    file.write(str(tmp_path / "w.c3d"))
    motion = load_motion(tmp_path / "w.c3d", up="y", units="mm")
    assert motion.num_frames == 65550 and np.allclose(motion.points[-1], points[:3, :, -1].T)


def test_what_only_begins_like_one(tmp_path):
    path = tmp_path / "x.c3d"
    path.write_bytes(b"\x02\x50" + bytes(14) + b"\x09" + bytes(495))
    with pytest.raises(FormatError, match=r"x.c3d: damaged"):
        load_motion(path)
    path.write_bytes(b"\x02\x50" + bytes(2000))  # the parameters' own header is not one
    with pytest.raises(FormatError, match="got something else"):
        detect_motion_format(path)


def test_a_picture_is_none(tmp_path):
    path = tmp_path / "x.png"
    path.write_bytes(b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR\x00\x00\x03\xe8\x00\x00\x02X\x08\x06" + bytes(2000))
    with pytest.raises(FormatError, match="got something else"):
        detect_motion_format(path)
    with pytest.raises(FormatError, match="got a file that begins with .*PNG"):
        kt.load_tracks(path)


def test_damaged_files_end_in_our_errors(tmp_path):
    good = save(walk(4), tmp_path / "w.c3d").read_bytes()
    outcomes = []
    for seed in range(10):  # each costs the start of a process
        pick = random.Random(seed)
        data = bytearray(good)
        for _ in range(20):
            data[pick.randrange(2, len(data) if seed % 2 else 1024)] = pick.randrange(256)
        (tmp_path / "m.c3d").write_bytes(data[: len(data) // 2] if seed == 0 else data)
        try:
            outcomes.append(load_motion(tmp_path / "m.c3d", format="c3d").points.isfinite().all())
        except kt.KcsError as error:
            assert "m.c3d" in str(error)
            outcomes.append(None)
    assert None in outcomes


def test_a_crash_of_the_library_is_an_error_of_the_file(tmp_path, monkeypatch):
    from kcs_torch.io.workers import ask

    path = save(walk(4), tmp_path / "w.c3d")
    script = tmp_path / "c3d.py"
    script.write_text("import os; os.abort()")
    monkeypatch.setattr(ask, "__file__", str(tmp_path / "ask.py"))
    with pytest.raises(FormatError, match="ezc3d failed on it: it ended with status -6"):
        load_motion(path)
    script.write_text("import time; time.sleep(60)")
    monkeypatch.setattr(ask, "PATIENCE", 0.3)
    with pytest.raises(FormatError, match="gave no answer"):
        load_motion(path)


def test_a_file_that_comes_out_short_is_told_and_the_old_one_stays(tmp_path, monkeypatch):
    """ezc3d does not say that a disk is full."""
    path = tmp_path / "a.c3d"
    save(walk(8), path)
    before = path.read_bytes()

    whole = ezc3d.c3d.write

    def short(file, name):
        whole(file, name)
        os.truncate(name, 700)

    monkeypatch.setattr(ezc3d.c3d, "write", short)
    with pytest.raises(OutputError, match=r"a\.c3d: cannot be written: it came out shorter"):
        save(walk(8), path)
    assert path.read_bytes() == before and [p.name for p in tmp_path.iterdir()] == ["a.c3d"]
