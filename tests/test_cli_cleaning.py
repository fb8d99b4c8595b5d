"""Options of ``kcs-torch lift`` that clean: what they do is what the library does, and the report tells it."""

import json

import numpy as np
import pytest
import torch
from command_line import run
from conftest import moving_body

import kcs_torch as kt

FRAMES = 60


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """A file of tracks with noise, a gap and an outlier, at 30 frames a second."""
    body = kt.SKELETONS["coco17"]
    points = moving_body(body, FRAMES)[:, :17, :2].clone() + 500
    points += torch.randn(points.shape, generator=torch.Generator().manual_seed(0))
    points[30, 9] += 300
    points[40:42, 10] = np.nan
    path = tmp_path_factory.mktemp("tracks") / "walk.npz"
    np.savez(path, points2d=points, joint_names=np.array(body.joints[:17]), fps=30.0)
    return path


def lifted(file, folder, *words):
    """The tracks that were lifted, their result, and the report."""
    out = folder / "out.npz"
    done = run("lift", file, "-o", out, "-m", "sfam", "--json", *words)
    (person,) = json.loads(done.stdout)["people"]
    return kt.load_tracks(out), kt.io.load_reconstruction(out), person


def same(a, b):
    torch.testing.assert_close(a.points, b.points)
    torch.testing.assert_close(a.weights, b.weights)
    assert a.fps == b.fps


def test_all_steps_in_their_order(file, tmp_path):
    words = ["--resample", 25, "--smooth", "savgol=7", "--fill", 3, "--gate", "--frames", "5:55"]
    got, _, person = lifted(file, tmp_path, *words)
    expected = kt.clean.trim(kt.load_tracks(file), 5, 55)
    expected = kt.clean.resample(kt.clean.smooth(kt.clean.fill(kt.clean.gate(expected), 3), "savgol", 7), 25)
    same(got, expected)
    assert person["cleaning"] == list(expected.notes[-5:])
    assert [note.split(":")[0].split(" ")[0] for note in person["cleaning"]] == [
        "trim",
        "gate",
        "fill",
        "smooth",
        "resample",
    ]
    assert person["fps"] == 25 and person["frames"] == expected.num_frames
    assert set(person["cleaning"]) <= set(person["notes"])


@pytest.mark.parametrize(
    ("words", "step"),
    [
        (["--gate"], kt.clean.gate),
        (["--fill", "2"], lambda t: kt.clean.fill(t, 2)),
        (["--smooth", "butterworth=5"], lambda t: kt.clean.smooth(t, "butterworth", 5)),
        (["--smooth", "one-euro=2"], lambda t: kt.clean.smooth(t, "one-euro", 2)),
        (["--smooth", "butterworth=20", "--fps", "60"], None),
        (["--resample", "15"], lambda t: kt.clean.resample(t, 15)),
        (["--frames", "20:"], lambda t: kt.clean.trim(t, 20)),
        (["--frames", ":20"], lambda t: kt.clean.trim(t, None, 20)),
    ],
)
def test_each_step_alone(file, tmp_path, words, step):
    got, _, person = lifted(file, tmp_path, *words)
    if step is None:  # the frame rate that was given counts
        same(got, kt.clean.smooth(kt.load_tracks(file, fps=60), "butterworth", 20))
    else:
        same(got, step(kt.load_tracks(file)))
    assert len(person["cleaning"]) == 1


def test_nothing_happens_unasked(file, tmp_path):
    got, _, person = lifted(file, tmp_path)
    same(got, kt.load_tracks(file))
    assert person["cleaning"] == []


def test_smooth_3d(file, tmp_path):
    tracks, plain, _ = lifted(file, tmp_path)
    _, smoothed, person = lifted(file, tmp_path, "--smooth-3d", "butterworth=4")
    torch.testing.assert_close(smoothed.points, kt.clean.smooth(plain, "butterworth", 4).points)
    same(smoothed.tracks, tracks)
    assert any(note.startswith("smooth 3D (Butterworth") for note in person["notes"])


