"""Methods make nothing on another device than the tracks': run where the default device holds no numbers at all."""

import pytest
import torch
from torch.testing import assert_close

import kcs_torch as kt
from kcs_torch.data import walking_person
from kcs_torch.methods.answer.root import standing_feet

METHODS = ("kcs", "sfam", "pkc")


def walk(turn, frames=45):
    """Noisy tracks with gaps, whose feet stand still long enough to count."""
    return walking_person(frames, turn=turn, noise=3.0, missing=0.05, generator=torch.Generator().manual_seed(0)).tracks


@pytest.mark.parametrize("name", (*METHODS, "pnd"))
@pytest.mark.parametrize("turn", [0.0, 150.0])
@pytest.mark.filterwarnings("ignore::kcs_torch.KcsWarning")
def test_everything_is_made_where_the_tracks_are(name, turn):
    clip = walk(turn)
    assert standing_feet(clip) is not None  # else contacts make nothing
    method = kt.METHODS[name]()
    expected = method(clip)
    with torch.device("meta"):  # a tensor that is made without a device would have no numbers
        found = method(clip)
        (together,) = method.many([clip]) if turn else (found,)
    for result in (found, together):
        assert result.points.device == result.cameras.device == clip.points.device
        assert_close(result.points, expected.points)


@pytest.mark.parametrize("known", [False, True], ids=["free", "known cameras"])
@pytest.mark.parametrize("name", ["kcs", "pkc"])
@pytest.mark.filterwarnings("ignore::kcs_torch.KcsWarning")
def test_full_perspective_too(name, known):
    clip = walk(0.0, 12)
    cameras = torch.eye(3, dtype=clip.points.dtype)[:2].expand(12, -1, -1) if known else None
    lens = (1500.0, 1500.0, 0.0, 0.0)
    expected = kt.reconstruct(clip, method=name, intrinsics=lens, cameras=cameras)
    with torch.device("meta"):
        found = kt.reconstruct(clip, method=name, intrinsics=lens, cameras=cameras)
    assert found.points.device == found.cameras.device == found.distance.device == clip.points.device
    assert_close(found.points, expected.points)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU here")
@pytest.mark.parametrize("name", METHODS)
@pytest.mark.filterwarnings("ignore::kcs_torch.KcsWarning")
def test_on_a_gpu(name):
    clip = walking_person(60, turn=150.0).tracks
    found = kt.METHODS[name]()(clip.to("cuda"))
    assert found.points.is_cuda
    assert_close(found.points.cpu(), kt.METHODS[name]()(clip).points, rtol=0, atol=1.0)  # of 1750 mm


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU here")
@pytest.mark.filterwarnings("ignore::kcs_torch.KcsWarning")
def test_full_perspective_on_a_gpu():
    clip = walk(0.0).to("cuda")
    found = kt.reconstruct(clip, method="kcs", intrinsics=(1500.0, 1500.0, 0.0, 0.0))
    assert found.points.is_cuda and found.distance.is_cuda and bool(found.points.isfinite().all())
