"""DeepLabCut, Lightning Pose and SLEAP: real files, all layouts, several animals, and files that are none."""

import io
import os
import pickle
import re

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from samples import (
    ANIMAL,
    deeplabcut_columns,
    deeplabcut_values,
    sleap_points,
    write_deeplabcut_csv,
    write_deeplabcut_fixed,
    write_deeplabcut_table,
    write_sleap_csv,
    write_sleap_hdf5,
)

import kcs_torch as kt
from kcs_torch.errors import FormatError, KcsError, ShapeError, SkeletonError
from kcs_torch.io import READERS, detect_format, load_people, load_tracks
from kcs_torch.io.containers import hdf5
from kcs_torch.io.containers.pickles import load_arrays
from kcs_torch.io.contents import animals
from kcs_torch.io.formats import sleap
from kcs_torch.io.motion import detect_motion_format
from kcs_torch.io.registry import Probe
from kcs_torch.io.tables import bounded
from kcs_torch.skeleton import Skeleton
from kcs_torch.types.bodies import no_bones

pytest.importorskip("h5py")
quick = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])

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
NO_BONES = no_bones(Skeleton.from_edges([], 3, tree=False))
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


# ---------------------------------------------------------------------- DeepLabCut

LAYOUTS = {"csv": write_deeplabcut_csv, "table.h5": write_deeplabcut_table, "fixed.h5": write_deeplabcut_fixed}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_deeplabcut_layouts(tmp_path, layout):
    columns = deeplabcut_columns()
    values = deeplabcut_values(columns)
    values[1, 3:5] = np.nan  # an unlabelled joint
    values[2, 2] = 0.1  # an unlikely one
    path = LAYOUTS[layout](tmp_path / f"mouse.{layout}", columns, values)
    assert [r.name for r in READERS.values() if r.recognises(Probe(path))] == ["deeplabcut"]
    tracks = load_tracks(path, fps=30)
    assert (tracks.skeleton.joints, tracks.skeleton.bones, tracks.fps) == (ANIMAL, (), 30)
    assert (~tracks.seen).nonzero().tolist() == [[1, 1], [2, 0]]
    assert np.array_equal(tracks.points[0].numpy(), values[0].reshape(3, 3)[:, :2])
    assert tracks.weights[0, 0] == 0.9
    assert tracks.notes == (NO_BONES,)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_deeplabcut_animals_are_apart(tmp_path, layout):
    columns = deeplabcut_columns(["m1", "m2"]) + deeplabcut_columns(["single"], ["food", "door"])
    values = deeplabcut_values(columns)
    values[1:, 9:18] = np.nan  # m2 leaves
    path = LAYOUTS[layout](tmp_path / f"mice.{layout}", columns, values)
    people = load_people(path)
    called = [p.notes[0].split("'")[1] for p in people]
    assert called == ["m1", "single", "m2"]
    assert [p.skeleton.joints for p in people] == [ANIMAL, ("food", "door"), ANIMAL]
    assert np.array_equal(people[2].points[0].numpy(), values[0, 9:18].reshape(3, 3)[:, :2])
    assert np.array_equal(load_tracks(path, person=1).points.numpy(), values[:, 18:].reshape(4, 2, 3)[..., :2])


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("apart", [False, True])
def test_labels_are_placed_by_the_images_numbers(tmp_path, layout, apart):
    if apart and layout == "table.h5":
        pytest.skip("pandas cannot write rows of several levels in this layout")
    columns = deeplabcut_columns(coords="xy")
    values = deeplabcut_values(columns, 3)
    names = [("labeled-data", "cam1.avi", f"img{i:03d}.png") for i in (9, 7, 10)]
    rows = names if apart or layout == "fixed.h5" else [("/".join(n),) for n in names]
    rows = ["/".join(n) for n in names] if layout == "table.h5" else rows
    path = LAYOUTS[layout](tmp_path / f"labels.{layout}", columns, values, rows)
    tracks = load_tracks(path)
    assert tracks.seen.any(1).tolist() == [True, False, True, True]
    assert np.array_equal(tracks.points[[2, 0, 3]].numpy(), values.reshape(3, 3, 2))
    assert (tracks.weights[0] == 1).all()
    assert tracks.notes[:2] == (
        "rows are placed by the numbers in the images' names",
        "1 of 4 frames has no row (number 8): unseen",
    )


