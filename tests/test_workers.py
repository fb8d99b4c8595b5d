"""One call in several processes: what it gives, tells and refuses is what one process does."""

import contextlib
import os
import pickle
import signal
import sys
import warnings
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import ClassVar

import pytest
import torch
from command_line import run
from pools import end_pool
from torch.testing import assert_close

import kcs_torch as kt
from kcs_torch.data import walking_person
from kcs_torch.methods.clips import processes
from kcs_torch.methods.clips.processes import check_workers, spread, spread_batch
from kcs_torch.methods.perspective import one_lens
from kcs_torch.types import Intrinsics

CLIPS = [
    replace(walking_person(frames, turn=turn, yaw=40.0).tracks, source=f"clip{i}.json")
    for i, (frames, turn) in enumerate([(31, 120.0), (12, 90.0), (24, 150.0), (14, 60.0), (20, 180.0)])
]
LENS = Intrinsics(1500.0, 1500.0, 960.0, 540.0)
RIGID = kt.METHODS["rigid"]()


def talking():
    """KCS that warns of every clip, of clips together, and of what is no business of this library.

    It looks for turned signs, so that cameras may be near. As a user's own in a script, it has no module to import.
    """

    @dataclass(frozen=True)
    class Talking(kt.KCS):
        turns_over: ClassVar[bool] = True

        def solve_all(self, tracks):
            for one in tracks:
                warnings.warn(f"{one.source}: said", kt.ConvergenceWarning, stacklevel=1)
            warnings.warn("old", FutureWarning, stacklevel=1)
            return super().solve_all(tracks)

    return Talking()


@pytest.fixture(scope="module", autouse=True)
def pool():
    """That all calls share; it does not outlive the tests of this file."""
    yield
    end_pool()


def told(call):
    """What a call gives, and its warnings: words, kind and file."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = call()
    return found, [(str(one.message), one.category, one.filename) for one in caught]


def in_space(frames, x):
    """Tracks of a person who walks so many mm beside the middle of an image of 1920 x 1080."""
    clip = walking_person(frames, turn=0.0, yaw=60.0)
    points = LENS.project(clip.points + clip.points.new_tensor([x, 0.0, 3500.0]))
    return kt.Tracks.from_arrays(points, skeleton=clip.skeleton, fps=30.0, image_size=(1920, 1080))


# ---------------------------------------------------------------------- in processes: one pool, but for those that die


def alike(found, alone, batch=True):
    """Results are those of one process, up to the rounding of batches; and so are the objects that they hold."""
    for one, other in zip(found, alone, strict=True):
        assert one.tracks is other.tracks and one.skeleton is other.tracks.skeleton
        close = 1e-4 * float(other.points.abs().max()) if batch else 0.0
        assert_close(one.points, other.points, rtol=0, atol=close)
        assert_close(one.lengths, other.lengths, rtol=0, atol=close)
        assert one.diagnostics.notes == other.diagnostics.notes and one.intrinsics == other.intrinsics
        assert (one.distance is None) == (other.distance is None) and one.units == other.units
        assert not one.points.is_inference() and not one.points.requires_grad
    return True


def test_a_batch_of_clips(recwarn):
    """Warnings come in the order of the clips, at the user's line."""
    call = partial(kt.reconstruct_all, CLIPS, method=talking(), intrinsics="parallel")
    (alone, said), (found, again) = told(lambda: call()), told(lambda: call(workers=2))
    assert alike(found, alone) and all(one.tracks is tracks for one, tracks in zip(found, CLIPS, strict=True))
    ours = [(f"{one.source}: said", kt.ConvergenceWarning) for one in CLIPS]
    assert [row[:2] for row in said] == [*ours, ("old", FutureWarning)]
    assert [row for row in again if row[0] != "old"] == [(*row, __file__) for row in ours]
    assert [row[:2] for row in again if row[0] == "old"] == [("old", FutureWarning)] * 2  # of each process
    with warnings.catch_warnings(), pytest.raises(kt.ConvergenceWarning, match=r"clip0\.json: said"):
        warnings.simplefilter("error", kt.KcsWarning)
        call(workers=2)
    assert not recwarn.list


