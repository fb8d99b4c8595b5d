"""DeepLabCut and Lightning Pose: all layouts, several animals, damaged files, and pickles that are refused."""

import io
import os
import pickle
import re

import numpy as np
import pytest
import torch
from animal_samples import (
    ANIMAL,
    LAYOUTS,
    NO_BONES,
    deeplabcut_columns,
    deeplabcut_values,
    mouse_table,
    write_deeplabcut_csv,
    write_deeplabcut_fixed,
    write_deeplabcut_table,
)
from hypothesis import given, settings
from hypothesis import strategies as st

import kcs_torch as kt
from kcs_torch.errors import FormatError, ShapeError, SkeletonError
from kcs_torch.io import READERS, detect_format, load_people, load_tracks
from kcs_torch.io.containers.pickles import load_arrays
from kcs_torch.io.motion import detect_motion_format
from kcs_torch.io.registry import HEAD, Probe

pytest.importorskip("h5py")


# ---------------------------------------------------------------------- DeepLabCut


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


def test_a_long_header_is_recognised(tmp_path):
    """SuperAnimal's names its network, in 60 letters, for each column of ten animals."""
    columns = [("superanimal" * 20, *names) for _, *names in deeplabcut_columns([f"m{i}" for i in range(40)])]
    path = write_deeplabcut_csv(tmp_path / "a.csv", columns, deeplabcut_values(columns))
    assert path.read_bytes().index(b"\n") > HEAD
    assert detect_format(path) == "deeplabcut" and len(load_people(path)) == 40


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
    assert tracks.notes[:3] == (
        "rows are placed by the numbers in the images' names",
        "frame 0 is the file's frame 7",
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
        load_tracks(write_deeplabcut_csv(tmp_path / "a.csv", *mouse_table()), skeleton="ap10k")


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
    columns, values = mouse_table()
    values[0, 2] = 1.0000002
    tracks = load_tracks(write_deeplabcut_csv(tmp_path / "a.csv", columns, values))
    assert tracks.weights[0, 0] == 1
    assert "confidences above 1 (up to 1) are taken as 1" in tracks.notes


def test_csv_as_a_spreadsheet_saves_it(tmp_path):
    columns, values = mouse_table()
    text = write_deeplabcut_csv(tmp_path / "a.csv", columns, values).read_text().replace(",", ";")
    (tmp_path / "b.csv").write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode() + b";;;;;;;;;\r\n")
    assert np.array_equal(load_tracks(tmp_path / "b.csv").points.numpy(), values.reshape(4, 3, 3)[..., :2])


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
def test_csv_with_every_cell_in_quotes(tmp_path, delimiter):
    columns, values = mouse_table()
    rows = write_deeplabcut_csv(tmp_path / "a.csv", columns, values).read_text().splitlines()
    quoted = (delimiter.join(f'"{cell}"' for cell in row.split(",")) for row in rows)
    (tmp_path / "b.csv").write_text("\n".join(quoted))
    assert torch.equal(load_tracks(tmp_path / "b.csv").points, load_tracks(tmp_path / "a.csv").points)


@pytest.mark.parametrize("end", ["\n\n", "\r\r\n", "\r\n\r\n"])
def test_csv_whose_line_ends_were_doubled(tmp_path, end):
    path = write_deeplabcut_csv(tmp_path / "mouse.csv", deeplabcut_columns(), deeplabcut_values(deeplabcut_columns()))
    plain = load_tracks(path, fps=30)
    path.write_bytes(path.read_text().replace("\n", end).encode())
    assert torch.equal(load_tracks(path, fps=30).points, plain.points)


def test_a_line_with_the_name_of_the_index_is_no_frame(tmp_path):
    columns, values = mouse_table()
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
    path = write_deeplabcut_csv(tmp_path / "a.csv", *mouse_table())
    path.write_text(change(path.read_text()))
    with pytest.raises((FormatError, ShapeError), match=message) as caught:
        load_tracks(path, format="deeplabcut")
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("cell", "got"), [("abc", "got 'abc' for y of"), ('"1,5"', r"got '1,5' \(write decimals with a point\) for y of")]
)
def test_a_cell_without_a_number_is_named(tmp_path, cell, got):
    path = write_deeplabcut_csv(tmp_path / "a.csv", *mouse_table())
    path.write_text(re.sub(r"\n1,([^,]*),[^,]*,", rf"\n1,\1,{cell},", path.read_text(), count=1))
    with pytest.raises(FormatError, match=rf"a\.csv: line 5: expected numbers, {got} 'snout'"):
        load_tracks(path)


def test_short_lines_are_unseen_there(tmp_path):
    path = write_deeplabcut_csv(tmp_path / "a.csv", *mouse_table())
    path.write_text(path.read_text().rstrip().rpartition(",")[0].rpartition(",")[0])
    tracks = load_tracks(path)
    assert (~tracks.seen).nonzero().tolist() == [[3, 2]]
    assert tracks.notes == ("1 line ends before the last column: what is missing is unseen", NO_BONES)


def test_places_filled_with_minus_one_are_unseen(tmp_path):
    """As DeepLabCut 3 fills those of animals and joints that are not there."""
    columns, values = mouse_table()
    values[1, 3:6] = -1
    tracks = load_tracks(write_deeplabcut_csv(tmp_path / "a.csv", columns, values))
    assert (~tracks.seen).nonzero().tolist() == [[1, 1]]
    assert "1 joint of negative confidence: taken as unseen" in tracks.notes


def test_frames_that_occur_twice_are_told(tmp_path):
    columns, values = mouse_table()
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


class Canary:
    """Would make a file if it were unpickled."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return os.mkdir, (self.path,)


# ---------------------------------------------------------------------- pickled names


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_no_pickle_runs(tmp_path, protocol):
    canary = tmp_path / "canary"
    columns = [("s", "a", Canary(canary)), *deeplabcut_columns()[1:]]
    text = pickle.dumps(columns, protocol)
    with pytest.raises(FormatError, match=r"a file: asks for posix.mkdir, which is no array: refused"):
        load_arrays(io.BytesIO(text), "a file")
    path = write_deeplabcut_table(tmp_path / "a.h5", *mouse_table(), pickled=text)
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
        path = write_deeplabcut_table(tmp_path / "a.h5", *mouse_table(), pickled=raw)
        with pytest.raises(FormatError, match="columns are not named by scorer"):
            load_tracks(path)


def test_damaged_tables_are_told(tmp_path):
    columns, numbers = mouse_table()
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


# ---------------------------------------------------------------------- 3D motion


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
    flat = LAYOUTS[layout](tmp_path / f"flat.{layout}", *mouse_table())
    with pytest.raises(FormatError, match="load_tracks\\(\\) reads 2D tracks"):
        kt.load_motion(flat)
    with pytest.raises(FormatError, match="expected columns x, y, z of 'snout', got x, y; load_tracks"):
        kt.load_motion(flat, format="deeplabcut")
