"""The objective of hypotheses: its terms by hand, its gradient, noise, and pace."""

import itertools
import math
from dataclasses import replace

import pytest
import torch
from numerics import gradcheck, normal
from objective_walks import energy_of, lengths_of, objective, walk
from torch.testing import assert_close

from kcs_torch.data import walking_person
from kcs_torch.functional import bone_lengths, bone_vectors
from kcs_torch.methods.answer.root import standing_feet
from kcs_torch.methods.pkc import objective as module
from kcs_torch.methods.pkc.objective import BLUR, Objective, bone_noise
from kcs_torch.methods.pkc.refinement import minimise
from kcs_torch.methods.pkc.weights import Weights, at_pace, in_noise, pace_of
from kcs_torch.nn import PostureEnergy
from kcs_torch.skeleton import SKELETONS


def test_terms_by_hand():
    points = walk(6)
    found = objective(points)
    lengths = bone_lengths(points, found.bones).mean(0)
    off = points + 0.02 * normal(6, 17, 3) * torch.tensor([0.0, 0.0, 1.0])
    terms = found.terms(off[None, ..., 2], 1.05 * lengths[None])
    bend = bone_vectors(off, found.bones)[..., 2].diff(n=2, dim=0)
    assert_close(terms["smoothness"], (bend.square().sum() / (2 * Weights().acceleration ** 2))[None])
    assert_close(terms["posture"], found.posture(off, 1.05 * lengths)[None])
    assert_close(terms["foreshortening"], found.foreshortening(off, 1.05 * lengths)[None])
    assert_close(terms["proportions"], found.proportions(lengths)[None])
    assert found.posture.kappa == Weights().kappa and found.posture.correlation == Weights().posture
    assert "anchor" not in terms and all(v.shape == (1,) for v in terms.values())
    assert_close(energy_of(found, off, 1.05 * lengths), sum(terms.values()))
    anchored = objective(points, anchor=lengths)
    anchor = anchored.terms(off[None, ..., 2], 1.05 * lengths[None])["anchor"]
    assert anchor.item() == pytest.approx(16 * (torch.tensor(1.05).log().item() / 0.01) ** 2 / 2, rel=1e-5)


def test_smoothness_counts_less_in_noise():
    points = walk(6)
    noise = 0.002 * (1 + normal(6, 17).abs())
    clear, found = objective(points), Objective(SKELETONS["h36m17"], points[..., :2], Weights(), noise)
    state = points[None, ..., 2] * 0.9, lengths_of(found, points)[None]
    share = 1 + (float(found.noise.median()) / 0.0008) ** 2
    assert_close(found.terms(*state)["smoothness"] * share, clear.terms(*state)["smoothness"])
    assert in_noise(Weights(), 0.02) == in_noise(Weights(), 0.1) == replace(Weights(), acceleration=8 * 0.08)
    few = noise * (torch.arange(6) < 2)[:, None]  # a gap that was filled
    assert Objective(SKELETONS["h36m17"], points[..., :2], Weights(), few).weights == clear.weights


@pytest.mark.parametrize("noise", [0.0, 0.004, 0.03])
def test_length_term_by_hand(noise):
    points = walk(6)
    body = replace(SKELETONS["h36m17"], flexible=(3,))
    noises = noise * (1 + normal(6, 17).abs())
    found = Objective(body, points[..., :2], Weights(), noise=noises)
    lengths = 1.03 * lengths_of(found, points)
    depth = points[..., 2] + 0.01 * normal(6, 17, seed=1)
    total = 0.0
    for b, (i, j) in enumerate(found.bones.tolist()):
        seen, explained, left = 0.0, 0.0, 0.0
        for t in range(6):
            flat = (points[t, j, :2] - points[t, i, :2]).square().sum().item()
            size = lengths[b].item() ** 2
            off = (flat + (depth[t, j] - depth[t, i]).item() ** 2 - size) / (2 * lengths[b].item())
            image = min(flat / size, 1) * (noises[t, i] ** 2 + noises[t, j] ** 2).item()
            variance = Weights().length ** 2 + image
            seen += module.HEAVY * math.log(1 + off**2 / variance / module.HEAVY) / 6
            left += module.NOISE * image / variance / 6
        explained = seen if noise == 0 else (seen - left + math.hypot(seen - left, module.CORNER * left)) / 2
        total += 0 if b == 3 else 6 / 2 * math.log(1 + explained)
    assert found.terms(depth[None], lengths[None])["length"].item() == pytest.approx(total, rel=1e-4)


