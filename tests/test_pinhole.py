"""The energy of a body seen along rays: by hand, its slope, and lengths that another part of the clip told."""

import math

import pytest
import torch
from numerics import CHAIN, normal
from torch.testing import assert_close

from kcs_torch.data import walking_person
from kcs_torch.functional import bone_lengths, bone_vectors
from kcs_torch.methods.perspective import pinhole, plain_body
from kcs_torch.methods.perspective.pinhole import PinholeEnergy
from kcs_torch.methods.perspective.pinhole_coordinates import FIRM, USUAL
from kcs_torch.methods.pkc.objective import Objective
from kcs_torch.methods.pkc.weights import Weights, at_pace, pace_of
from kcs_torch.solvers.lbfgs import lbfgs


def walk(frames=12, skeleton="h36m17"):
    """Rays, true depths, true distances and lengths of a walk two metres and a half away, in metres."""
    clip = walking_person(frames, skeleton=skeleton, turn=0.0, yaw=60.0)
    points = clip.points / 1000
    points = points - points.mean((0, 1)) + points.new_tensor([0.0, 0.0, 2.5])
    far = points[..., 2].mean(1)
    lengths = bone_lengths(points, clip.skeleton.bones).median(0).values
    return clip.skeleton, points[..., :2] / points[..., 2:], points[..., 2] - far[:, None], far, lengths


def level(rays, value=0.0):
    return torch.full_like(rays[..., 0], value)


@pytest.mark.parametrize("known", [False, True], ids=["free", "known lengths"])
@pytest.mark.parametrize("skeleton", ["h36m17", "coco17"])
def test_the_start_is_what_was_given(skeleton, known):
    skeleton, rays, depth, far, lengths = walk(skeleton=skeleton)
    energy = PinholeEnergy(skeleton, rays, far, depth[None], 30.0, level(rays), lengths[None] if known else None)
    body = energy.unpack(energy.start)
    assert_close(body.depth, depth[None])
    assert_close(body.lengths, lengths[None])
    assert_close(body.distance, far[None])


def test_energy_of_a_chain_by_hand():
    """Without a trunk: lengths, smoothness, the path and the method's depths."""
    frames, rate = 5, 25.0
    rays, depth = 0.1 * normal(frames, 4, 2), 0.1 * normal(1, frames, 4, seed=1)
    far = 2 + 0.1 * normal(frames, seed=3)
    energy = PinholeEnergy(CHAIN, rays, far, depth, rate, level(rays, 0.01))
    z, lengths, path, _ = (x[0] for x in energy.unpack(energy.start + normal(*energy.start.shape, seed=4)))
    assert not torch.allclose(z, depth[0]) and not torch.allclose(path, far)
    assert_close(z.mean(-1), depth[0].mean(-1))  # the rest is the distance
    points = torch.cat([rays * (path[:, None] + z)[..., None], z[..., None]], -1)
    slack, slow = math.hypot(0.003, 0.01), 30 / rate
    total = (path / far).log().square().mean() / (2 * pinhole.STRAY**2)
    total += (path.diff() * rate / pinhole.SPEED).square().sum() / (2 * pinhole.INDEPENDENT / slow)
    total += (path.diff(n=2) / (pinhole.ROOT * slow**2)).square().sum() / 2
    for b, (i, j) in enumerate(CHAIN.bones):
        off = ((points[:, j] - points[:, i]).square().sum(-1) - lengths[b] ** 2) / (2 * lengths[b])
        total += frames / 2 * torch.log1p((4 * torch.log1p(off**2 / (4 * slack**2))).mean())
        dz = z[:, j] - z[:, i]
        total += (dz[2:] - 2 * dz[1:-1] + dz[:-2]).square().sum() / (2 * (plain_body.ACCELERATION * slow**2) ** 2)
        total += (dz - depth[0, :, j] + depth[0, :, i]).square().sum() / (2 * plain_body.CLOSE**2)
    state = energy.start + normal(*energy.start.shape, seed=4)
    assert_close(energy(state)[0], total[None])