def test_images_of_several_videos_are_no_clip(tmp_path):
    columns = deeplabcut_columns()
    rows = [(f"labeled-data/cam{i}/img0.png",) for i in range(4)]
    path = write_deeplabcut_csv(tmp_path / "a.csv", columns, deeplabcut_values(columns), rows)
    with pytest.raises(FormatError, match=r"rows of 4 \(labeled-data/cam0, labeled-data/cam1"):
        load_tracks(path)


def test_names_of_a_known_skeleton_bring_its_bones(tmp_path):
    body = kt.SKELETONS["ap10k"]
    columns = deeplabcut_columns(parts=body.joints[: body.num_observed])
    path = write_deeplabcut_csv(tmp_path / "dog.csv", columns, deeplabcut_values(columns))
    assert load_tracks(path).skeleton.bones == body.bones
    with pytest.raises(SkeletonError, match="expected the 17 joints of skeleton 'ap10k'"):
        load_tracks(write_deeplabcut_csv(tmp_path / "a.csv", *_animal()), skeleton="ap10k")


def _animal():
    columns = deeplabcut_columns()
    return columns, deeplabcut_values(columns)


def test_lightning_pose_has_more_columns(tmp_path):
    columns = deeplabcut_columns(coords=("x", "y", "likelihood", "x_ens_median", "y_ens_var"))
    columns.append(("resnet", "set", ""))
    values = deeplabcut_values(columns)
    path = write_deeplabcut_csv(tmp_path / "lp.csv", columns, values)
    path.write_text(
        "".join(
            f"{line.rpartition(',')[0]},train\n" if i > 2 else f"{line}\n"
            for i, line in enumerate(path.read_text().splitlines())
        )
    )
    tracks = load_tracks(path)
    assert np.array_equal(tracks.points.numpy(), values[:, :15].reshape(4, 3, 5)[..., :2])
    assert tracks.notes == ("columns left out: x_ens_median, y_ens_var, resnet", NO_BONES)


def test_confidences_a_little_above_one_are_one(tmp_path):
    columns, values = _animal()
    values[0, 2] = 1.0000002
    tracks = load_tracks(write_deeplabcut_csv(tmp_path / "a.csv", columns, values))
    assert tracks.weights[0, 0] == 1
    assert "confidences above 1 (up to 1) are taken as 1" in tracks.notes


def test_csv_as_a_spreadsheet_saves_it(tmp_path):
    columns, values = _animal()
    text = write_deeplabcut_csv(tmp_path / "a.csv", columns, values).read_text().replace(",", ";")
    (tmp_path / "b.csv").write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode() + b";;;;;;;;;\r\n")
    assert np.array_equal(load_tracks(tmp_path / "b.csv").points.numpy(), values.reshape(4, 3, 3)[..., :2])


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
def test_csv_with_every_cell_in_quotes(tmp_path, delimiter):
    columns, values = _animal()
    rows = write_deeplabcut_csv(tmp_path / "a.csv", columns, values).read_text().splitlines()
    quoted = (delimiter.join(f'"{cell}"' for cell in row.split(",")) for row in rows)
    (tmp_path / "b.csv").write_text("\n".join(quoted))
    assert torch.equal(load_tracks(tmp_path / "b.csv").points, load_tracks(tmp_path / "a.csv").points)


