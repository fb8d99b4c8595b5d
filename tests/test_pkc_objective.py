"""The objective of hypotheses: its terms by hand, its gradient, its unknowns, and that the true motion is best."""

import itertools
import math
from dataclasses import replace

import pytest
import torch
from numerics import gradcheck, normal
from torch.testing import assert_close

from kcs_torch.data import walking_person
from kcs_torch.functional import bone_lengths, bone_vectors
from kcs_torch.methods.answer.root import standing_feet
from kcs_torch.methods.clips.lockstep import run, together
from kcs_torch.methods.pkc import objective as module
from kcs_torch.methods.pkc import refinement
from kcs_torch.methods.pkc.objective import BLUR, Objective, bone_noise
from kcs_torch.methods.pkc.refinement import Task, minimise, minimise_all
from kcs_torch.methods.pkc.unknowns import Unknowns
from kcs_torch.methods.pkc.weights import Weights, at_pace, in_noise, pace_of
from kcs_torch.nn import PostureEnergy
from kcs_torch.skeleton import SKELETONS
from kcs_torch.solvers import lbfgs


def walk(frames=40, skeleton="h36m17", fps=30.0, **options):
    """A walk before a fixed camera, centred, a person of about 1.75 (rms distance 0.5): (T, N, 3)."""
    points = walking_person(frames, skeleton=skeleton, fps=fps, **{"turn": 0.0, "yaw": 40.0, **options}).points
    points = points - points.mean(1, keepdim=True)
    return points / points.square().sum(-1).mean().sqrt() * 0.5


def objective(points, skeleton="h36m17", rate=30.0, **options):
    weights = at_pace(options.pop("weights", Weights()), rate, rate / 30)
    noise = torch.as_tensor(options.pop("noise", 0.0)).double().expand_as(points[..., 0])
    return Objective(SKELETONS[skeleton], points[..., :2], weights, noise=noise, **options)


def lengths_of(found, points):
    return bone_lengths(points, found.bones).mean(-2)


def energy_of(found, points, lengths=None):
    return found(points[None, ..., 2], (lengths_of(found, points) if lengths is None else lengths)[None])


def of_length(found, points, factor):
    """A walk whose bones are longer, in the same image: depths (1, T, N) and lengths (1, B)."""
    lengths = factor * lengths_of(found, points)
    dz = (lengths**2 - found.flat).clamp_min(0).sqrt() * bone_vectors(points, found.bones)[..., 2].sign()
    depth = dz @ found.tree.mT
    return (depth - depth.mean(-1, keepdim=True))[None], lengths[None]


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


# ---------------------------------------------------------------------- unknowns


@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize("skeleton", ["h36m17", "coco17", "mediapipe33"])
def test_unknowns_start_where_they_are_told_to(skeleton, noise):
    points = walk(5, skeleton)
    found = objective(points, skeleton, noise=noise)
    depth = torch.stack([points[..., 2], -0.5 * points[..., 2]])
    lengths = lengths_of(found, points) * torch.tensor([[1.0], [1.1]])
    unknowns = Unknowns(found, depth, lengths)
    bones = found.skeleton.num_bones
    assert unknowns.scale.shape == (2, 6 * bones) and (unknowns.scale > 0).all()
    again, same = unknowns(torch.zeros(2, 6 * bones).double())
    assert_close(again, depth, rtol=0, atol=1e-12)
    assert torch.equal(same, lengths)


@pytest.mark.parametrize("skeleton", ["h36m17", "coco17", "mediapipe33"])
def test_unknowns_give_bodies_wherever_they_are(skeleton):
    """Centred, with virtual joints at their sources and lengths above 0."""
    points = walk(5, skeleton)
    found = objective(points, skeleton)
    body = SKELETONS[skeleton]
    unknowns = Unknowns(found, points[None, ..., 2], lengths_of(found, points)[None])
    depth, lengths = unknowns(30 * normal(1, 6 * body.num_bones))
    assert (depth - points[..., 2]).abs().max() > 0.1
    assert depth.mean(-1).abs().max() < 1e-12 and (lengths > 0).all()
    seen = torch.cat([normal(5, body.num_observed, 2), depth[0, :, : body.num_observed, None]], -1)
    assert_close(body.complete(seen)[0][..., 2], depth[0])


def test_a_length_takes_its_bone_s_depths_along():
    """Where a bone points at the camera, four fifths of what it grows by."""
    points = walk(5)
    found = objective(points)
    lengths = lengths_of(found, points)[None]
    unknowns = Unknowns(found, points[None, ..., 2], lengths)
    state = torch.zeros(1, 6 * 16).double()
    state[:, -16:] = 1e-4 / unknowns.scale[:, -16:]
    depth, grown = unknowns(state)
    misfit = lambda z, size: found.flat + bone_vectors(z[0, ..., None], found.bones)[..., 0] ** 2 - size**2  # noqa: E731
    alone = misfit(points[None, ..., 2], grown) - misfit(points[None, ..., 2], lengths)
    along = misfit(depth, grown) - misfit(points[None, ..., 2], lengths)
    share = (bone_vectors(points, found.bones)[..., 2] / lengths) ** 2
    assert_close(along / alone, 0.25 / (share + 0.25), rtol=0, atol=1e-3)
    assert share.max() > 0.5


