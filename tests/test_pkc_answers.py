"""What is told beside the best solution: which bones the prior decided, and how sure depth is."""

import math
import warnings
from dataclasses import replace

import pytest
import torch
from animal_samples import four_legged, unlike
from numerics import CHAIN
from torch.testing import assert_close

from kcs_torch import reconstruct
from kcs_torch.data import random_motion, walking_person
from kcs_torch.functional.chain import bone_lengths
from kcs_torch.methods.pkc import answers
from kcs_torch.methods.pkc.answers import angle_doubt, depth_deviation, guess_variance, told_by_prior
from kcs_torch.methods.pkc.hypotheses import Hypotheses
from kcs_torch.methods.pkc.objective import Objective
from kcs_torch.methods.pkc.weights import Weights
from kcs_torch.skeleton import SKELETONS


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


def spread_over_chain(one):
    """Independent bones of one deviation add up from the middle of the chain a-b-c-d."""
    outer = one * ((3 / 4) ** 2 + (2 / 4) ** 2 + (1 / 4) ** 2) ** 0.5  # how the three bones move the first joint
    inner = one * ((1 / 4) ** 2 + (2 / 4) ** 2 + (1 / 4) ** 2) ** 0.5
    return torch.tensor([outer, inner, inner, outer]).double().expand(5, 4)


@pytest.mark.parametrize(("level", "doubt"), [(0.0, 1.0), (0.05, 1.0), (0.05, 0.4)])
def test_deviation_by_hand(level, doubt):
    """Bones of length 1 that point 0.6 away in every frame: tan a = 0.75 where they are nearest to the image plane."""
    noise = torch.full((5, 4), level).double()
    found = depth_deviation(hypotheses([BENT], [0.0]), noise, CHAIN, doubt=doubt)
    told = (math.hypot(0.75, answers.LEAST) * doubt * answers.ANGLE) ** -2 + answers.USUAL**-2
    length = told**-0.5 / math.hypot(0.6, answers.FLAT)
    blur = 2**0.5 * level  # of both ends of a bone
    assert_close(found, spread_over_chain(math.hypot(length, blur / (0.6**2 + blur / answers.LEVEL) ** 0.5)))


def test_noise_makes_a_bone_in_the_image_plane_as_deep_as_its_square_tells():
    """As the root of the noise, and as the noise itself where the bone is steep."""
    for depth, power in ((0.0, 0.5), (1.0, 1.0)):
        found = []
        for level in (1e-4, 1e-2):
            noise = torch.full((5, 4), level).double()
            alone = hypotheses([depth * BENT / 0.6], [0.0])
            clean, noisy = (depth_deviation(alone, n, CHAIN, doubt=1e-6) for n in (0 * noise, noise))
            found.append((noisy.square() - clean.square()).sqrt().mean())
        assert math.log(found[1] / found[0]) / math.log(1e2) == pytest.approx(power, abs=0.01)


def test_what_noise_leaves_open_a_turning_viewpoint_tells():
    for noise, less in ((torch.full((5, 4), 0.01).double(), True), (torch.zeros(5, 4).double(), False)):
        still, turned = (depth_deviation(hypotheses([BENT], [0.0]), noise, CHAIN, doubt=1e-6, turn=t) for t in (0, 150))
        assert bool((turned < 0.9 * still).all()) if less else torch.equal(turned, still)


def test_lengths_are_told_by_bones_that_pass_through_the_image_plane():
    exact = torch.zeros(5, 4).double()
    passing = BENT.clone()
    passing[2] = 0  # one frame in which all bones lie in the plane
    found = depth_deviation(hypotheses([passing], [0.0]), exact, CHAIN)
    least = (answers.LEAST * answers.ANGLE) ** -2 + answers.USUAL**-2
    assert_close(found[0], spread_over_chain(least**-0.5 / math.hypot(0.6, answers.FLAT))[0])
    assert (found[0] < 0.5 * depth_deviation(hypotheses([BENT], [0.0]), exact, CHAIN)[0]).all()


def test_deviation_grows_towards_the_image_plane_and_with_rivals():
    exact = torch.zeros(5, 4).double()
    steep = depth_deviation(hypotheses([BENT], [0.0]), exact, CHAIN)
    bent = BENT.clone()
    bent[0] *= 0.5
    nearer = depth_deviation(hypotheses([bent], [0.0]), exact, CHAIN)
    assert (nearer[0] > nearer[1]).all()
    none = depth_deviation(hypotheses([0 * BENT], [0.0]), exact, CHAIN)
    along = depth_deviation(hypotheses([BENT / 0.6], [0.0]), exact, CHAIN)  # straight at the camera
    assert torch.isfinite(none).all() and torch.isfinite(along).all() and (along > 0).all()
    rivals = [depth_deviation(hypotheses([BENT, -BENT], [0.0, e]), exact, CHAIN) for e in (0.0, 6.0, 1e4)]
    assert (rivals[0][:, 0] > rivals[1][:, 0]).all() and (rivals[1][:, 0] > rivals[2][:, 0]).all()
    assert_close(rivals[2], steep)
    share = answers.RIVAL / (1 + answers.RIVAL)
    assert rivals[0][0, 3].item() == pytest.approx(math.hypot(steep[0, 3].item(), 1.8 * share**0.5))