def test_a_line_with_the_name_of_the_index_is_no_frame(tmp_path):
    columns, values = _animal()
    path = write_deeplabcut_csv(tmp_path / "a.csv", columns, values)
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join([*lines[:3], "frame" + 9 * "," + "\n", *lines[3:]]))
    assert load_tracks(path).num_frames == 4


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.replace("coords", "what", 1), "expected lines scorer"),
        (lambda t: t.replace("coords,x", "coords,a", 1), "expected columns x, y of 'snout', got y, likelihood"),
        (lambda t: t.replace("coords,x,y", "coords,x,x", 1), "expected one column 'x' of 'snout', got two"),
        (lambda t: t.replace("likelihood", "z"), "3D motion"),
        (lambda t: "".join(t.splitlines(keepends=True)[:3]), "a header only"),
        (lambda t: t.replace("\n0,", "\n0,many,", 1), "line 4: expected 10 cells, got 11"),
        (lambda t: t.replace("\n1,", "\n1,2,x", 1).replace(",0.9\n", "\n", 2), "line 5: expected numbers"),
        (lambda t: t.replace("\n1,", "\n1,99999999999", 1), "frame 1, joint 'snout': expected pixels, got 1e[+]14"),
        (lambda t: t.replace("bodyparts,snout", "bodyparts", 1), "as many cells in each line"),
        (lambda t: t.replace("0.9", "0.1"), "of 0.3 or more, only 0.1: lower the threshold"),
        (lambda t: re.sub(r"\d+[.]\d+", "nan", t), "no joint is seen in any frame: nothing to reconstruct"),
        (lambda t: t.replace("0.9", "90"), "divide by the largest"),
        (lambda t: t + '4,"' + 200_000 * "1", "damaged text"),
        (lambda t: "scorer,a,a\nbodyparts,b,b\ncoords,x,y\n0,1,2\n", "at least 2 joints"),
        (lambda t: "scorer,a,a\nbodyparts,b,b\ncoords,u,v\n0,1,2\n", "got none of them"),
    ],
)
def test_damaged_csv_is_told(tmp_path, change, message):
    path = write_deeplabcut_csv(tmp_path / "a.csv", *_animal())
    path.write_text(change(path.read_text()))
    with pytest.raises((FormatError, ShapeError), match=message) as caught:
        load_tracks(path, format="deeplabcut")
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("cell", "got"), [("abc", "got 'abc' for y of"), ('"1,5"', r"got '1,5' \(write decimals with a point\) for y of")]
)
def test_a_cell_without_a_number_is_named(tmp_path, cell, got):
    path = write_deeplabcut_csv(tmp_path / "a.csv", *_animal())
    path.write_text(re.sub(r"\n1,([^,]*),[^,]*,", rf"\n1,\1,{cell},", path.read_text(), count=1))
    with pytest.raises(FormatError, match=rf"a\.csv: line 5: expected numbers, {got} 'snout'"):
        load_tracks(path)


def test_short_lines_are_unseen_there(tmp_path):
    path = write_deeplabcut_csv(tmp_path / "a.csv", *_animal())
    path.write_text(path.read_text().rstrip().rpartition(",")[0].rpartition(",")[0])
    tracks = load_tracks(path)
    assert (~tracks.seen).nonzero().tolist() == [[3, 2]]
    assert tracks.notes == ("1 line ends before the last column: what is missing is unseen", NO_BONES)


def test_places_filled_with_minus_one_are_unseen(tmp_path):
    """As DeepLabCut 3 fills those of animals and joints that are not there."""
    columns, values = _animal()
    values[1, 3:6] = -1
    tracks = load_tracks(write_deeplabcut_csv(tmp_path / "a.csv", columns, values))
    assert (~tracks.seen).nonzero().tolist() == [[1, 1]]
    assert "1 joint of negative confidence: taken as unseen" in tracks.notes