def test_energy_of_a_person_is_that_of_pkc_for_the_straightened_image():
    """And that of standing feet which move along their rays, and of the path."""
    skeleton, rays, depth, far, _ = walk(20)
    standing = normal(20, len(skeleton.contacts)).abs().clamp_max(1)
    energy = PinholeEnergy(skeleton, rays, far, depth[None], 30.0, level(rays, 0.01), standing=standing)
    state = energy.start + normal(*energy.start.shape)
    z, lengths, path, _ = energy.unpack(state)
    image = (rays * (path[..., None] + z)[..., None])[0]
    weights = at_pace(Weights(), 30.0, pace_of(rays * (far[:, None] + depth)[..., None], skeleton, 30.0))
    alike = Objective(skeleton, image, weights, level(rays, 0.01))
    same = energy.model.precision(lengths) / alike.precision(lengths)
    assert 0.5 < float(same.min()) <= float(same.max()) < 2  # noise counts as in the image of the start
    terms = energy.model.terms(z, lengths, image[None])
    own = alike.terms(z, lengths)
    for name in ("smoothness", "posture", "hinges", "adduction", "proportions"):
        assert_close(terms[name], own[name])
    assert terms.keys() == own.keys()
    along = (path[..., None] + z)[0] * (1 + rays.square().sum(-1)).sqrt()
    feet = along[:, list(skeleton.contacts)].diff(dim=0) / energy.model.feet.slip
    both = torch.minimum(standing[1:], standing[:-1])
    slip = weights.contact / 2 * (both * feet.square().log1p()).sum()
    rest = (path / far).log().square().mean() / (2 * pinhole.STRAY**2)
    rest += (path.diff() * 30 / pinhole.SPEED).square().sum() / (2 * pinhole.INDEPENDENT)
    rest += (path.diff(n=2) / pinhole.ROOT).square().sum() / 2
    bones = bone_vectors(torch.cat([image, (path[..., None] + z)[0][..., None]], -1), skeleton.bone_index())
    ends = skeleton.bone_index()[:, 1]
    deep = bones[..., 2] + (rays[:, ends] * bones[..., :2]).sum(-1)  # along the rays of their outer ends
    terms["foreshortening"] = alike.foreshortening.each(deep[None], lengths, energy.model.clear, alike.noise).sum()
    far_off = (path[..., None] + z)[0][:, ends] * energy.size
    near = 2 * (alike.independent * far_off.log()).sum()  # an image at half the distance is four times as likely
    assert_close(energy(state)[0], (sum(terms.values()) + slip + rest - near).reshape(1))


def test_images_say_nothing_for_a_small_body_near_by():
    """What foreshortening costs is the same for a body of any size whose image is the same."""
    skeleton, rays, depth, far, lengths = walk(20)
    costs = []
    for size in (1.0, 0.5):
        z, path, own = size * depth[None], size * far[None], size * lengths[None]
        energy = PinholeEnergy(skeleton, rays, path[0], z, 30.0, level(rays))  # wherever the search starts
        near = (path[..., None] + z).mT
        bones = bone_vectors(depth[None, ..., None], skeleton.bone_index())[..., 0] * size
        costs.append(energy.model.foreshortening.each(bones, own, energy.model.clear).sum((1, 2)))
        costs[-1] -= energy._nearness(near, torch.zeros_like(near))
    assert_close(costs[0], costs[1])


