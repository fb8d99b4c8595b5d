""".mat files of the NRSfM benchmarks."""

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.io import savemat

from kcs_torch.errors import FormatError, KcsError, SkeletonError
from kcs_torch.io import detect_format, load_tracks
from kcs_torch.io.formats import mat

quick = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def motion(num_frames=20, joints=6):
    """Smooth (T, N, 2) motion."""
    time = np.linspace(0, 1, num_frames)[:, None, None]
    rng = np.random.default_rng(0)
    return rng.normal(0, 10, (joints, 2)) + 5 * np.sin(3 * time + rng.uniform(0, 6, (joints, 2)))


def in_turn(points):
    """(T, N, 2) -> W (2T, N), rows x1, y1, x2, y2, ..."""
    return points.transpose(0, 2, 1).reshape(-1, points.shape[1])


def stacked(points):
    """(T, N, 2) -> W (2T, N), rows x1, x2, ..., y1, y2, ..."""
    return points.transpose(2, 0, 1).reshape(-1, points.shape[1])


def save_hdf5(path, **values):
    """A file as MATLAB writes it in version 7.3: HDF5 behind 512 bytes of header, dimensions reversed."""
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, value in values.items():
            file[name] = np.asarray(value).T
    header = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM"
    with path.open("r+b") as file:
        file.write(header)


@pytest.mark.parametrize("rows", [in_turn, stacked])
@pytest.mark.parametrize("form", ["5", "4", "7.3"])
def test_reads_w_whichever_way_its_rows_run(tmp_path, rows, form):
    path = tmp_path / "w.mat"
    values = {"W": rows(motion()), "S": np.zeros((60, 6)), "fps": 24.0}
    if form == "7.3":
        save_hdf5(path, **values)
    else:
        savemat(path, values, format=form)
    assert detect_format(path) == "mat"
    tracks = load_tracks(path)
    assert torch.equal(tracks.points, torch.from_numpy(motion()))
    assert tracks.fps == 24
    assert any("all x, then all y" in n for n in tracks.notes) == (rows is stacked)


def test_the_benchmarks_own_order_is_the_default(tmp_path):
    noise = np.random.default_rng(0).normal(size=(10, 4, 2))  # no motion tells the order
    savemat(tmp_path / "w.mat", {"W": in_turn(noise)})
    assert torch.equal(load_tracks(tmp_path / "w.mat").points, torch.from_numpy(noise))


def test_reads_points_confidence_and_edges_from_one(tmp_path):
    confidence = np.full((20, 6), 0.7)
    confidence[2, 3] = 0
    edges = [[1, 2], [2, 3], [3, 4], [4, 5], [5, 6]]
    savemat(tmp_path / "p.mat", {"points2d": motion(), "confidence": confidence, "edges": edges}, do_compression=True)
    tracks = load_tracks(tmp_path / "p.mat")
    assert tracks.skeleton.bones == ((0, 1), (1, 2), (2, 3), (3, 4), (4, 5))
    assert torch.equal(tracks.weights, torch.from_numpy(confidence))
    savemat(tmp_path / "several.mat", {"points2d": motion(), "confidences": confidence})
    assert torch.equal(load_tracks(tmp_path / "several.mat").weights, tracks.weights)
    savemat(tmp_path / "zero.mat", {"points2d": motion(), "edges": np.array(edges) - 1})
    assert load_tracks(tmp_path / "zero.mat").skeleton.bones == tracks.skeleton.bones


def test_shares_of_the_image_become_pixels(tmp_path):
    """--image-size went unheard."""
    shares = np.random.default_rng(0).uniform(0.2, 0.8, (20, 6, 2))
    savemat(tmp_path / "p.mat", {"points2d": shares})
    assert np.allclose(load_tracks(tmp_path / "p.mat").points, shares)
    tracks = load_tracks(tmp_path / "p.mat", image_size=(1280, 720))
    assert np.allclose(tracks.points, shares * [1280, 720]) and tracks.image_size == (1280, 720)


