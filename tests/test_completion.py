"""Unseen joints from the rest of the clip."""

import pytest
import torch
from numerics import BATCHES, DEVICES, FLOATS, leaves_arguments_alone, normal
from torch.testing import assert_close

from kcs_torch.errors import OptionError, ShapeError
from kcs_torch.functional import interpolate
from kcs_torch.solvers import complete_tracks


def clip(*batch, frames=60, joints=15, rank=3):
    """Tracks (..., T, N, 2) of low rank about their mean, and which are seen: each joint vanishes for a while."""
    time = torch.linspace(0, 12, frames, dtype=torch.float64)
    waves = torch.stack([(time * (k + 1) / 2 + k).sin() for k in range(rank)], -1)
    tracks = (waves @ normal(*batch, rank, joints * 2)).unflatten(-1, (joints, 2)) + normal(joints, 2, seed=1)
    start = torch.arange(joints) * 3
    frame = torch.arange(frames)[:, None]
    return tracks, ((frame < start) | (frame >= start + 12)).expand(tracks.shape[:-1])


@pytest.mark.parametrize("batch", BATCHES)
def test_low_rank_tracks_are_found(batch):
    tracks, seen = clip(*batch)
    spoiled = torch.where(seen[..., None], tracks, torch.full_like(tracks, 1e3))
    found = leaves_arguments_alone(complete_tracks, spoiled, seen)
    assert torch.equal(found[seen], tracks[seen])
    error = (found - tracks)[~seen].square().mean().sqrt()
    linear = (interpolate(spoiled, seen) - tracks)[~seen].square().mean().sqrt()
    assert error < 0.5 * linear


def test_batches_equal_loops():
    tracks, seen = clip(2, 3)
    parts = [complete_tracks(t, s) for t, s in zip(tracks.flatten(0, 1), seen.flatten(0, 1), strict=True)]
    assert_close(complete_tracks(tracks, seen), torch.stack(parts).reshape(tracks.shape))


def test_nothing_to_do():
    tracks, seen = clip()
    assert torch.equal(complete_tracks(tracks, torch.ones_like(seen)), tracks)


@pytest.mark.parametrize("frames", [1, 2, 5])
@pytest.mark.parametrize("dtype", FLOATS)
def test_degenerate_clips_are_finite(frames, dtype):
    for tracks in (normal(frames, 4, 2, dtype=dtype), torch.zeros(frames, 4, 2, dtype=dtype)):
        for seen in (torch.zeros(frames, 4, dtype=torch.bool), normal(frames, 4) > 0):
            assert torch.isfinite(complete_tracks(tracks, seen)).all()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", FLOATS)
def test_results_follow_dtype_and_device(dtype, device):
    tracks, seen = clip()
    found = complete_tracks(tracks.to(device, dtype), seen.to(device))
    assert (found.dtype, found.device.type) == (dtype, device)


@pytest.mark.parametrize("blank", [[30], [0], [59], [10, 11, 12, 13], list(range(20, 50))])
def test_frames_without_any_joint_lie_between_their_neighbours(blank):
    """The least nuclear norm alone would put them at the mean pose."""
    tracks, seen = clip()
    full = torch.ones_like(seen)
    full[blank] = False
    found = complete_tracks(tracks, full)
    assert_close(found, interpolate(tracks, full))
    gaps = seen & full
    found = complete_tracks(tracks, gaps)
    assert_close(found, interpolate(found, full))
    if blank[0] > 0 and blank[-1] < 59:
        low, high = found[blank[0] - 1], found[blank[-1] + 1]
        share = torch.arange(1.0, len(blank) + 1, dtype=torch.float64)[:, None, None] / (len(blank) + 1)
        assert_close(found[blank], low + share * (high - low))


def test_frames_that_pad_a_clip_do_not_count():
    """Gaps at the end were filled towards what they held, if that was said to be seen."""
    tracks, seen = clip(2)
    seen = seen.clone()
    seen[:, 44:48, 3] = False
    inside = (torch.arange(60) < 48).expand(2, 60)
    padded = torch.where(inside[..., None, None], tracks, 1e3)
    found = complete_tracks(padded, seen | ~inside[..., None], inside=inside)
    assert_close(found[:, :48], complete_tracks(tracks[:, :48], seen[:, :48]))
    assert (found[:, 48:] == 0).all()


def test_what_makes_no_sense_is_refused():
    tracks, seen = clip()
    with pytest.raises(OptionError, match=r"expected positive first and last weights, got 0.0 and 0.002"):
        complete_tracks(tracks, seen, first=0.0)
    with pytest.raises(ShapeError, match=r"complete_tracks: inside: expected shape \(\.\.\., 60\), got \(59,\)"):
        complete_tracks(tracks, seen, inside=torch.ones(59, dtype=torch.bool))


def test_joints_never_seen_stay_with_the_others():
    tracks, seen = clip()
    never = seen.clone()
    never[:, 4] = False
    found = complete_tracks(tracks, never)
    others = [i for i in range(15) if i != 4]
    assert_close(found[:, others], complete_tracks(tracks[:, others], seen[:, others]), rtol=0.2, atol=0.2)
    low, high = tracks.amin((0, 1)), tracks.amax((0, 1))
    assert ((low <= found[:, 4]) & (found[:, 4] <= high)).all()