def test_a_detector_s_joints_are_less_sure():
    """By more noise, by the direction they are seen from, and as rivals may be right though they are worse."""
    exact = torch.zeros(5, 4).double()
    image = torch.zeros(5, 4, 2).double()
    image[..., 1] = torch.tensor([1.0, 0.5, -0.5, -1.0])
    alone = hypotheses([BENT], [0.0])
    found = depth_deviation(alone, exact, CHAIN, image=image)
    noisy = depth_deviation(alone, exact + answers.NEAR, CHAIN)
    assert_close(found.square() - noisy.square(), (answers.HEADING * image[..., 1]).square())
    assert_close(depth_deviation(alone, exact, CHAIN, image=image + 3), found)  # wherever it is in the image
    both = hypotheses([BENT, -BENT], [0.0, 20.0])
    more, usual = (
        depth_deviation(both, exact, CHAIN, image=x).square() - depth_deviation(alone, exact, CHAIN, image=x).square()
        for x in (image, None)
    )
    assert (more[:, 0] > 5 * usual[:, 0]).all()


def test_angles_are_surer_where_the_viewpoint_turns_and_postures_are_usual():
    skeleton = SKELETONS["h36m17"]
    rest = skeleton.template_points(dtype=torch.float64)
    rest = rest - rest.mean(0)
    usual = rest.expand(60, -1, -1)
    odd = usual.clone()
    hand = skeleton.joints.index("left_wrist")
    odd[:, hand, :2] = odd[:, hand, :2] * 1.5 - 0.6
    found = {}
    for name, body in (("usual", usual), ("odd", odd)):
        goal = Objective(skeleton, body[..., :2], Weights(), torch.zeros(60, 17).double())
        lengths = bone_lengths(body, goal.bones).mean(0)
        found[name] = [angle_doubt(goal, body[..., 2], lengths, turn) for turn in (0.0, 22.0, 180.0)]
    still, little, much = found["usual"]
    assert still > little > much > 0
    told = [(still / one) ** 2 - 1 for one in (little, much)]  # by the turn, over what a view from the front tells
    assert told[1] / told[0] == pytest.approx((180 / 22.0) ** (2 * answers.POWER))
    assert found["odd"][0] > still


@pytest.mark.parametrize(
    ("frames", "turn", "factor"),
    [
        (11, 0.0, 1.0),
        (12, 0.0, 3.0),
        (32, 0.0, 1.5),
        (32, 120.0, 1.25),
        (32, 240.0, 1.0),
        (48, 0.0, 1.0),
        (90, 0.0, 1.0),
    ],
)
def test_angles_are_less_sure_in_short_clips_that_do_not_turn(frames, turn, factor, monkeypatch):
    """Up to three times; those of fewer than twelve frames are taken to be noisy instead."""
    skeleton = SKELETONS["h36m17"]
    rest = skeleton.template_points(dtype=torch.float64)
    body = (rest - rest.mean(0)).expand(frames, -1, -1)
    goal = Objective(skeleton, body[..., :2], Weights(), torch.zeros(frames, 17).double())
    lengths = bone_lengths(body, goal.bones).mean(0)
    found = angle_doubt(goal, body[..., 2], lengths, turn)
    monkeypatch.setattr(answers, "SHORT", 0.0)
    assert found == pytest.approx(factor * angle_doubt(goal, body[..., 2], lengths, turn))


@pytest.mark.parametrize("degrees", [10.0, 30.0, 90.0])
def test_angles_are_surer_of_a_body_that_is_seen_from_aside(degrees):
    """From the front nobody sees how far a body leans."""
    skeleton = SKELETONS["h36m17"]
    rest = skeleton.template_points(dtype=torch.float64)
    rest = (rest - rest.mean(0)).expand(30, -1, -1)
    doubts = []
    for angle in (0.0, degrees):
        c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
        body = rest @ torch.tensor([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]).double().mT
        for lying in (False, True):  # turned in the image, it is as sure
            if lying:
                body = body @ torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]).double().mT
            goal = Objective(skeleton, body[..., :2], Weights(), torch.zeros(30, 17).double())
            lengths = bone_lengths(body, goal.bones).mean(0)
            doubts.append(angle_doubt(goal, body[..., 2], lengths, 0.0))
    front, aside = doubts[::2]
    assert doubts[1::2] == pytest.approx(doubts[::2])
    least = (answers.SIDE / answers.FRONT) ** 2  # the share of the variance that is the same from all sides
    assert (aside / front) ** 2 == pytest.approx((1 / (1 + (s / answers.ASIDE) ** 2) + least) / (1 + least), rel=0.03)
    assert aside / front < (0.55 if degrees < 20 else 0.35)


