"""SLEAP: analysis files in HDF5 and CSV."""

import numpy as np
import pytest
import torch
from animal_samples import ANIMAL, CELLS, NO_BONES, sleap_points, write_sleap_csv, write_sleap_hdf5

import kcs_torch as kt
from kcs_torch.errors import FormatError, KcsError
from kcs_torch.io import detect_format, load_people, load_tracks
from kcs_torch.io.formats import sleap

pytest.importorskip("h5py")


# ---------------------------------------------------------------------- SLEAP


@pytest.mark.parametrize(
    ("told", "size"),
    [
        ('{"shape": [100, 720, 1280, 3]}', (1280, 720)),
        ('{"shape": [100, 0, 1280, 3]}', None),
        ('{"shape": [100, "high", 1280, 3]}', None),
        ('{"shape": [720, 1280]}', None),
        ('{"shape": null}', None),
        ("[1]", None),
        ("{", None),
    ],
)
def test_the_video_tells_the_size_of_the_image(tmp_path, told, size):
    """As sleap-io writes it."""
    import h5py

    with h5py.File(path := write_sleap_hdf5(tmp_path / "a.h5", sleap_points(2)), "a") as file:
        file.attrs["video_backend_metadata"] = told
    assert [tracks.image_size for tracks in load_people(path)] == [size, size]
    assert load_tracks(path, image_size=(640, 480)).image_size == (640, 480)  # the caller goes before the file
    assert load_tracks(write_sleap_hdf5(tmp_path / "b.h5", sleap_points())).image_size is None


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
        ({"edge_inds": [[0, 3]]}, None, "'edge_inds': expected .* node numbers 0..2, got 3"),
        ({"edge_inds": [[0, 1, 2]]}, None, r"'edge_inds': expected .* node numbers 0..2, got shape \(1, 3\)"),
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


def test_sleap_csv(tmp_path):
    lines = [["a", 3, 0.9, *CELLS], ["b", 4, 0.9, *CELLS], ["a", 6, 0.9, *CELLS[:6], "", "", ""]]
    people = load_people(write_sleap_csv(tmp_path / "a.csv", lines))
    assert detect_format(tmp_path / "a.csv") == "sleap"
    assert [p.notes[1:3] for p in people] == [
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


def test_blank_lines_of_a_sleap_csv_are_none(tmp_path):
    path = write_sleap_csv(tmp_path / "a.csv", [["a", 3, 0.9, *CELLS], [], ["a", 4, 0.9, *CELLS], [""] * 12, []])
    tracks = load_tracks(path)
    assert tracks.num_frames == 2 and "frame 0 is the file's frame 3" in tracks.notes
    path.write_text(path.read_text() + "a,5\n")
    with pytest.raises(FormatError, match="line 7: expected 12 cells, got 2"):
        load_tracks(path)


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
