"""Before a viewpoint that goes round the body, aligned bones tell which signs are wrong, and polishing does not."""

from itertools import pairwise

import pytest
import torch
from pkc_walks import centred
from torch.testing import assert_close

from kcs_torch.data import walking_person
from kcs_torch.functional import bone_lengths, bone_vectors
from kcs_torch.methods.clips.lockstep import run
from kcs_torch.methods.pkc import around
from kcs_torch.methods.pkc.around import turned_around
from kcs_torch.methods.pkc.batch import serve
from kcs_torch.methods.pkc.body import Body, agree
from kcs_torch.methods.pkc.flips import flipped_runs
from kcs_torch.methods.pkc.hypotheses import Hypotheses


@pytest.fixture(scope="module")
def walk():
    """A body and its true depths (T, N)."""
    clip = walking_person(60, turn=180.0)
    size = centred(clip.tracks.points).square().mean().sqrt()
    body = Body(clip.skeleton, centred(clip.tracks.points) / size, 30.0, torch.zeros_like(clip.tracks.weights))
    return body, centred(clip.points)[..., 2] / size * body.factor


def test_depths_agree_up_to_a_share_and_the_mirror():
    depth = torch.linspace(-1, 2, 12).view(4, 3)
    for other in (1.05 * depth, -1.05 * depth):
        assert agree(other, depth, 0.051) and not agree(other, depth, 0.049)


def hypotheses(body, depth):
    lengths = bone_lengths(body.joints(depth[None]), body.objective.bones).median(1).values
    return Hypotheses(depth[None], lengths, body.objective(depth[None], lengths))


def with_wrong_run(body, depth, joint):
    """Depths whose bone to a joint has the wrong sign between two passages through the image plane, or to the end."""
    own = bone_vectors(depth[..., None], body.objective.bones)[..., 0].clone()
    bone = next(b for b, ends in enumerate(body.objective.bones.tolist()) if ends[1] == body.skeleton.index(joint))
    passes = (own[1:, bone] * own[:-1, bone] < 0).nonzero().flatten() + 1
    bounds = [0, *passes.tolist(), len(own)]
    start, end = max(pairwise(bounds), key=lambda ends: float(own[slice(*ends), bone].abs().sum()))
    own[start:end, bone] *= -1
    return body.objective.joints(own)


@pytest.mark.parametrize("joint", ["right_knee", "left_elbow"])
def test_a_wrong_run_is_found(walk, joint):
    body, depth = walk
    wrong = with_wrong_run(body, depth, joint)
    assert (wrong - depth).square().mean().sqrt() > 0.02
    rest = Hypotheses(-depth[None], hypotheses(body, depth).lengths, torch.ones(1).double())
    found = hypotheses(body, wrong).joined(rest)
    better = run(turned_around(body, found, 0.5 * depth), serve)
    assert_close(better.depth[0], depth, rtol=0, atol=0.03)
    assert_close(better.depth[1], found.depth[1], rtol=0, atol=0)
    assert_close(better.energy, found.energy, rtol=0, atol=0)


def test_runs_of_several_bones_are_turned_over_at_once(walk, monkeypatch):
    body, depth = walk
    wrong = with_wrong_run(body, with_wrong_run(body, depth, "right_ankle"), "left_elbow")
    monkeypatch.setattr(around, "TIMES", 1)
    better = run(turned_around(body, hypotheses(body, wrong), 0.5 * depth), serve)
    assert_close(better.depth[0], depth, rtol=0, atol=0.03)


def test_what_is_right_or_confirmed_stays(walk):
    """Nothing is asked for where the turn confirms what was found, or its mirror image."""
    body, depth = walk
    found = hypotheses(body, depth)
    assert run(turned_around(body, found, 0.5 * depth), serve) is found
    wrong = hypotheses(body, with_wrong_run(body, depth, "right_knee"))

    def nobody(requests):
        raise AssertionError

    for sign in (1, -1):
        assert run(turned_around(body, wrong, 1.02 * sign * wrong.depth[0]), nobody) is wrong


def test_a_clip_without_flips_stays(walk, monkeypatch):
    """None is likely, or there are none at all."""
    body, depth = walk
    wrong = hypotheses(body, with_wrong_run(body, depth, "right_knee"))
    monkeypatch.setattr(around, "UNLIKELY", -torch.inf)
    assert run(turned_around(body, wrong, 0.5 * depth), serve) is wrong
    none = lambda own, member, acceleration: flipped_runs(own, member, acceleration).some(torch.zeros(0).long())  # noqa: E731
    monkeypatch.setattr(around, "flipped_runs", none)
    assert run(turned_around(body, wrong, 0.5 * depth), serve) is wrong