@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize("frames", [1, 2, 5])
def test_gradient_over_unknowns(frames, noise):
    points = walk(5)[:frames]
    found = objective(points, noise=noise)
    unknowns = Unknowns(found, *of_length(found, points, 1.05))
    start = torch.zeros_like(unknowns.scale)
    for state in (start, 2 * normal(*start.shape)):
        assert gradcheck(lambda s: found(*unknowns(s)), state, fast=True)


@pytest.mark.parametrize("noise", [0.0, 0.003, 0.01])
def test_unknowns_make_the_objective_round(noise):
    """The Hessian's condition at a minimum, without the shifts of whole frames, which cost nothing."""
    points = walk(9, yaw=20.0)
    found = objective(points, noise=noise)
    z, sizes, *_ = minimise(found, points[None, ..., 2], lengths_of(found, points)[None], 100)
    unknowns = Unknowns(found, z, sizes)
    plain = torch.cat([z.flatten(), sizes.flatten().log()])
    curves = []
    for energy, state in (
        (lambda s: found(*unknowns(s[None]))[0], torch.zeros(10 * 16).double()),
        (lambda s: found(s[: 9 * 17].view(1, 9, 17), s[None, 9 * 17 :].exp())[0], plain),
    ):
        hessian = torch.autograd.functional.hessian(energy, state)
        curves.append(torch.linalg.eigvalsh(hessian)[-10 * 16 :])
    white, plain = (float(curve[-1] / curve[0]) for curve in curves)
    assert 1 < white < 0.2 * plain
    assert 0.05 < curves[0].median() < 10 and curves[0][-1] < 10


@pytest.mark.parametrize("factor", [1.03, 1.1])
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_few_steps_do(noise, factor):
    """Twenty steps lead further than forty on depths and lengths themselves."""
    points = walk()
    found = objective(points, noise=noise)
    depth, lengths = of_length(found, points, factor)

    def plain(state):
        z, sizes = state.split([40 * 17, 16], 1)
        z = z.unflatten(1, (40, 17))
        return found(z - z.mean(-1, keepdim=True), sizes.exp())

    start = torch.cat([depth.flatten(1), lengths.log()], 1)
    far = plain(lbfgs(plain, start, num_steps=40, tolerance=1e-9).value)
    energy = minimise(found, depth, lengths, 20)[2]
    assert energy < far < found(depth, lengths)


def test_loose_lengths_first():
    """As if lengths were known less; the objective itself is left as it is."""
    points = walk(20)
    found = objective(points)
    start = of_length(found, points, 1.1)
    loose = objective(points, weights=replace(Weights(), length=7 * Weights().length))
    for one, other in zip(minimise(found, *start, 8, 7.0)[:3], minimise(loose, *start, 8)[:3], strict=True):
        assert_close(one, other)
    assert found.weights == objective(points).weights


def test_where_nothing_is_seen_it_stays_finite():
    for points in (torch.zeros(4, 17, 3).double(), walk(4) * torch.tensor([0.0, 1.0, 1.0])):
        found = objective(points)
        depth, lengths, energy, *_ = minimise(found, 0 * points[None, ..., 2], found.posture.rest_lengths[None], 5)
        assert all(torch.isfinite(x).all() for x in (depth, lengths, energy))


@pytest.mark.parametrize("yaw", [0.0, 45.0, 90.0, 200.0])
def test_the_true_motion_is_best(yaw):
    """Better than its mirror image, than flat, than each limb flipped, than other lengths, than a wooden walk."""
    points = walk(yaw=yaw)
    found = objective(points)
    depth, lengths = points[..., 2], bone_lengths(points, found.bones).mean(0)
    dz = depth[:, found.bones[:, 1]] - depth[:, found.bones[:, 0]]
    others = [depth.mean(0, keepdim=True).expand_as(depth)]
    for name in ("left_knee-left_ankle", "right_hip-right_knee", "left_elbow-left_wrist"):
        flipped = dz.clone()
        flipped[:, found.skeleton.bone_names.index(name)] *= -1
        other = flipped @ found.tree.mT
        if (other - other.mean(-1, keepdim=True) - depth).abs().max() > 0.1:  # else the bone lies in the image plane
            others.append(other - other.mean(-1, keepdim=True))
    with torch.no_grad():
        true = found(depth[None], lengths[None])
        for other in others:
            assert found(other[None], lengths[None]) > true
        for other in (-depth, 0 * depth):
            assert found(other[None], lengths[None]) > true + 100
        assert found(depth[None], 1.1 * lengths[None]) > true + 5