@pytest.mark.parametrize("wide", [1.0, 0.4])
def test_images_are_as_likely_as_directions_drawn_evenly_make_them(wide):
    """The density of a bone's image is one over its area, that of a piece of the sphere of its directions."""
    skeleton, rays, depth, far, _ = walk(6)
    lens = torch.tensor([1 / wide]).double(), torch.tensor([True])
    energy = PinholeEnergy(skeleton, rays, far, depth[None], 30.0, level(rays), focal=lens)
    energy.model.foreshortening.eps, bones = 0.0, skeleton.bone_index()
    laid = energy._laid(energy.start + 0.1 * normal(*energy.start.shape))
    wide = laid.wide[0]
    near = energy._nearness(laid.far, torch.zeros_like(laid.far)) - 2 * (energy.share * energy.size.log()).sum()
    deep = laid.own + (energy.toward * wide * laid.image).sum(1)
    found = energy.model.foreshortening.each(deep.mT, laid.lengths, energy.model.clear).sum() - near
    ahead = laid.path[0] / wide + laid.depth[0]  # (N, T) along the optical axis
    points = torch.cat([energy.rays * laid.far[0], ahead[None]]).permute(2, 1, 0)  # (T, N, 3)
    expected = torch.zeros(1).double()
    for b, (start, end) in enumerate(bones.tolist()):
        for t, joints in enumerate(points):
            bone = joints[end] - joints[start]
            across = torch.linalg.qr(torch.cat([bone[:, None], torch.eye(3, 2).double()], 1)).Q[:, 1:] * bone.norm()

            def seen(turn, joints=joints, start=start, bone=bone, across=across):
                """Where the bone's end is seen by the given camera after a small turn (2,) of the bone."""
                there = torch.nn.functional.normalize(bone + across @ turn, dim=0) * bone.norm() + joints[start]
                return there[:2] / there[2] / wide

            area = torch.autograd.functional.jacobian(seen, torch.zeros(2).double()).det().abs()
            expected += energy.share[b, t] * (area * laid.lengths[0, b] / bone.norm()).log()
    assert_close(found, expected, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("focal", [False, True, 1.4], ids=["calibrated", "any focal length", "a usual focal length"])
@pytest.mark.parametrize("known", [False, True], ids=["free", "known lengths"])
@pytest.mark.parametrize("frames", [1, 2, 6])
@pytest.mark.parametrize("skeleton", ["h36m17", "coco17", CHAIN])
def test_slope(skeleton, frames, known, focal):
    """Against differences of the energy."""
    if skeleton is CHAIN:
        rays, depth, far = 0.1 * normal(frames, 4, 2), 0.1 * normal(frames, 4, seed=1), 2 + 0.1 * normal(frames)
        lengths, feet = torch.ones(3), None
    else:
        skeleton, rays, depth, far, lengths = walk(frames, skeleton)
        feet = torch.full((frames, len(skeleton.contacts)), 0.7).double()
    given = lengths.double().expand(2, -1) if known else None
    start = torch.stack([depth, -depth])
    lens = (torch.tensor([1.0, 3.0]).double(), torch.tensor([True, True])) if focal else None
    usual = focal if isinstance(focal, float) else None
    energy = PinholeEnergy(skeleton, rays, far, start, 30.0, level(rays), given, feet, lens, usual)
    state = energy.start + 0.1 * normal(*energy.start.shape)
    value, slope = energy(state)
    for seed in range(5):
        along = 1e-4 * normal(*state.shape, seed=10 + seed)
        fall = (energy(state + along)[0] - energy(state - along)[0]) / 2
        assert_close((slope * along).sum(-1), fall, rtol=1e-5, atol=1e-6 * float(value.abs().amax()))
    for some in ([1], [1, 0]):
        part = torch.tensor(some)
        for one, other in zip(energy.rows(part)(state[part]), (value, slope), strict=True):
            assert_close(one, other[part])


def test_a_distance_that_steps_where_a_film_was_cut_costs_nothing():
    rays, depth = 0.1 * normal(11, 4, 2), 0.1 * normal(2, 11, 4, seed=1)
    far = torch.cat([torch.full((5,), 2.0), torch.full((6,), 3.0)]).double()
    whole, shots = (PinholeEnergy(CHAIN, rays, far, depth, 30.0, level(rays), cuts=cuts) for cuts in ((), (5,)))
    step = (30.0 / pinhole.SPEED) ** 2 / (2 * pinhole.INDEPENDENT) + 1 / pinhole.ROOT**2  # and two second differences
    assert_close(whole(whole.start)[0] - shots(shots.start)[0], torch.full((2,), step).double())
    lens = torch.ones(2).double(), torch.ones(2, dtype=torch.bool)
    shots = PinholeEnergy(CHAIN, rays, far, depth, 30.0, level(rays), focal=lens, cuts=(5,))
    state = shots.start + 0.1 * normal(*shots.start.shape)
    along = 1e-4 * normal(*state.shape, seed=1)
    fall = (shots(state + along)[0] - shots(state - along)[0]) / 2
    assert_close((shots(state)[1] * along).sum(-1), fall, rtol=1e-5, atol=1e-6 * float(shots(state)[0].amax()))
    assert bool((shots.waves[:5].any(0) != shots.waves[5:].any(0)).all())  # each moves one shot alone


def test_unknowns_are_nearly_a_sphere():
    """Steps of one unit change the energy by about as much, whatever they move: few steps of a descent are enough."""
    skeleton, rays, depth, far, _ = walk(30)
    standing = torch.zeros(30, len(skeleton.contacts)).double()
    standing[5:15, 0] = standing[15:25, 1] = 1.0
    lens = torch.ones(1).double(), torch.ones(1, dtype=torch.bool)
    energy = PinholeEnergy(skeleton, rays, far, depth[None], 30.0, level(rays), standing=standing, focal=lens)
    parts = torch.arange(len(energy.start[0])).split(energy.sizes)
    curves = []
    for part in parts:
        some = torch.zeros(20, len(energy.start[0])).double()
        at = part[torch.randint(len(part), (20,), generator=torch.Generator().manual_seed(0))]
        some[torch.arange(20), at] = 1e-3
        value = torch.cat([energy(x[None])[0] + energy(-x[None])[0] for x in some]) - 2 * energy(energy.start)[0]
        curves.append((value / 1e-6).median())
    assert all(0.05 < float(curve) < 20 for curve in curves), curves


def test_known_lengths_tell_the_distance():
    """A distance that is wrong by a half comes back, depths with it."""
    skeleton, rays, depth, far, lengths = walk(40)
    wrong = 1.5
    given = wrong * far, wrong * depth[None], 30.0, level(rays, 0.002), lengths[None]
    energy = PinholeEnergy(skeleton, rays, *given)
    assert_close(energy.unpack(energy.start).distance, far[None], rtol=0.02, atol=0)
    found = energy.unpack(lbfgs(energy, energy.start, num_steps=60, slopes=True).value)
    assert torch.equal(found.lengths, lengths[None])
    assert_close(found.distance, far[None], rtol=0.05, atol=0)
    assert float((found.depth[0] - depth).square().mean().sqrt()) < 0.03


def test_lengths_count_once_where_they_are_known():
    """What is the same in all blocks of a clip is no reason to prefer a solution in each of them."""
    skeleton, rays, depth, far, lengths = walk()
    free, held = (
        PinholeEnergy(skeleton, rays, far, depth[None], 30.0, level(rays, 0.01), x) for x in (None, lengths[None])
    )
    assert_close(free(free.start)[0] - held(held.start)[0], free.model.proportions(lengths[None]))


def test_standing_feet_cost_what_they_slide():
    """A person who stands still on the spot: only the feet tell that the distance does not change."""
    skeleton, rays, depth, far, _ = walk(30)
    rays, depth, far = rays[:1].expand(30, -1, -1), depth[:1].expand(1, 30, -1), far[:1].expand(30)
    sure = torch.ones(30, len(skeleton.contacts)).double()
    rests, moves = far, far * torch.linspace(1, 1.3, 30, dtype=torch.float64)
    costs = []
    for path in (rests, moves):
        plain, stood = (
            PinholeEnergy(skeleton, rays, path, depth, 30.0, level(rays), standing=feet) for feet in (None, sure)
        )
        costs.append(float(stood(stood.start)[0] - plain(plain.start)[0]))
    assert abs(costs[0]) < 1e-9 and costs[1] > 20


def test_usual_lenses_cost_least():
    """A focal length costs what makes the distance unusual, and what it is off by from that of usual lenses.

    Where these are known, it costs little to be far away.
    """
    skeleton, rays, depth, far, _ = walk()
    focal = torch.tensor([1.0, 2.0, 2.0]).double()
    given = skeleton, rays, far, depth.expand(3, -1, -1), 30.0, level(rays), None, None

    def cost(usual):
        found = PinholeEnergy(*given, (focal, focal > 0), usual)
        free = PinholeEnergy(*given, (focal, focal < 0), usual)
        return found(found.start)[0] - free(free.start)[0]

    off = (focal / 2.0).log().square() / 2 * FIRM
    away = (far.mean() * focal / USUAL).log().square() / 2 * FIRM
    assert_close(cost(None), away)
    far_away = far.mean() * focal > USUAL
    assert far_away.tolist() == [False, True, True]
    easy = (math.log(1.5) / math.log(3.0)) ** 2
    assert_close(cost(2.0), torch.where(far_away, easy * away, away) + off)
