"""What is told beside the best solution: which bones the prior decided, and how sure depth is."""

import math

import pytest
import torch
from numerics import CHAIN
from torch.testing import assert_close

from kcs_torch.methods.pkc import answers
from kcs_torch.methods.pkc.answers import depth_deviation, told_by_prior
from kcs_torch.methods.pkc.hypotheses import Hypotheses


def hypotheses(depths, energy, lengths=None):
    depths = torch.stack(depths).double()
    lengths = torch.ones(len(depths), 3).double() if lengths is None else lengths
    return Hypotheses(depths, lengths, torch.tensor(energy).double())


BENT = torch.tensor([[-0.9, -0.3, 0.3, 0.9]]).repeat(5, 1).double()  # a chain of three bones that points away


def test_bones_that_a_rival_flips():
    flipped = BENT.clone()
    flipped[:, 3] = -0.3  # the last bone comes back
    rival = hypotheses([BENT, flipped], [1.0, 2.0])
    assert told_by_prior(rival, CHAIN) == ["c-d"]
    far = hypotheses([BENT, flipped], [1.0, 1.0 + 2 * answers.CLOSE])
    assert told_by_prior(far, CHAIN) == []
    brief = BENT.clone()
    brief[0, 3] = -0.3  # in one frame of five
    assert told_by_prior(hypotheses([BENT, brief], [1.0, 2.0]), CHAIN) == []
    shallow = hypotheses([0.1 * BENT, -0.1 * BENT], [1.0, 2.0])  # nearly in the image plane
    assert told_by_prior(shallow, CHAIN) == []
    assert told_by_prior(rival[:1], CHAIN) == []


@pytest.mark.parametrize("level", [0.0, 0.05])
def test_deviation_by_hand(level):
    """Independent bones, dL L / |dz|, add up from the middle: of the chain a-b-c-d, lengths 1, depths 0.6."""
    noise = torch.full((5, 4), level).double()
    found = depth_deviation(hypotheses([BENT], [0.0]), noise, CHAIN)
    wrong = math.hypot(answers.LENGTH, answers.NOISE * 2**0.5 * level)  # of both ends of a bone
    one = wrong / 0.6 * answers.CALIBRATION
    outer = one * ((3 / 4) ** 2 + (2 / 4) ** 2 + (1 / 4) ** 2) ** 0.5  # how the three bones move the first joint
    inner = one * ((1 / 4) ** 2 + (2 / 4) ** 2 + (1 / 4) ** 2) ** 0.5
    assert_close(found, torch.tensor([outer, inner, inner, outer]).double().expand(5, 4))


def test_deviation_grows_towards_the_image_plane_and_with_rivals():
    exact = torch.zeros(5, 4).double()
    steep = depth_deviation(hypotheses([BENT], [0.0]), exact, CHAIN)
    flat = depth_deviation(hypotheses([0.5 * BENT], [0.0]), exact, CHAIN)
    none = depth_deviation(hypotheses([0 * BENT], [0.0]), exact, CHAIN)
    assert (steep < flat).all() and (flat < none).all() and torch.isfinite(none).all()
    rivals = [depth_deviation(hypotheses([BENT, -BENT], [0.0, e]), exact, CHAIN) for e in (0.0, 10.0, 1e4)]
    assert (rivals[0][:, 0] > rivals[1][:, 0]).all() and (rivals[1][:, 0] > rivals[2][:, 0]).all()
    assert_close(rivals[2], steep)
    assert rivals[0][0, 3].item() == pytest.approx(math.hypot(steep[0, 3].item(), 1.8 * 0.5**0.5 * answers.CALIBRATION))


def test_noise_in_one_frame_is_that_frame_s():
    noise = torch.zeros(5, 4).double()
    noise[2, 3] = 0.1  # the end of the last bone
    clean, found = (depth_deviation(hypotheses([BENT], [0.0]), n, CHAIN) for n in (0 * noise, noise))
    assert (found[2] > clean[2]).all() and found[2].argmax() == 3
    others = [0, 1, 3, 4]
    assert_close(found[others], clean[others])