def test_what_is_not_finite_is_unseen(tmp_path):
    points = motion()
    points[3, 1] = np.nan
    points[4, 2, 0] = np.inf
    savemat(tmp_path / "w.mat", {"W": in_turn(points)})
    assert (~load_tracks(tmp_path / "w.mat").seen).nonzero().tolist() == [[3, 1], [4, 2]]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"X": np.zeros((4, 5))}, r"expected W \(2 x frames, joints\).*got X \(4, 5\)"),
        ({}, "got nothing"),
        ({"W": np.zeros((5, 4))}, r"got W \(5, 4\)"),
        ({"W": np.zeros((4, 1))}, r"got W \(4, 1\)"),
        ({"W": np.zeros((4, 3, 2))}, r"got W \(4, 3, 2\)"),
        ({"W": "text"}, "'W': expected real numbers"),
        ({"W": np.ones((4, 3)) * 1j}, "'W': expected real numbers"),
        ({"points2d": np.zeros((4, 3, 3))}, r"got points2d \(4, 3, 3\)"),
        ({"W": np.ones((4, 3)), "edges": [[1, 9]]}, r"'edges': expected \(bones, 2\) joint numbers 1..3, got 9"),
        ({"W": np.ones((4, 3)), "edges": [[1.5, 2]]}, "'edges': expected"),
        ({"W": np.ones((4, 3)), "confidence": np.full((2, 3), -1.0)}, "is negative"),
        ({"W": np.full((4, 3), np.nan)}, "no joint is seen"),
    ],
)
def test_wrong_content_names_file_and_variables(tmp_path, values, message):
    savemat(tmp_path / "bad.mat", values)
    with pytest.raises(KcsError, match=message) as caught:
        load_tracks(tmp_path / "bad.mat")
    assert "bad.mat" in str(caught.value)


def test_edges_that_join_a_joint_to_itself_are_told(tmp_path):
    savemat(tmp_path / "bad.mat", {"W": np.ones((4, 3)), "edges": [[2, 2]]})
    with pytest.raises(SkeletonError, match="itself"):
        load_tracks(tmp_path / "bad.mat")


@pytest.mark.parametrize("content", [b"", b"MATLAB 5.0 MAT-file", b"not a mat file at all", b"MATLAB 7.3" + bytes(600)])
def test_what_is_no_mat_file_says_so(tmp_path, content):
    (tmp_path / "no.mat").write_bytes(content)
    with pytest.raises(FormatError, match=r"no\.mat"):
        load_tracks(tmp_path / "no.mat")


def test_a_size_that_nobody_tracks_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(mat, "LIMIT", 100)
    savemat(tmp_path / "w.mat", {"W": in_turn(motion())})
    with pytest.raises(FormatError, match=r"'W': \(40, 6\) are more numbers"):
        load_tracks(tmp_path / "w.mat")


def test_without_h5py_it_says_what_to_install(tmp_path, monkeypatch):
    import sys

    save_hdf5(tmp_path / "w.mat", W=in_turn(motion()))
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(FormatError, match="pip install h5py"):
        load_tracks(tmp_path / "w.mat")


@quick
@given(data=st.data())
def test_flipped_bytes_give_tracks_or_our_errors(tmp_path, data):
    if not (tmp_path / "good.mat").exists():
        savemat(tmp_path / "good.mat", {"W": in_turn(motion(5, 3)), "edges": [[1, 2], [2, 3]]})
    raw = bytearray((tmp_path / "good.mat").read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    (tmp_path / "flipped.mat").write_bytes(raw[: data.draw(st.integers(1, len(raw)))])
    try:
        tracks = load_tracks(tmp_path / "flipped.mat")
    except KcsError:
        return
    assert torch.isfinite(tracks.points).all()


def test_the_benchmark_sequences_come_through(tmp_path, shared):
    points = np.load(shared / "data/akhter/akhter_yoga.npz")["points2d"].astype(float)
    for rows in (in_turn, stacked):
        savemat(tmp_path / "yoga.mat", {"W": rows(points)})
        assert torch.equal(load_tracks(tmp_path / "yoga.mat").points, torch.from_numpy(points))