@pytest.mark.filterwarnings("ignore::kcs_torch.errors.KcsWarning")
def test_clips_one_by_one():
    """More processes than clips are not asked for. Gradients do not go through, in one process nor in several."""
    some = [in_space(5, x).to(torch.float32) for x in (-900.0, 700.0)]
    some[1] = replace(some[1], points=some[1].points.clone().requires_grad_() * 1)
    call = partial(kt.reconstruct_all, some, method=RIGID, intrinsics=LENS)
    with torch.inference_mode():
        alone, found = call(), call(workers=9)
    assert alike(found, alone, batch=False) and found[0].points.dtype == torch.float32


@pytest.mark.filterwarnings("ignore::kcs_torch.errors.KcsWarning")
def test_people_who_get_one_lens(monkeypatch):
    """Of two files: who tells the lens comes first in each."""
    people = [
        replace(in_space(5, x), source=f"{file}.json, person {k}")
        for file in "ab"
        for k, x in enumerate((-900.0, 700.0))
    ]
    monkeypatch.setattr(
        one_lens,
        "reconstruct_uncalibrated",
        lambda method, one: replace(method(one), intrinsics=LENS, method=one.source),
    )
    alone, found = (one_lens.by_one_lens(RIGID, people, workers) for workers in (1, 2))
    assert [*found] == [*alone] and sorted(found) == [0, 1, 2, 3]
    assert alike(found.values(), alone.values(), batch=False)
    assert all(one.tracks is people[i] for i, one in found.items())
    first = [one.method for one in found.values() if one.method != "rigid"]
    assert [name.split(", ")[0] for name in first] == ["a.json", "b.json"]
    assert sum(one.distance is not None for one in found.values()) == 2  # the others, through their lens


def test_clips_whose_camera_may_be_near(monkeypatch):
    """Solved as a batch under parallel rays, of which nothing is told yet, then by themselves."""
    unsettled = lambda method, one, lifted: warnings.warn(one.source, kt.KcsWarning, stacklevel=2) or lifted  # noqa: E731
    monkeypatch.setattr(sys.modules["kcs_torch.reconstruct"], "_once_lifted", unsettled)
    beyond = [replace(one, points=one.points - 3000) for one in CLIPS]  # no usual image holds them
    call = partial(kt.reconstruct_all, beyond, method=talking())
    (alone, said), (found, again) = told(lambda: call()), told(lambda: call(workers=2))
    assert alike(found, alone)
    ours = [(one.source, kt.KcsWarning) for one in CLIPS]
    assert [row[:2] for row in said if row[0] != "old"] == [row[:2] for row in again if row[0] != "old"] == ours


def test_a_process_has_one_thread():
    assert list(spread(lambda _: torch.get_num_threads(), range(2), workers=2)) == [1, 1]


def test_errors_are_those_of_one_process():
    beside = [replace(one, points=one.points + 1e9) for one in CLIPS[:2]]
    call = partial(kt.reconstruct_all, beside, method="kcs", intrinsics=(1.0, 1.0, 0.0, 0.0))
    words = []
    for workers in (1, 2):
        with pytest.raises(kt.OptionError, match="intrinsics: expected focal lengths and a principal point") as error:
            call(workers=workers)
        words.append(str(error.value))
    assert words[0] == words[1]


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="processes are not killed so")
def test_a_process_that_dies_is_told_of():
    def die(_):
        os.kill(os.getpid(), signal.SIGKILL)

    with pytest.raises(kt.OptionError, match="workers: one of 2 processes ended .* memory: use fewer workers"):
        list(spread(die, range(2), workers=2))


# ---------------------------------------------------------------------- in this process


@pytest.mark.parametrize("workers", [0, -1, 2.0, True, "2", None])
def test_numbers_that_are_none(workers):
    with pytest.raises(kt.OptionError, match="workers: expected a whole number of processes >= 1, got"):
        kt.reconstruct_all(CLIPS, method="kcs", workers=workers)