def test_minimise_lowers_sorts_and_keeps_good_starts():
    points = walk()
    found = objective(points)
    lengths = bone_lengths(points, found.bones).mean(0)
    depth = torch.stack([-points[..., 2], points[..., 2] + 0.02 * normal(40, 17)])
    before = found(depth, lengths.expand(2, -1))
    z, sizes, energy, _, steps = minimise(found, depth, lengths.expand(2, -1), 25)
    assert (energy.diff() >= 0).all() and (energy < before.flip(0)).all()
    assert_close(energy, found(z, sizes))
    assert steps >= 1
    assert (z[0] - points[..., 2]).square().mean().sqrt() < 0.05
    alone = minimise(found, depth[1:], lengths[None], 25)
    assert_close(alone[2][0], energy[0], rtol=1e-3, atol=0)


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


def several():
    """Tasks of three clips that differ in length, frame rate, noise and anchor."""
    tasks = []
    for i, (frames, rate, noise, anchored) in enumerate(
        ((20, 30.0, 0.0, False), (33, 60.0, 0.01, True), (26, 20.0, 0.0, False))
    ):
        points = walk(frames, fps=rate)
        usual = bone_lengths(points, objective(points).bones).mean(0)
        found = objective(points, rate=rate, noise=noise, anchor=usual if anchored else None)
        depth = points[..., 2] + 0.05 * normal(2 + i, frames, 17, seed=i)
        tasks.append(Task(found, depth - depth.mean(-1, keepdim=True), usual.expand(2 + i, -1), 3))
    return tasks


def test_clips_together_have_the_energies_of_each():
    tasks = several()
    counts = [len(task.depth) for task in tasks]
    joined = Objective.joined([task.objective for task in tasks], counts)
    pad = lambda z: torch.nn.functional.pad(z, (0, 0, 0, 33 - z.shape[1]), value=0.7)  # noqa: E731
    depth, lengths = torch.cat([pad(task.depth) for task in tasks]), torch.cat([task.lengths for task in tasks])
    assert joined.standing is None
    together = joined.terms(depth, lengths)
    for task, *rows in zip(tasks, *(term.split(counts) for term in together.values()), strict=True):
        alone = task.objective.terms(task.depth, task.lengths)
        for name, row in zip(together, rows, strict=True):
            assert_close(row, alone.get(name, torch.zeros_like(row)), rtol=1e-8, atol=1e-6)


def test_clips_are_refined_together_as_alone():
    tasks = several()
    for task, found in zip(tasks, minimise_all(tasks), strict=True):
        alone = minimise(task.objective, task.depth, task.lengths, task.num_steps, task.loose)
        assert_close(found.energy, alone.energy, rtol=1e-6, atol=1e-6)
        assert_close(found.depth, alone.depth, rtol=0, atol=1e-5)
        assert_close(found.moved, alone.moved, rtol=1e-3, atol=1e-6)


def test_runs_are_not_too_large(monkeypatch):
    tasks = several()
    monkeypatch.setattr(refinement, "TOGETHER", 100)
    runs = refinement._runs(list(range(3)), tasks)
    assert sorted(i for run in runs for i in run) == [0, 1, 2] and len(runs) == 3


def test_hypotheses_of_long_clips_are_refined_a_few_at_a_time(monkeypatch):
    task = several()[-1]
    whole = minimise(task.objective, task.depth, task.lengths, 12)
    sizes = []
    refine = refinement._refined
    monkeypatch.setattr(refinement, "_refined", lambda goal, z, *rest: sizes.append(len(z)) or refine(goal, z, *rest))
    monkeypatch.setattr(refinement, "MOST", 2 * task.depth.shape[1])
    found = minimise(task.objective, task.depth, task.lengths, 12)
    assert max(sizes) <= 2 and sum(sizes) == len(task.depth)
    assert_close(found.energy, whole.energy, rtol=1e-6, atol=1e-6)
    assert_close(found.depth, whole.depth, rtol=0, atol=1e-5)


def test_searches_in_lockstep():
    """Each search gets the answers to its own tasks, however many it asks for and however long it goes on."""

    def search(task, rounds):
        energies = []
        for k in range(rounds):
            answers = yield [replace(task, num_steps=1 + k)] * (1 + k % 2)
            assert len(answers) == 1 + k % 2
            energies.append(float(answers[0].energy[0]))
        return energies

    tasks = several()
    searches = [search(task, rounds) for task, rounds in zip(tasks, (2, 0, 3), strict=True)]
    found = run(together(searches), minimise_all)
    for task, rounds, energies in zip(tasks, (2, 0, 3), found, strict=True):
        assert_close(energies, run(search(task, rounds), minimise_all), rtol=1e-6, atol=1e-6)
    assert run(together([]), minimise_all) == []


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
