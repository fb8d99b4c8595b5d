"""The live mode: which frames and options are refused, and in what words."""

import copy
import pickle

import numpy as np
import pytest
import torch

import kcs_torch as kt
from kcs_torch.data import walking_person
from kcs_torch.live.options import Options

FRAMES = walking_person(2, skeleton="coco17").tracks.points[:, :17]


def test_lengths_of_windows_are_whole_numbers_of_any_kind():
    assert kt.Tracker("coco17", window=np.int64(24)).window == 24
    for wrong in (24.0, True, 5):
        with pytest.raises(kt.OptionError, match=f"window: expected at least 12 frames, a whole number, got {wrong}"):
            kt.Tracker("coco17", window=wrong)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda x: x[:16], r"frame 1: xy: expected shape \(17, 2\).*got \(16, 2\)"),
        (lambda x: x[None], "frame 1: xy: expected 2 dimensions"),
        (lambda x: x.index_fill(0, torch.tensor([7]), torch.inf), "frame 1: xy: joint 'left_elbow' is infinite"),
        (lambda x: 1e200 * x, "frame 1: xy: joint 'nose': expected coordinates up to 1e"),
        (lambda x: "a camera", "frame 1: xy: expected an array of numbers"),
    ],
)
def test_bad_frames_are_named_and_not_taken(change, message):
    tracker = kt.Tracker("coco17", fps=30)
    tracker.update(FRAMES[0])
    with pytest.raises(kt.ShapeError, match=message):
        tracker.update(change(FRAMES[1]))
    assert tracker.update(FRAMES[1]).frame == 1


@pytest.mark.parametrize("value", [-0.1, 1.5, np.inf])
def test_bad_confidence(value):
    sure = np.ones(17)
    sure[3] = value
    with pytest.raises(kt.ShapeError, match="frame 0: confidence: joint 'left_ear'"):
        kt.Tracker("coco17", fps=30).update(FRAMES[0], sure)
    with pytest.raises(kt.ShapeError, match=r"frame 0: confidence: expected shape \(17,\)"):
        kt.Tracker("coco17", fps=30).update(FRAMES[0], np.ones(5))


def test_bad_options():
    for options in (
        {"fps": 0},
        {"fps": "fast"},
        {"fps": 1e12, "window": 30},
        {"fps": 10**400},
        {"window": 3},
        {"period": 0.5},
        {"threshold": 2},
        {"method": "kcs"},
    ):
        with pytest.raises(kt.OptionError, match=next(iter(options))):
            kt.Tracker("coco17", **{"fps": 30, **options})
    loop = kt.SKELETONS["coco17"].with_links([("left_wrist", "right_wrist")])
    with pytest.raises(kt.SkeletonError, match="one tree"):
        kt.Tracker(loop)
    with pytest.raises(kt.SkeletonError, match="got 'auto'; kcs_torch.find_skeleton finds one from a clip"):
        kt.Tracker("auto")
    with pytest.raises(kt.ShapeError, match="nothing to reconstruct"):
        kt.Tracker("coco17").result()


def test_options_cannot_change():
    with kt.Tracker("coco17") as tracker:
        for name in Options._fields:
            before = getattr(tracker, name)
            with pytest.raises(AttributeError, match=rf"Tracker: {name} cannot change: make a new one.*{name}=15"):
                setattr(tracker, name, 15)
            assert getattr(tracker, name) == before


@pytest.mark.parametrize(
    "option", [{"units": 5}, {"wait": "no"}, {"image_size": "large"}, {"image_size": (1920, 1080), "units": "mm"}]
)
def test_odd_options_are_told(option):
    with pytest.raises(kt.OptionError, match=f"(Tracker: )?{next(iter(option))}"):
        kt.Tracker("coco17", **option)


def test_units_are_spelt_as_elsewhere():
    with kt.Tracker("coco17", units="Millimetres") as tracker:
        assert tracker.units == "mm"


@pytest.mark.parametrize("how", [pickle.dumps, copy.copy, copy.deepcopy])
def test_no_copy_is_made(how):
    with kt.Tracker("coco17") as tracker, pytest.raises(TypeError, match=r"Tracker: cannot be copied or pickled"):
        how(tracker)