def test_lengths_are_kept_the_less_the_noisier_the_image():
    points = walk(6)
    right = lengths_of(objective(points), points)
    sizes = torch.tensor([1.0, 1.01, 1.02, 1.05, 1.2]).double()[:, None] * right
    values = []
    for noise in (0.0, 0.003, 0.02):
        value = objective(points, noise=noise).terms(points[None, ..., 2].expand(5, -1, -1), sizes)["length"]
        values.append(value - value[0])
        assert (value.diff() > 0).all()
        assert value[0] < 0.02 * 6 * 16 / 2  # right lengths cost next to nothing
    for stiff, soft in itertools.pairwise(values):
        assert (soft[1:] < stiff[1:]).all()


def test_noise_is_left_unexplained():
    """Depths that make every noisy frame's bones as long as the others' gain next to nothing where noise is known."""
    points = walk(60)
    noisy = points + 0.01 * normal(60, 17, 3) * torch.tensor([1.0, 1.0, 0.0])
    gains = []
    for noise in (0.0, 0.01):
        found = objective(noisy, noise=noise)
        lengths = 1.02 * lengths_of(found, points)
        dz = (lengths**2 - found.flat).clamp_min(0).sqrt() * bone_vectors(points, found.bones)[..., 2].sign()
        depths = torch.stack([points[..., 2], dz @ found.tree.mT])
        plain, explained = found.terms(depths, torch.stack([lengths_of(found, points), lengths]))["length"]
        gains.append(float(plain - explained))
    assert gains[0] > 500 and gains[1] < 0.1 * gains[0]


def test_precision():
    """Noise counts by the share of the bone that lies in the image."""
    points = torch.zeros(2, 17, 3).double()
    points[..., 2] = walk(2)[..., 2]  # every bone points at the camera in frame 0
    points[1] = walk(2)[1].flip(-1)
    found = objective(points, noise=0.02)
    usual = found.posture.rest_lengths
    precision = found.precision(usual[None])
    assert precision.shape == (1, 2, 16)
    assert_close(precision[0, 0], torch.full((16,), 1 / Weights().length ** 2).double())
    share = (found.flat[1] / usual**2).clamp_max(1)
    assert_close(precision[0, 1], 1 / (Weights().length ** 2 + share * 2 * 0.02**2))
    assert_close(bone_noise(torch.tensor([[3.0, 4.0]]), torch.tensor([[0, 1]])), torch.tensor([[5.0]]))
    assert_close(objective(points).precision(usual[None]), torch.full((1, 2, 16), 1 / Weights().length ** 2).double())


def test_flexible_bones_may_change_their_length():
    points = walk(6)
    right = bone_lengths(points, SKELETONS["h36m17"].bone_index()).mean(0)
    wrong = right * torch.tensor([2.0] + [1.0] * 15)
    for flexible, free in (((0,), True), ((1,), False)):
        body = replace(SKELETONS["h36m17"], flexible=flexible)
        found = Objective(body, points[..., :2], Weights(), noise=torch.zeros(6, 17).double())
        assert (found.terms(points[None, ..., 2], wrong[None])["length"] < 1e-6) == free


@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize("frames", [1, 2, 3, 8])
def test_gradient(frames, noise):
    points = walk(8)[:frames]
    found = objective(points, noise=noise)
    lengths = lengths_of(found, points)[None]
    depth = points[None, ..., 2]
    assert gradcheck(found, depth + 0.01 * normal(1, frames, 17), 1.02 * lengths, fast=True)
    still = points[:1].expand(frames, -1, -1)
    found = objective(still, noise=noise)
    assert gradcheck(found, still[None, ..., 2], lengths, fast=True)
    flat = still * torch.tensor([1.0, 1.0, 0.0])
    assert gradcheck(objective(flat, noise=noise), flat[None, ..., 2], lengths, fast=True)


def test_contacts_rank_solutions():
    """A walk before a fixed camera: legs whose depths have the wrong sign slide over the ground."""
    clip = walking_person(60, turn=0.0, yaw=20.0)
    points = clip.points / 1000
    points = points - points.mean(1, keepdim=True)
    sure = standing_feet(clip.tracks)
    plain = objective(points)
    found = Objective(plain.skeleton, points[..., :2], Weights(), torch.zeros(60, 17).double(), standing=sure)
    wrong = points.clone()
    for joint in (5, 6):  # one leg
        wrong[:, joint, 2] = 2 * points[:, 4, 2] - points[:, joint, 2]
    depth = torch.stack([points[..., 2], wrong[..., 2] - wrong[..., 2].mean(1, keepdim=True)])
    right, slides = found.contact(depth)
    assert slides > right + 20
    assert_close(found.contact(-depth[:1])[0], right)  # the mirror image walks the other way
    assert not plain.contact(depth).any()
    lengths = lengths_of(found, points).expand(2, -1)
    free, ranked = minimise(plain, depth, lengths, 3), minimise(found, depth, lengths, 3)
    assert_close(ranked.energy - found.contact(ranked.depth), found(ranked.depth, ranked.lengths))
    assert_close(free.depth[free.energy.argmin()], ranked.depth[0])  # contacts do not pull
    shaken = Objective(plain.skeleton, points[..., :2], Weights(), torch.full((60, 17), 0.02).double(), standing=sure)
    assert shaken.contact(depth)[1] < 0.8 * slides