def test_tracks_on_other_devices_are_one_batch():
    check_workers(1, [CLIPS[0].to("meta")])
    with pytest.raises(kt.OptionError, match="workers: expected 1 for tracks on meta, which takes many clips as one"):
        check_workers(2, [CLIPS[0], CLIPS[1].to("meta")])


def test_joblib_is_needed_by_several_processes_only(monkeypatch, openpose_folder, tmp_path):
    monkeypatch.setitem(sys.modules, "joblib", None)
    assert len(kt.reconstruct_all(CLIPS[:2], method="kcs")) == 2
    with pytest.raises(kt.OptionError, match=r"workers: needs the package joblib \(.*\): pip install joblib"):
        kt.reconstruct_all(CLIPS[:2], method="kcs", workers=2)
    words = "lift", openpose_folder, "-o", tmp_path / "a.npz", "--person", "all", "--workers", 2
    assert "pip install joblib" in run(*words, code=2).stderr


def test_no_process_starts_for_one_part(monkeypatch):
    """Of one clip, or with one worker, each row is solved when it is asked for."""
    monkeypatch.setattr(processes, "_answers", lambda *_: pytest.fail("started processes"))
    (found,) = kt.reconstruct_all(CLIPS[:1], method="kcs", workers=4)
    assert found.tracks is CLIPS[0]
    assert kt.reconstruct_all([], method="kcs", workers=2) == []
    asked = []
    results = spread(lambda a, b: asked.append(a) or a + b, [1, 2], [10, 20])
    assert next(results) == 11 and asked == [1] and list(results) == [22]
    assert spread_batch(list, CLIPS) == CLIPS


@pytest.mark.parametrize("count", [1, 2, 3, 8])
@pytest.mark.parametrize("frames", [[30] * 8, [10, 10, 1000], [300, 20, 25, 290, 31, 280], [7], []])
def test_parts_hold_clips_of_similar_length(frames, count):
    parts = processes._shares(frames, count)
    assert len(parts) <= min(count, len(frames)) and all(parts)
    assert sorted(i for part in parts for i in part) == [*range(len(frames))]
    assert all(part == sorted(part) for part in parts)
    lengths = [[frames[i] for i in part] for part in parts]
    assert all(max(one) <= min(other) for one, other in pairwise(lengths))
    even = sum(frames) / max(count, 1)
    assert all(sum(one) <= even + max(frames) for one in lengths)


def test_what_is_pickled_comes_back(still):
    """By plain pickles too, with all alternatives."""
    _, result = still
    for copy in (pickle.loads(pickle.dumps(result)), processes._unpacked(processes._packed(result))):
        assert len(copy.alternatives) == len(result.alternatives) > 0
        assert torch.equal(copy.points, result.points) and copy.diagnostics == result.diagnostics
        assert copy.skeleton == result.skeleton and copy.tracks.source == result.tracks.source
        assert torch.equal(copy.tracks.weights, result.tracks.weights)
    for method in (kt.PKC(), kt.SfAM(beta=2.0)):
        assert pickle.loads(pickle.dumps(method)) == method
    held = [result.tracks, result.skeleton]
    assert processes._unpacked(processes._packed(result, held), held).tracks is result.tracks


def test_of_a_part_only_this_part_is_pickled():
    long = walking_person(2000).tracks
    assert len(processes._packed(long.frames(10, 20))) < len(processes._packed(long)) / 50


# ---------------------------------------------------------------------- command line


def test_lift_of_all_people_in_processes(monkeypatch, openpose_folder, tmp_path):
    plain, asked = kt.reconstruct_all, []

    def spied(people, **options):
        asked.append(options.pop("workers", 1))
        return plain(people, **options)

    monkeypatch.setattr(kt, "reconstruct_all", spied)
    words = "lift", openpose_folder, "-o", tmp_path / "a.npz", "--method", "kcs"
    with contextlib.chdir(tmp_path):
        run(*words, "--person", "all", "--workers", 2)
        run(*words)
        assert "--workers: expected it with --person all" in run(*words, "--workers", 2, code=2).stderr
        run(*words, "--person", "all", "--workers", 0, code=2)
    assert asked == [2, 1]