def test_frames_that_occur_twice_are_told(tmp_path):
    columns, values = _animal()
    tracks = load_tracks(write_deeplabcut_csv(tmp_path / "a.csv", columns, values, [(0,), (1,), (2,), (1,)]))
    assert np.array_equal(tracks.points[:, 0, 0].numpy(), values[[0, 1, 3, 2], 0])
    assert "number 1 stands for several of the rows: each of these is taken as a frame of its own" in tracks.notes


def test_animals_that_say_nothing_are_left_out(tmp_path):
    columns = deeplabcut_columns(["m1", "m2"]) + deeplabcut_columns(["single"], ["food"])
    values = deeplabcut_values(columns)
    values[:, 11] = values[:, 14] = values[:, 17] = 0.2
    (tracks,) = load_people(write_deeplabcut_csv(tmp_path / "a.csv", columns, values))
    assert "left out, as one joint alone is no body: single" in tracks.notes
    assert "1 of 2 animals never reach the confidence threshold (m2): left out" in tracks.notes
    assert len(load_people(tmp_path / "a.csv", threshold=0.1)) == 2


def test_two_scorers_are_told(tmp_path):
    columns = deeplabcut_columns()
    both = [*columns, *(("human", *c[1:]) for c in columns)]
    values = deeplabcut_values(both)
    tracks = load_tracks(write_deeplabcut_csv(tmp_path / "a.csv", both, values))
    assert np.array_equal(tracks.points.numpy(), values[:, :9].reshape(4, 3, 3)[..., :2])
    assert "2 scorers' columns: those of 'resnet' are read" in tracks.notes


# ---------------------------------------------------------------------- pickled names