def test_noise_leaves_more_room_to_bones_near_the_image_plane():
    """A leg that swings through the image plane, and a longer one that nods on one side of it, look the same."""
    points = walk(yaw=0.0)
    plain = objective(points)
    lengths = lengths_of(plain, points)
    thigh = plain.skeleton.bone_names.index("left_hip-left_knee")
    dz = points[:, plain.bones[:, 1], 2] - points[:, plain.bones[:, 0], 2]
    nods, longer = dz.clone(), lengths.clone()
    nods[:, thigh] = (dz[:, thigh].square() + 0.1**2).sqrt()
    longer[thigh] = (lengths[thigh].square() + 0.1**2).sqrt()
    both = plain.joints(torch.stack([dz, nods])), torch.stack([lengths, longer])
    assert not plain.volume(*both).any()  # exact images leave none

    def noisy(level):
        return Objective(plain.skeleton, points[..., :2], Weights(), torch.full((40, 17), level).double())

    swings, leans = noisy(0.005).volume(*both)
    assert leans > swings + 2
    assert noisy(1e-5).volume(*both).abs().max() < 1e-2  # and little noise leaves little
    assert_close(noisy(0.005).volume(-both[0], both[1]), torch.stack([swings, leans]))
    found = noisy(0.005)
    ranked = minimise(found, *both, 3)
    assert_close(ranked.energy, found(ranked.depth, ranked.lengths) + found.volume(ranked.depth, ranked.lengths))


def test_frame_rates_count_alike():
    """Twice the frames a second: each tells half as much, so that the terms stay about the same."""
    slow, fast = walk(60), walk(120, fps=60.0)
    values = []
    for points, rate in ((slow, 30.0), (fast, 60.0)):
        found = objective(points, rate=rate, weights=replace(Weights(), length=0.05))
        off = points * torch.tensor([1.0, 1.0, 0.8])  # not the best, or all terms were small
        values.append({k: float(v) for k, v in found.terms(off[None, ..., 2], lengths_of(found, off)[None]).items()})
    for name in ("posture", "hinges", "foreshortening", "proportions"):
        assert values[1][name] == pytest.approx(values[0][name], rel=0.15, abs=0.5), name
    assert at_pace(Weights(), 30.0) == Weights()
    assert at_pace(Weights(), 60.0).acceleration == pytest.approx(Weights().acceleration / 4)
    slow = at_pace(Weights(), 30.0, 3.0)
    assert slow == replace(
        Weights(),
        **{name: 3 * getattr(Weights(), name) for name in ("posture", "foreshortening")},
        **{name: getattr(Weights(), name) / 3 for name in ("hinge", "adduction", "contact")},
    )


# ---------------------------------------------------------------------- noise


@pytest.mark.parametrize("seed", [0, 1])
def test_lengths_do_not_grow_under_noise(seed):
    """Of the true motion in a noisy image; without being told of the noise they do grow."""
    points = walk(60)
    noisy = points + 0.01 * normal(60, 17, 3, seed=seed) * torch.tensor([1.0, 1.0, 0.0])  # 10 mm of 1.75 m
    grown, wrong = [], []
    for noise in (0.01, 0.0):
        found = objective(noisy, noise=noise)
        lengths = lengths_of(found, points)
        z, sizes, *_ = minimise(found, points[None, ..., 2], lengths[None], 60)
        grown.append((sizes[0] / lengths)[lengths > 0.2])  # a hip of 0.13 is hardly larger than its noise
        wrong.append(float((z[0] - points[..., 2]).square().mean().sqrt() / points[..., 2].square().mean().sqrt()))
    assert len(grown[0]) >= 10
    assert (grown[0] - 1).abs().max() < 0.1 and abs(grown[0].mean() - 1) < 0.02
    assert grown[1].max() > 1.08 and grown[1].mean() > 1.03
    assert wrong[0] < 0.35 and wrong[0] < 0.5 * wrong[1]