def test_the_report_tells_it_in_words(file, tmp_path):
    words = ["--gate", "--smooth", "butterworth=6"]
    text = run("lift", file, "-o", tmp_path / "a.npz", "-m", "sfam", *words).stdout
    assert "note: gate: 1 of 1018 (0.098 %) detections dropped as outliers: left_wrist 1" in text
    assert "note: smooth (Butterworth of order 4 without lag, 6 Hz): joints moved by" in text


MISTAKES = {
    "smooth without a cut-off": (["--smooth", "butterworth"], "such as butterworth=6, got 'butterworth'"),
    "smooth by another": (["--smooth", "butterwurst=6"], "did you mean 'butterworth'"),
    "smooth of nothing": (["--smooth", "savgol="], "such as butterworth=6"),
    "smooth too fast": (["--smooth", "butterworth=15"], "15 Hz, got 15"),
    "smooth-3d": (["--smooth-3d", "median=3"], "method for --smooth-3d 'median'"),
    "frames": (["--frames", "30"], "such as 100:400, 100: or :400, or seen, got '30'"),
    "frames backwards": (["--frames", "30:20"], "A below B"),
    "frames of a word": (["--frames", "a:b"], "got 'a:b'"),
    "frames beyond": (["--frames", "60:"], "within 0:60"),
    "resample": (["--resample", "-1"], "resample: fps"),
    "fill": (["--fill", "0"], "from 1, got 0"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_get_one_line_and_write_nothing(file, tmp_path, name):
    words, hint = MISTAKES[name]
    done = run("lift", file, "-o", tmp_path / "a.npz", "-m", "sfam", "--json", *words, code=2)
    answer = json.loads(done.stdout)
    assert answer["type"] == "OptionError" and hint in answer["error"]
    assert not list(tmp_path.iterdir())


def test_an_unknown_rate_is_told_with_the_option(tmp_path):
    tracks = tmp_path / "walk.npz"
    np.savez(tracks, points2d=np.random.default_rng(0).normal(size=(30, 17, 2)))
    done = run("lift", tracks, "-o", tmp_path / "a.npz", "--skeleton", "coco17", "--smooth", "savgol=5", code=2)
    assert "give fps=... (kcs-torch: --fps)" in done.stderr


def test_sides_are_swapped_back_before_anything_else(file, tmp_path):
    tracks = kt.load_tracks(file)
    left, right = torch.tensor(tracks.skeleton.mirror).T
    tracks.points[20:30, torch.cat([left, right])] = tracks.points[20:30, torch.cat([right, left])]
    tracks.weights[20:30, torch.cat([left, right])] = tracks.weights[20:30, torch.cat([right, left])]
    given = torch.where(tracks.seen[..., None], tracks.points, torch.nan)[:, :17].numpy()
    np.savez(tmp_path / "swapped.npz", points2d=given, joint_names=np.array(tracks.skeleton.joints[:17]), fps=30.0)
    got, _, person = lifted(tmp_path / "swapped.npz", tmp_path, "--unswap", "--gate")
    same(got, kt.clean.gate(kt.clean.unswap(kt.load_tracks(tmp_path / "swapped.npz"))))
    assert [note.split(":")[0] for note in person["cleaning"]] == ["unswap", "gate"]


def test_sides_that_need_no_swap_are_told(file, tmp_path):
    assert lifted(file, tmp_path, "--unswap")[2]["cleaning"] == ["unswap: nothing swapped"]
    np.savez(
        tmp_path / "stick.npz",
        points2d=np.random.default_rng(0).normal(size=(12, 4, 2)),
        edges=[[0, 1], [1, 2], [2, 3]],
    )
    told = lifted(tmp_path / "stick.npz", tmp_path, "--unswap")[2]["cleaning"]
    assert told == ["unswap: nothing swapped: skeleton 'stick' has no left and right"]
