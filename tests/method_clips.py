"""Clips that every method is tried on, and what holds for every result."""

import math
from dataclasses import replace

import pytest
import torch
from torch.testing import assert_close

from kcs_torch import METHODS, Tracks, reconstruct
from kcs_torch.data import walking_person
from kcs_torch.functional import bone_lengths, viewpoint_turn

NAN = math.nan
quiet = pytest.mark.filterwarnings("ignore::kcs_torch.errors.KcsWarning")
CLIP = walking_person(12, turn=100.0)
WALK = CLIP.tracks.points
BODY = CLIP.tracks.skeleton


def tracks_of(points, **options):
    return Tracks.from_arrays(points, **({"skeleton": BODY} | options))


def notes(tracks, method, **fields):
    """All that is said of a result."""
    return " | ".join(reconstruct(tracks, method=method, **fields).diagnostics.notes)


def hidden(*index):
    points = WALK.clone()
    points[index] = NAN
    return tracks_of(points)


def half():
    points = WALK.clone()
    points[torch.rand(12, 17, generator=torch.Generator().manual_seed(0)) < 0.5] = NAN
    return tracks_of(points)


def one_place(joint, other):
    points = WALK.clone()
    points[:, joint] = points[:, other]
    return tracks_of(points)


ONE_POINT = torch.zeros(12, 17, dtype=torch.bool)
ONE_POINT[3, 5] = True


# The pelvis (0) and the left leg hang together as 0-4-5-6; 7 and 8 are the spine.
CASES = {
    "ordinary": lambda: CLIP.tracks,
    "virtual joints": lambda: walking_person(12, skeleton="coco17").tracks,
    "one frame": lambda: tracks_of(WALK[:1]),
    "two frames": lambda: tracks_of(WALK[:2]),
    "three frames": lambda: tracks_of(WALK[:3]),
    "five frames": lambda: tracks_of(WALK[:5]),
    "two joints": lambda: tracks_of(WALK[:, 4:6], skeleton=None, edges=[[0, 1]]),
    "three joints": lambda: tracks_of(WALK[:, 4:7], skeleton=None, edges=[[0, 1], [1, 2]]),
    "two joints, one frame": lambda: tracks_of(WALK[:1, 4:6], skeleton=None, edges=[[0, 1]]),
    "static": lambda: tracks_of(WALK[:1].expand(12, 17, 2)),
    "at one point": lambda: tracks_of(torch.full((12, 17, 2), 300.0).double()),
    "at the origin": lambda: tracks_of(torch.zeros(12, 17, 2).double()),
    "a joint never seen": lambda: hidden(slice(None), 5),
    "a leaf never seen": lambda: hidden(slice(None), 6),
    "a limb never seen": lambda: hidden(slice(None), [4, 5, 6]),
    "one joint ever seen": lambda: hidden(slice(None), slice(1, 17)),
    "a blank frame": lambda: hidden(4),
    "blank frames": lambda: hidden([2, 3, 4, 9]),
    "first frame blank": lambda: hidden(0),
    "last frame blank": lambda: hidden(11),
    "all frames but one blank": lambda: hidden([*range(5), *range(6, 12)]),
    "half unseen": half,
    "one point seen": lambda: tracks_of(torch.where(ONE_POINT[..., None], WALK, NAN)),
    "zero-length bone": lambda: one_place(5, 4),
    "no bones": lambda: tracks_of(WALK, skeleton=None),
    "closed chain": lambda: tracks_of(WALK[:, :4], skeleton=None, edges=[[0, 1], [1, 2], [2, 3], [3, 0]]),
    "separate pieces": lambda: tracks_of(WALK[:, :7], skeleton=None, edges=[[0, 1], [1, 2], [3, 4], [4, 5]]),
    "no template": lambda: tracks_of(WALK, skeleton=replace(BODY, template=None)),
    "single precision": lambda: tracks_of(WALK.float()),
    "single precision, far off": lambda: tracks_of(WALK.float() + 3e4),
    "very large": lambda: tracks_of(WALK.float() * 1e20),
    "very small": lambda: tracks_of(WALK * 1e-200),
}  # fmt: skip


def image_of(result):
    """Where the camera sees the result: (T, N, 2)."""
    middle = result.points[..., :2].mean(1, keepdim=True)
    return middle + result.scales[:, None, None] * (result.points[..., :2] - middle)


def check(result, tracks):
    """Check all that holds for every result."""
    frames, joints, bones = tracks.num_frames, tracks.num_joints, tracks.skeleton.num_bones
    fields = {
        "points": (frames, joints, 3),
        "cameras": (frames, 2, 3),
        "scales": (frames,),
        "lengths": (bones,),
    }
    for field, shape in fields.items():
        value = getattr(result, field)
        assert value.shape == shape, field
        assert value.dtype == tracks.points.dtype, field
        assert torch.isfinite(value).all(), field
    assert result.units == tracks.units and result.method in METHODS
    tracks = METHODS[result.method]().prepared(tracks)  # the very same if nothing is wrong with them
    assert result.tracks is tracks or torch.equal(result.tracks.weights, tracks.weights)
    fine = 1e-9 if tracks.points.dtype == torch.float64 else 1e-5
    eye = torch.eye(2).expand(frames, 2, 2).to(result.cameras)
    assert_close(result.cameras @ result.cameras.mT, eye, rtol=0, atol=fine)
    assert (result.scales > 0).all() and result.scales.mean().item() == pytest.approx(1, abs=fine)
    told = result.diagnostics
    size = bone_lengths(result.points, tracks.skeleton.bone_index())
    assert_close(result.lengths, size.median(0).values)
    assert told.viewpoint_turn == pytest.approx(float(viewpoint_turn(result.cameras)), abs=1e-6)
    assert 0 <= told.viewpoint_turn <= 180
    assert any("the viewpoint turned by" in n for n in told.notes) == (told.viewpoint_turn < 30 and frames > 1)
    assert any("a single image shows one viewpoint" in n for n in told.notes) == (frames == 1)
    assert told.unseen_share == tracks.unseen_share
    ever = tracks.seen.any(0)
    shown = [b for b in tracks.skeleton.rigid if ever[list(tracks.skeleton.bones[b])].all()]
    if shown:
        mean = size.mean(0)  # a bone of no length has one of rounding, which does not count
        share = torch.where(mean > 1e-6 * mean.max(), (size / mean).std(0, unbiased=False), 0)
        share = 100 * float(share[shown].median())
        assert told.bone_variation == pytest.approx(share, rel=1e-3, abs=1e-3 if fine > 1e-6 else 1e-9)
    else:
        assert math.isnan(told.bone_variation)
    extent = tracks.points.abs().max().item() or 1.0
    error = ((image_of(result) - tracks.points) / extent).norm(dim=-1)[tracks.seen].square().mean().sqrt()
    assert told.reprojection_rms / extent == pytest.approx(float(error), rel=1e-3, abs=max(fine, 1e-7))
    assert told.converged in (True, False) and told.iterations >= 1 and told.seconds > 0
    assert told.converged != any("did not settle" in n for n in told.notes)