def test_directions_stray_the_more_the_noisier_and_shorter_bones_are():
    points = walk(30)
    clear, noisy = objective(points), objective(points, noise=0.02)
    assert_close(clear.posture.deviation, PostureEnergy("h36m17").to(points).deviation)
    added = (noisy.posture.deviation.square() - clear.posture.deviation.square()).sqrt()  # (B, 3)
    usual = clear.posture.rest_lengths
    assert_close(added, (BLUR * math.sqrt(2) * 0.02 / usual)[:, None].expand(-1, 3))


# ---------------------------------------------------------------------- pace


def pace(points, rate=30.0):
    return pace_of(points[..., :2], SKELETONS["h36m17"], rate)


def test_slow_motion_counts_less():
    """A walk in slow motion, three times as slow, has about three frames for one."""
    assert pace(walk(60)) == 1
    assert pace(walk(180, fps=90.0)) == pytest.approx(3, rel=0.15)
    assert pace(walk(360, fps=180.0)) == pytest.approx(2 * pace(walk(180, fps=90.0)), rel=0.03)


@pytest.mark.parametrize("fps", [15.0, 60.0, 120.0])
def test_pace_follows_the_frame_rate(fps):
    """A clip tells no more for being filmed with more frames a second."""
    assert pace(walk(int(2 * fps), fps=fps), fps) == pytest.approx(fps / 30)
    slow = walk(180, fps=90.0)  # at 30 frames a second
    more = walk(int(6 * fps), fps=3 * fps)  # the same at fps frames a second
    assert pace(more, fps) == pytest.approx(pace(slow) * fps / 30, rel=0.05)


def test_pace_does_not_depend_on_size_and_place():
    slow = walk(90, fps=120.0)
    assert pace(slow) > 2
    assert pace(200 * slow + 7) == pytest.approx(pace(slow))
    moved = slow + torch.linspace(0, 3, 90)[:, None, None]
    assert pace(moved) == pytest.approx(pace(slow))


def test_pace_of_a_clip_that_does_not_move():
    """The whole of it counts as four frames, however many there are and however quickly; so does a single image."""
    still, four = walk(1).expand(60, -1, -1), 4 * Weights().posture
    for points, rate in ((still, 30.0), (0 * still, 30.0), (still, 600.0), (walk(1), 30.0), (walk(2), 60.0)):
        assert pace(points, rate) == pytest.approx(len(points) / four)
    named = replace(SKELETONS["h36m17"], template=None, proportions=None)
    assert pace_of(still[..., :2], named, 60.0) == 2 and pace_of(still[:12, :, :2], named, 60.0) == 12 / four


def test_pace_of_a_body_that_trembles_about_a_pose():
    """However quickly it does, its frames show one pose, and count as four."""
    pose, lively = walk(120)[:1], walk(120)
    assert pace(lively) == 1
    assert pace(pose + 0.05 * (lively - pose)) == pytest.approx(120 / (4 * Weights().posture))
    assert 2 < pace(pose + 0.25 * (lively - pose)) < 5


def test_images_of_any_size_compare():
    """Foreshortening is the logarithm of a density in the image, which falls with its area."""
    points = walking_person(20).points[:, :17] / 1000
    plain, large = objective(points), objective(2 * points)
    costs = []
    for found, size in ((plain, 1.0), (large, 2.0)):
        terms = found.terms(size * points[None, ..., 2], size * lengths_of(found, points)[None])
        costs.append(terms["foreshortening"][0] + found.drawn(points.new_full((20,), 1 / size)))
    assert_close(costs[0], costs[1], rtol=1e-4, atol=0)
    assert costs[0] != 0 == plain.drawn(points.new_ones(20))


def test_joints_never_seen_are_no_evidence():
    clip = walking_person(20)
    body = clip.skeleton
    knee, ankle = body.index("left_knee"), body.index("left_ankle")
    noise = torch.zeros(20, body.num_joints).double()
    noise[:, ankle] = 0.1
    image = clip.points[..., :2] / 1000
    plain, found = (Objective(body, image, Weights(), each) for each in (0 * noise, noise))
    shank = body.bones.index((knee, ankle))
    assert not plain.hinges.firm.eq(0).any()
    lost = [bool(shank in pair) for pair in found.hinges.limbs.tolist()]
    assert found.hinges.firm.eq(0).tolist() == lost and any(lost)
    assert found.clear[:, shank].max() < 0.01 and (plain.clear == 1).all()
    seen = noise.clone()
    seen[5, ankle] = 0
    assert torch.equal(Objective(body, image, Weights(), seen).hinges.firm, plain.hinges.firm)
    assert torch.equal(Objective(body, image, Weights(), noise.clamp_min(0.05)).hinges.firm, plain.hinges.firm)
