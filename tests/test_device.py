"""Methods make nothing on another device than the tracks': run where the default device holds no numbers at all."""

import pytest
import torch
from torch.testing import assert_close

import kcs_torch as kt
from kcs_torch.data import walking_person

METHODS = ("kcs", "sfam", "pkc")


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("turn", [0.0, 150.0])
@pytest.mark.filterwarnings("ignore::kcs_torch.KcsWarning")
def test_everything_is_made_where_the_tracks_are(name, turn):
    clip = walking_person(24, turn=turn, noise=3.0, missing=0.05, generator=torch.Generator().manual_seed(0)).tracks
    method = kt.METHODS[name]()
    expected = method(clip)
    with torch.device("meta"):  # a tensor that is made without a device would have no numbers
        found = method(clip)
        (together,) = method.many([clip])
    for result in (found, together):
        assert result.points.device == result.cameras.device == clip.points.device
        assert_close(result.points, expected.points)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU here")
@pytest.mark.parametrize("name", METHODS)
@pytest.mark.filterwarnings("ignore::kcs_torch.KcsWarning")
def test_on_a_gpu(name):
    clip = walking_person(60, turn=150.0).tracks
    found = kt.METHODS[name]()(clip.to("cuda"))
    assert found.points.is_cuda
    assert_close(found.points.cpu(), kt.METHODS[name]()(clip).points, rtol=0, atol=1.0)  # of 1750 mm
