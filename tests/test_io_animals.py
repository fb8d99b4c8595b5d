"""DeepLabCut, Lightning Pose and SLEAP: real files, bounds, and files that are none."""

import pytest
import torch
from animal_samples import (
    CELLS,
    deeplabcut_columns,
    deeplabcut_values,
    mouse_table,
    sleap_points,
    write_deeplabcut_csv,
    write_sleap_csv,
    write_sleap_hdf5,
)

import kcs_torch as kt
from kcs_torch.errors import FormatError, KcsWarning
from kcs_torch.io import detect_format, load_people, load_tracks
from kcs_torch.io.containers import hdf5
from kcs_torch.io.contents import animals
from kcs_torch.io.formats import sleap
from kcs_torch.io.tables import bounded

pytest.importorskip("h5py")
MOUSE = ("snout", "leftear", "rightear", "tailbase")
HAND = ("Hand", "Finger1", "Tongue", "Joystick1", "Joystick2")
RAT = (
    *("Nose", "Ear_R", "Ear_L", "TTI", "TailTip", "Head", "Trunk", "Tail_0", "Tail_1", "Tail_2"),
    *("Shoulder_left", "Shoulder_right", "Haunch_left", "Haunch_right", "Neck"),
)
FLY = (
    *("head", "thorax", "abdomen", "wingL", "wingR", "forelegL4", "forelegR4", "midlegL4", "midlegR4"),
    *("hindlegL4", "hindlegR4", "eyeL", "eyeR"),
)
FILES = {  # frames, joints of the first animal, and the unseen share in per cent of each, the most seen first
    "deeplabcut/CollectedData_Mackenzie.csv": (241, HAND, [80.66]),
    "deeplabcut/CollectedData_Pranav.csv": (116, MOUSE, [0]),
    "deeplabcut/CollectedData_Pranav.h5": (116, MOUSE, [0]),
    "deeplabcut/m3v1mp4DeepCut_resnet50_openfieldOct30shuffle1_15001.h5": (2330, MOUSE, [2.42]),
    "deeplabcut/m3v1mp4DeepCut_resnet50_openfieldOct30shuffle1_15001_first200.csv": (200, MOUSE, [4.5]),
    "deeplabcut/reachingDEMO_2D.h5": (800, 33, [12.98]),
    "deeplabcut/sleaptest_CollectedData_LM.csv": (4, ("A", "B", "C"), [33.33, 58.33, 50]),
    "deeplabcut/sleaptest_dlc_testdata_v2.csv": (4, ("A", "B", "C"), [33.33]),
    "deeplabcut/sleaptest_madlc_testdata_v2.csv": (4, ("A", "B", "C"), [33.33, 58.33]),
    "deeplabcut/sleaptest_maudlc_testdata_v2.csv": (4, ("A", "B", "C"), [33.33, 58.33, 50]),
    "sleap/minimal_back_proofread.analysis.h5": (120, RAT, [47.17]),
    "sleap/minimal_mid_proofread.analysis.h5": (120, RAT, [0]),
    "sleap/minimal_side_proofread.analysis.h5": (120, RAT, [45.78]),
    "sleap/minimal_top_proofread.analysis.h5": (120, RAT, [0]),
    "sleap/minimal_instance.000_centered_pair_low_quality.analysis.csv": (1, ("A", "B"), [0]),
    "sleap/predictions.analysis.h5": (3000, FLY, [1.67, 2.24]),
}
OTHERS = {
    "deeplabcut/reachingDEMO_3D.h5": "got 3D motion .*load_motion reads",
    "sleap/points3d.h5": "got 3D motion .*load_motion reads",
    "sleap/minimal_side_proofread.slp": "got a project: write one with sleap-convert --format analysis minimal_side",
    "sleap/minimal_instance.json": "JSON with other content",
    "sleap/calibration.toml": r"a file that begins with '\[cam_0",
}


# ---------------------------------------------------------------------- real files


@pytest.mark.parametrize("name", FILES)
def test_reads_real_files(raw, tmp_path, name):
    num_frames, joints, unseen = FILES[name]
    assert detect_format(raw / name) == name.partition("/")[0]
    people = load_people(raw / name)
    first = people[0].skeleton.joints
    assert [p.num_frames for p in people] == [num_frames] * len(unseen)
    assert first == joints if isinstance(joints, tuple) else len(first) == joints
    assert [round(100 * p.unseen_share, 2) for p in people] == unseen
    again = load_tracks(kt.save(people[0], tmp_path / "again.npz"))
    assert torch.equal(again.points, people[0].points)
    assert torch.equal(again.weights, people[0].weights)
    assert (again.skeleton.joints, again.skeleton.bones) == (first, people[0].skeleton.bones)


@pytest.mark.parametrize("name", OTHERS)
def test_real_files_of_another_kind_are_told(raw, name):
    with pytest.raises(FormatError, match=OTHERS[name]):
        load_people(raw / name)


def test_the_folders_of_real_files_are_complete(raw):
    there = {f"{f.parent.name}/{f.name}" for kind in ("deeplabcut", "sleap") for f in (raw / kind).iterdir()}
    assert there == {*FILES, *OTHERS}