@pytest.mark.parametrize("degrees", [20.0, 40.0, 90.0])
def test_angles_are_less_sure_of_a_body_that_is_seen_from_above(degrees):
    """All bones along it are foreshortened together; straight from above no more than the steepest that count."""
    skeleton = SKELETONS["h36m17"]
    rest = skeleton.template_points(dtype=torch.float64)
    rest = (rest - rest.mean(0)) @ torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]).double().mT
    doubts = []
    for angle in (0.0, degrees):
        c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
        body = (rest @ torch.tensor([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]]).double().mT).expand(30, -1, -1)
        goal = Objective(skeleton, body[..., :2], Weights(), torch.zeros(30, 17).double())
        lengths = bone_lengths(body, goal.bones).mean(0)
        doubts.append(angle_doubt(goal, body[..., 2], lengths, 0.0))
    level, tilted = doubts
    least = answers.FRONT**2 / (1 + 1 / answers.ASIDE**2) + answers.SIDE**2
    more = answers.TILT**2 * s**2 / max(c**2, 1 - answers.STEEP**2)
    assert (tilted / level) ** 2 == pytest.approx(1 + more / least, rel=0.03)


def test_noise_in_one_frame_is_that_frame_s():
    """Of a few frames in many a length is hardly less sure."""
    noise = torch.zeros(5, 4).double()
    noise[2, 3] = 0.1  # the end of the last bone
    clean, found = (depth_deviation(hypotheses([BENT], [0.0]), n, CHAIN) for n in (0 * noise, noise))
    others = [0, 1, 3, 4]
    assert (found[2] > clean[2]).all() and (found[2] - clean[2]).argmax() == 3
    assert_close(found[others], clean[others])


def test_a_body_that_leans_hardly_shows_in_noise_unless_from_aside():
    skeleton = SKELETONS["h36m17"]
    rest = skeleton.template_points(dtype=torch.float64)
    share = []
    for degrees in (10.0, 90.0):
        c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
        body = (rest - rest.mean(0)) @ torch.tensor([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]).double().mT
        body = body.expand(60, -1, -1)
        doubts = []
        for level in (0.0, 0.003):
            goal = Objective(skeleton, body[..., :2], Weights(), torch.full((60, 17), level).double())
            doubts.append(angle_doubt(goal, body[..., 2], bone_lengths(body, goal.bones).mean(0), 0.0))
        share.append(doubts[1] / doubts[0])
    assert share[0] > 1.2 > 1.15 > share[1] > 1


@pytest.mark.parametrize(("swing", "noisy"), [(0.0, True), (1.0, False)])
def test_a_body_at_rest_is_as_unsure_as_a_few_frames_are(swing, noisy):
    """It shows one pose, however long: with exact lengths a body unlike its template would lean."""
    clip = walking_person(60, turn=0.0, yaw=50.0, generator=torch.Generator().manual_seed(0)).tracks
    first = clip.points[:1]
    tracks = replace(clip, points=first + swing * (clip.points - first))
    long, short = (reconstruct(tracks.frames(0, n), intrinsics="parallel") for n in (60, 6))
    assert (long.uncertainty.mean() > 0.7 * short.uncertainty.mean()) == noisy
    same = (long.points[:6] - short.points).norm(dim=-1).mean() / short.points.norm(dim=-1).mean()
    assert not noisy or same < 0.1


def test_a_guessed_template_s_directions_are_as_unsure_as_bones_stray():
    """Half of the square of an angle goes in depth; a turn that tells as much as the template halves it."""
    guess = four_legged()
    lengths = torch.linspace(1.0, 2.0, guess.num_bones).double()
    still, turned = (guess_variance(guess, lengths, turn) for turn in (0.0, answers.TURN))
    stray = torch.tensor(guess.spread).double().deg2rad().sin()
    assert_close(still, (lengths * stray).square() / 2)
    assert_close(turned, still / 2)
    people = guess_variance(SKELETONS["h36m17"], torch.ones(16).double(), 0.0)
    assert not people.any()
    assert (guess_variance(SKELETONS["ap10k"], torch.ones(16).double(), 0.0) > 0).all()
    exact = torch.zeros(5, 4).double()
    more = depth_deviation(hypotheses([BENT], [0.0]), exact, CHAIN, guess=torch.full((3,), 0.2**2).double())
    usual = depth_deviation(hypotheses([BENT], [0.0]), exact, CHAIN)
    assert_close((more.square() - usual.square()).sqrt(), spread_over_chain(0.2))


@pytest.mark.parametrize("yaw", [60.0, 90.0])
def test_depth_by_a_guessed_template_is_a_hint(yaw):
    """An animal whose bones stray from the guess for the whole clip; the template of its own is a measurement's."""
    guess = four_legged()
    known = unlike(guess)
    clip = random_motion(known, 60, turn=0.0, yaw=yaw, swing=8.0, generator=torch.Generator().manual_seed(0))
    covered = {}
    for body in (guess, known):
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            result = reconstruct(replace(clip.tracks, skeleton=body), intrinsics="parallel")
        off = (result.points - clip.points)[..., 2]
        off = (off - off.mean(-1, keepdim=True)).abs()
        covered[body is guess] = float((off <= result.uncertainty).double().mean())
        assert ("a guessed template" in result.diagnostics.doubt) == (body is guess)
        assert any("a guessed template" in str(one.message) for one in told) == (body is guess)
    assert min(covered.values()) > 0.65