class Canary:
    """Would make a file if it were unpickled."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return os.mkdir, (self.path,)


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_no_pickle_runs(tmp_path, protocol):
    canary = tmp_path / "canary"
    columns = [("s", "a", Canary(canary)), *deeplabcut_columns()[1:]]
    text = pickle.dumps(columns, protocol)
    with pytest.raises(FormatError, match=r"a file: asks for posix.mkdir, which is no array: refused"):
        load_arrays(io.BytesIO(text), "a file")
    path = write_deeplabcut_table(tmp_path / "a.h5", *_animal(), pickled=text)
    with pytest.raises(
        FormatError, match=r"df_with_missing' is damaged or of an unknown layout: .*asks for posix.mkdir"
    ):
        load_tracks(path)
    assert not canary.exists()
    pickle.loads(pickle.dumps(Canary(canary), protocol))  # so it does where it is let
    assert canary.exists()


values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False)
    | st.text(st.characters(max_codepoint=0x7FF)),
    lambda inner: st.lists(inner, max_size=5) | st.lists(inner, max_size=5).map(tuple),
    max_leaves=30,
)


@given(value=values, protocol=st.integers(0, pickle.HIGHEST_PROTOCOL))
@settings(max_examples=300, deadline=None)
def test_plain_pickles_are_read_as_pickle_reads_them(value, protocol):
    assert load_arrays(io.BytesIO(pickle.dumps(value, protocol)), "a file") == value


@given(
    st.binary(max_size=60)
    | st.tuples(values, st.integers(0, 5), st.integers(0, 60), st.binary(max_size=4)).map(
        lambda v: (lambda raw: raw[: v[2]] + v[3] + raw[v[2] + 1 :])(pickle.dumps(v[0], v[1]))
    )
)
@settings(max_examples=500, deadline=None)
def test_damaged_pickles_give_a_value_or_our_error(raw):
    try:
        load_arrays(io.BytesIO(raw), "a file")
    except FormatError as error:
        assert str(error).startswith("a file: ")


def test_names_that_refer_to_themselves_are_no_columns(tmp_path):
    for raw in (b"(lp0\ng0\na.", b"(lp0\n" + 5000 * b"(" + b"I1\n" + 5000 * b"t" + b"a."):
        path = write_deeplabcut_table(tmp_path / "a.h5", *_animal(), pickled=raw)
        with pytest.raises(FormatError, match="columns are not named by scorer"):
            load_tracks(path)


def test_damaged_tables_are_told(tmp_path):
    columns, numbers = _animal()
    for i, (write, options, message) in enumerate(
        [
            (write_deeplabcut_table, {"pickled": b"junk"}, "damaged"),
            (write_deeplabcut_table, {"pickled": pickle.dumps(columns[:4], 0)}, "4 columns do not fit"),
            (write_deeplabcut_table, {"pickled": pickle.dumps([c[:2] for c in columns], 0)}, "not named by scorer"),
            (write_deeplabcut_fixed, {"rows": [(f"img{i}.png",) for i in range(3)]}, "3 rows and 9 columns do not fit"),
        ]
    ):
        if "rows" in options:
            path = write(tmp_path / f"{i}.h5", columns, numbers, options["rows"])
        else:
            path = write(tmp_path / f"{i}.h5", columns, numbers, **options)
        with pytest.raises(FormatError, match=message):
            load_tracks(path)


# ---------------------------------------------------------------------- SLEAP


@pytest.mark.parametrize("dims", [None, ["track", "xy", "node", "frame"], ["frame", "track", "node", "xy"]])
@pytest.mark.parametrize("told", [True, False])
def test_sleap_dimensions(tmp_path, dims, told):
    own = ["track", "xy", "node", "frame"]
    points = sleap_points(2)
    scores = np.full((2, 3, 4), 0.8)
    points[1, :, 2, 1] = scores[1, 2, 1] = np.nan
    order = [own.index(d) for d in dims or own]
    scores_order = [["track", "node", "frame"].index(d) for d in dims or own if d != "xy"]
    path = write_sleap_hdf5(
        tmp_path / "a.h5",
        points.transpose(order),
        dims if told else None,
        point_scores=scores.transpose(scores_order),
        track_names=np.array([b"m", b"f"]),
    )
    people = load_people(path)
    assert [p.notes[0] for p in people] == ["the file calls this animal 'm'", "the file calls this animal 'f'"]
    assert (~people[1].seen).nonzero().tolist() == [[1, 2]]
    assert np.array_equal(people[0].points.numpy(), points[0].transpose(2, 1, 0))
    assert people[0].skeleton.joints == ANIMAL
    assert people[0].skeleton.bones == ((0, 1), (1, 2))
    assert (people[0].weights == 0.8).all()


def test_odd_orders_of_dimensions_are_read_where_they_are_told(tmp_path):
    points = sleap_points()
    path = write_sleap_hdf5(tmp_path / "a.h5", points.transpose(2, 3, 1, 0), ["node", "frame", "xy", "track"])
    assert np.array_equal(load_tracks(path).points.numpy(), points[0].transpose(2, 1, 0))


def test_points_without_a_score_were_placed_by_hand(tmp_path):
    scores = np.full((1, 3, 4), np.nan)
    scores[0, 0, 0] = 0.1
    tracks = load_tracks(write_sleap_hdf5(tmp_path / "a.h5", sleap_points(), point_scores=scores))
    assert (~tracks.seen).nonzero().tolist() == [[0, 0]]
    assert tracks.notes == ("11 points have no score, as those placed by hand: their confidence is 1",)


def test_old_files_without_names_or_scores(tmp_path):
    occupancy = np.ones((4, 1), "u1")
    path = write_sleap_hdf5(
        tmp_path / "a.h5", sleap_points(), node_names=None, edge_inds=None, track_occupancy=occupancy
    )
    tracks = load_tracks(path)
    assert tracks.skeleton.joints == ("joint0", "joint1", "joint2")
    assert (tracks.skeleton.bones, tracks.notes) == ((), ("the file does not name the joints", NO_BONES))


def test_edges_need_not_be_a_tree(tmp_path):
    ring = np.array([[0, 1], [1, 2], [2, 0]])
    tracks = load_tracks(write_sleap_hdf5(tmp_path / "a.h5", sleap_points(), edge_inds=ring))
    assert not tracks.skeleton.is_tree
    assert any("close a chain" in n for n in tracks.notes)
    assert load_tracks(write_sleap_hdf5(tmp_path / "b.h5", sleap_points(), edge_inds=ring[:0])).skeleton.bones == ()


@pytest.mark.parametrize(
    ("others", "dims", "message"),
    [
        ({"tracks": np.zeros((4, 5, 6, 7))}, None, "expected dimensions track, xy, node, frame of 3 nodes"),
        ({"tracks": np.zeros((4, 1, 3, 3))}, None, "3D motion"),
        ({"tracks": np.zeros((2, 2, 3, 0))}, None, "at least one frame of one animal, got 0 of 2"),
        ({"tracks": np.zeros((0, 2, 3, 4))}, None, "at least one frame of one animal, got 4 of 0"),
        ({"tracks": np.zeros((1, 2, 3, 0)), "point_scores": np.zeros((1, 3, 0))}, None, "at least one frame"),
        ({"edge_inds": [[0, 3]]}, None, "'edge_inds': expected .* node numbers 0..2"),
        ({"edge_inds": [[0.5, 1]]}, None, "'edge_inds'"),
        ({"edge_inds": [[1, 1]]}, None, "edges"),
        ({"point_scores": np.zeros((3, 4))}, None, "'point_scores': expected dimensions"),
        ({"point_scores": np.zeros((1, 3, 5))}, None, r"'point_scores': expected the shape \(1, 4, 3\)"),
        ({}, "track", "expected dims such as"),
        ({}, ["track", "xy", "node", "time"], "expected dims such as"),
        ({}, ["track", "node", "xy", "frame"], "expected dimensions track, node, xy, frame of 3 nodes"),
        ({"tracks": np.full((1, 2, 3, 4), 1e12)}, None, "expected pixels, got 1e[+]12"),
        ({"tracks": np.full((1, 2, 3, 4), np.nan)}, None, "no joint is seen in any frame: nothing to reconstruct"),
    ],
)
def test_damaged_sleap_files_are_told(tmp_path, others, dims, message):
    points = others.pop("tracks", sleap_points()) if "tracks" in others else sleap_points()
    path = write_sleap_hdf5(tmp_path / "a.h5", points, dims, **others)
    with pytest.raises(KcsError, match=message) as caught:
        load_tracks(path)
    assert str(path) in str(caught.value)


def test_pieces_of_tracks_stay_apart_and_are_told(tmp_path):
    points = np.full((5, 2, 3, 40), np.nan)
    points[0] = sleap_points(1, 40)[0]
    for i in range(1, 5):
        points[i, ..., 2 * i : 2 * i + 2] = 7.0
    people = load_people(write_sleap_hdf5(tmp_path / "a.h5", points))
    assert len(people) == 5
    assert people[0].seen.all()
    assert "most of the 5 animals are seen in few frames: pieces of tracks, which are not joined" in people[0].notes
    assert "the file calls this animal 'track 0'" in people[0].notes


CELLS = ["10", "20", ".9", "11", "21", ".8", "12", "22", ".7"]


def test_sleap_csv(tmp_path):
    lines = [["a", 3, 0.9, *CELLS], ["b", 4, 0.9, *CELLS], ["a", 6, 0.9, *CELLS[:6], "", "", ""]]
    people = load_people(write_sleap_csv(tmp_path / "a.csv", lines))
    assert detect_format(tmp_path / "a.csv") == "sleap"
    assert [p.notes[:2] for p in people] == [
        ("1 of 4 frames has no row (number 5): unseen", f"the file calls this animal '{name}'") for name in "ab"
    ]
    assert people[0].seen.tolist() == [[True] * 3, [False] * 3, [False] * 3, [True, True, False]]
    assert people[0].points[3, 1].tolist() == [11, 21]
    assert people[0].weights[0].tolist() == [0.9, 0.8, 0.7]


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
@pytest.mark.parametrize("quote", ["", '"'])
def test_sleap_csv_as_a_spreadsheet_saves_it(tmp_path, delimiter, quote):
    path = write_sleap_csv(tmp_path / "a.csv", [["a", 3, 0.9, *CELLS], ["a", 4, 0.9, *CELLS]])
    expected = load_tracks(path).points
    rows = (delimiter.join(f"{quote}{cell}{quote}" for cell in row.split(",")) for row in path.read_text().split())
    path.write_text("\ufeff" + "\r\n".join(rows), encoding="utf-8", newline="")
    assert detect_format(path) == "sleap"
    assert torch.equal(load_tracks(path).points, expected)


def test_sleap_csv_without_tracks_is_followed(tmp_path):
    def cells(x):
        return [x, 0, 0.9, x, 10, 0.9, x, 20, 0.9]

    lines = [["", t, 0.9, *cells(x)] for t in range(6) for x in ([t, 200 - t] if t % 2 else [200 - t, t])]
    people = load_people(write_sleap_csv(tmp_path / "a.csv", lines))
    assert [p.points[:, 0, 0].tolist() for p in people] in (
        [[200, 199, 198, 197, 196, 195], [0, 1, 2, 3, 4, 5]],
        [[0, 1, 2, 3, 4, 5], [200, 199, 198, 197, 196, 195]],
    )
    assert "animals without a track are followed over the frames by where they are" in people[0].notes


def test_sleap_csv_whose_frames_are_floats(tmp_path):
    """As pandas writes whole numbers where some were missing."""
    lines = [["a", f"{t}.0", 0.9, *CELLS] for t in (2, 4, 3)]
    tracks = load_tracks(write_sleap_csv(tmp_path / "a.csv", lines))
    assert tracks.num_frames == 3


def test_sleap_csv_with_a_frame_twice(tmp_path):
    lines = [["a", 0, 0.9, *CELLS], ["a", 0, 0.9, *["1"] * 9], ["a", 1, 0.9, *CELLS]]
    tracks = load_tracks(write_sleap_csv(tmp_path / "a.csv", lines))
    assert tracks.points[0, 0].tolist() == [10, 20]
    assert "1 line tells a frame of a track again: the first one counts" in tracks.notes


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([], "a header only"),
        ([["a", 0, 0.9, *CELLS[:-1]]], "line 2: expected 12 cells, got 11"),
        ([["a", "x", 0.9, *CELLS]], "line 2: expected numbers"),
        ([["a", -1, 0.9, *CELLS]], "line 2: expected a frame number, got -1"),
        ([["a", 10**30, 0.9, *CELLS]], "line 2: expected a frame number"),
        ([["a", 1.5, 0.9, *CELLS]], "line 2: expected a frame number, got 1.5"),
        ([["a", 0, 0.9, "left", *CELLS[1:]]], "line 2: expected numbers"),
        ([["a", 0, 0.9, CELLS[0], "left", *CELLS[2:]]], r"line 2: expected numbers, got 'left' for '\w+\.y'"),
    ],
)
def test_damaged_sleap_csv_is_told(tmp_path, lines, message):
    with pytest.raises(FormatError, match=message):
        load_tracks(write_sleap_csv(tmp_path / "a.csv", lines))


def test_sleap_csv_that_r_wrote_again(tmp_path):
    tracks = load_tracks(write_sleap_csv(tmp_path / "a.csv", [["a", 0, "NA", "NA", "NA", "NA", *CELLS[3:]]]))
    assert tracks.seen[0].tolist() == [False, True, True]


def test_sleap_csv_without_places(tmp_path):
    (tmp_path / "a.csv").write_text("track,frame_idx,instance.score\n")
    with pytest.raises(FormatError, match="expected columns node.x"):
        load_tracks(tmp_path / "a.csv")


# ---------------------------------------------------------------------- 3D motion


def test_reads_real_files_of_motion(raw):
    rat = kt.load_motion(raw / "sleap" / "points3d.h5")
    assert (rat.num_frames, rat.num_joints, rat.source[-11:]) == (120, 15, "points3d.h5")
    hand = kt.load_motion(raw / "deeplabcut" / "reachingDEMO_3D.h5", up="-y", fps=100)
    assert (hand.num_frames, hand.num_joints, hand.fps) == (800, 33, 100)
    assert hand.skeleton.joints[:3] == ("nose", "Left_wrist", "left_backofhand")
    assert 100 * (1 - hand.seen.double().mean()) == pytest.approx(17.5, abs=0.1)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_deeplabcut_motion(tmp_path, layout):
    columns = deeplabcut_columns(["m1", "m2"], coords="xyz")
    values = deeplabcut_values(columns)
    values[2, :9] = np.nan
    path = LAYOUTS[layout](tmp_path / f"rat.{layout}", columns, values)
    assert detect_motion_format(path) == "deeplabcut"
    motion = kt.load_motion(path)
    assert np.array_equal(motion.points.numpy(), values[:, 9:].reshape(4, 3, 3))
    assert motion.skeleton.joints == ANIMAL
    assert "2 animals: this is 'm2', the most seen one" in motion.notes
    flat = LAYOUTS[layout](tmp_path / f"flat.{layout}", *_animal())
    with pytest.raises(FormatError, match="load_tracks\\(\\) reads 2D tracks"):
        kt.load_motion(flat)
    with pytest.raises(FormatError, match="expected columns x, y, z of 'snout', got x, y; load_tracks"):
        kt.load_motion(flat, format="deeplabcut")


def test_sleap_motion_of_two_animals(tmp_path):
    points = np.random.default_rng(0).normal(size=(5, 2, 3, 3))
    points[0, 0, 0, 0] = np.nan
    alone = {"node_names": None, "edge_inds": None}
    path = write_sleap_hdf5(tmp_path / "a.h5", points, **alone)
    assert np.array_equal(kt.load_motion(path).points.numpy(), points[:, 1])
    with pytest.raises(FormatError, match="3D motion"):
        load_tracks(path)
    assert kt.load_motion(write_sleap_hdf5(tmp_path / "b.h5", points[:, :1])).skeleton.bones == ((0, 1), (1, 2))
    three_frames = write_sleap_hdf5(tmp_path / "c.h5", points, track_names=np.array([b"a"] * 5))
    assert [len(p.points) for p in load_people(three_frames)] == [3] * 5
    with pytest.raises(FormatError, match="expected 3D motion"):
        kt.load_motion(write_sleap_hdf5(tmp_path / "d.h5", points[..., :2]), format="sleap")


# ---------------------------------------------------------------------- bounds


def test_many_pieces_in_a_long_clip_do_not_fill_the_memory(tmp_path, monkeypatch):
    monkeypatch.setattr(sleap, "LIMIT", 1000)
    lines = [[f"t{i}", i, 0.9, *CELLS] for i in range(20)]
    with pytest.raises(FormatError, match="20 frames of 20 tracks are more than fits"):
        load_tracks(write_sleap_csv(tmp_path / "a.csv", lines))


@pytest.mark.parametrize(("bound", "value"), [("LINES", 5), ("LINE", 60)])
def test_tables_of_text_are_bounded(tmp_path, monkeypatch, bound, value):
    paths = [
        write_deeplabcut_csv(tmp_path / "a.csv", *_animal()),
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
    assert all(any("image_size=" in note for note in tracks.notes) for tracks in load_people(path))
    values[:, places] *= 1000
    whole = load_people(write_deeplabcut_csv(tmp_path / "b.csv", columns, values), image_size=(1000, 1000))
    for tracks, expected in zip(load_people(path, image_size=(1000, 1000)), whole, strict=True):
        assert torch.allclose(tracks.points, expected.points)
        assert not any("image_size=" in note for note in (*tracks.notes, *expected.notes))