def test_csv_and_hdf5_of_the_same_tracks_agree(raw):
    for csv, hdf in (
        ("CollectedData_Pranav.csv", "CollectedData_Pranav.h5"),
        (
            "m3v1mp4DeepCut_resnet50_openfieldOct30shuffle1_15001_first200.csv",
            "m3v1mp4DeepCut_resnet50_openfieldOct30shuffle1_15001.h5",
        ),
    ):
        text, binary = load_tracks(raw / "deeplabcut" / csv), load_tracks(raw / "deeplabcut" / hdf)
        assert torch.allclose(text.points, binary.points[: text.num_frames], rtol=1e-12)
        assert torch.allclose(text.weights, binary.weights[: text.num_frames], rtol=1e-12)


def test_a_real_skeleton_keeps_its_edges(raw):
    body = load_tracks(raw / "sleap" / "minimal_mid_proofread.analysis.h5").skeleton
    assert (len(body.bones), body.is_tree) == (14, True)
    assert (body.index("TTI"), body.index("Head")) in body.bones


# ---------------------------------------------------------------------- 3D motion


def test_reads_real_files_of_motion(raw):
    rat = kt.load_motion(raw / "sleap" / "points3d.h5")
    assert (rat.num_frames, rat.num_joints, rat.source[-11:]) == (120, 15, "points3d.h5")
    hand = kt.load_motion(raw / "deeplabcut" / "reachingDEMO_3D.h5", up="-y", fps=100)
    assert (hand.num_frames, hand.num_joints, hand.fps) == (800, 33, 100)
    assert hand.skeleton.joints[:3] == ("nose", "Left_wrist", "left_backofhand")
    assert 100 * (1 - hand.seen.double().mean()) == pytest.approx(17.5, abs=0.1)


# ---------------------------------------------------------------------- bounds


@pytest.mark.parametrize(("bound", "value"), [("LINES", 5), ("LINE", 60)])
def test_tables_of_text_are_bounded(tmp_path, monkeypatch, bound, value):
    paths = [
        write_deeplabcut_csv(tmp_path / "a.csv", *mouse_table()),
        write_sleap_csv(tmp_path / "b.csv", [["a", t, 0.9, *CELLS] for t in range(9)]),
    ]
    monkeypatch.setattr(bounded, bound, value)
    for path in paths:
        with pytest.raises(FormatError, match=r"line \d: expected up to .* lines of .* letters"):
            load_tracks(path)


def test_a_missing_h5py_is_told(tmp_path, monkeypatch):
    path = write_sleap_hdf5(tmp_path / "a.h5", sleap_points())

    def need(package, what, error):
        raise error(f"{what}: needs the package h5py: pip install h5py")

    monkeypatch.setattr(hdf5, "need", need)
    with pytest.raises(FormatError, match="cannot be read .*needs the package h5py"):
        load_tracks(path)


def test_packing_that_h5py_lacks_is_named(tmp_path):
    import h5py

    path = write_sleap_hdf5(tmp_path / "a.h5", sleap_points())
    with h5py.File(path, "r+") as file:
        del file["tracks"]
        packing = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        packing.set_chunk((1, 2, 3, 4))
        packing.set_filter(32001, h5py.h5z.FLAG_OPTIONAL)  # Blosc
        space = h5py.h5s.create_simple((1, 2, 3, 4))
        h5py.h5d.create(file.id, b"tracks", h5py.h5t.NATIVE_DOUBLE, space, packing)
    with pytest.raises(FormatError, match="'tracks': packed by .*, which h5py lacks: write it with zlib"):
        load_tracks(path)


def test_other_hdf5_is_described(tmp_path):
    path = write_sleap_hdf5(tmp_path / "a.h5", sleap_points()[0], node_names=None, edge_inds=None)
    with pytest.raises(FormatError, match=r"an HDF5 file with other content \(tracks\)"):
        load_tracks(path)
    with pytest.raises(FormatError, match=r"expected a pandas table with body parts as columns, got tracks"):
        load_tracks(path, format="deeplabcut")
    with pytest.raises(FormatError, match=r"expected 'tracks' \(tracks, 2, nodes, frames\), got tracks \(2, 3, 4\)"):
        load_tracks(path, format="sleap")


def test_limit_is_shared():
    assert sleap.LIMIT == animals.LIMIT


def test_shares_of_the_image(tmp_path):
    """Somebody who divides by the size of the video is asked for it, and heard."""
    columns = deeplabcut_columns(("one", "two"))
    values = deeplabcut_values(columns)
    places = [c[-1] != "likelihood" for c in columns]
    values[:, places] /= 1000
    path = write_deeplabcut_csv(tmp_path / "a.csv", columns, values)
    with pytest.warns(KcsWarning, match=r"a\.csv: .*if they are shares of the image, give image_size="):
        people = load_people(path)
    assert all(any("image_size=" in note for note in tracks.notes) for tracks in people)
    values[:, places] *= 1000
    whole = load_people(write_deeplabcut_csv(tmp_path / "b.csv", columns, values), image_size=(1000, 1000))
    for tracks, expected in zip(load_people(path, image_size=(1000, 1000)), whole, strict=True):
        assert torch.allclose(tracks.points, expected.points)
        assert not any("image_size=" in note for note in (*tracks.notes, *expected.notes))
