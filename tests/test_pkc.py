"""PKC end to end: walks before fixed and turning cameras, what is told of them, and clips that tell little."""

import math
import warnings
from dataclasses import asdict, replace

import pytest
import torch
from numerics import count_operations, normal
from torch.testing import assert_close

from kcs_torch import PKC, SKELETONS, ConvergenceWarning, KcsWarning, OptionError, SfAM, Skeleton, Tracks, reconstruct
from kcs_torch.clean import detector, resample, smooth
from kcs_torch.data import random_motion, walking_person
from kcs_torch.functional import (
    bone_lengths,
    bone_vectors,
    chain_inverse,
    complete_rotation,
    incidence,
    points_from_bones,
)
from kcs_torch.methods.answer.root import standing_feet
from kcs_torch.methods.clips.lockstep import run
from kcs_torch.methods.clips.size import Size
from kcs_torch.methods.pkc import batch
from kcs_torch.methods.pkc import body as body_module
from kcs_torch.methods.pkc import method as module
from kcs_torch.methods.pkc.batch import Noisy, clean_all, serve
from kcs_torch.methods.pkc.body import Body
from kcs_torch.methods.pkc.cleaning import cleaned
from kcs_torch.methods.pkc.descents import Descent
from kcs_torch.methods.pkc.gaps import gaps_of, usual_noise
from kcs_torch.methods.pkc.hypotheses import Hypotheses
from kcs_torch.metrics import e3d

# Many tests take few steps, after which nothing has settled.
pytestmark = pytest.mark.filterwarnings("ignore::kcs_torch.ConvergenceWarning")

NAN = math.nan
FLIP = torch.tensor([1.0, 1.0, -1.0]).double()
QUICK = {"viewpoint": "fixed", "rounds": 0, "steps": 5}


def centred(points):
    return points - points.mean(1, keepdim=True)


def error(points, truth):
    """Mean distance to the truth, over that of a flat guess."""
    flat = centred(truth)[..., 2].abs().mean()
    return float((centred(points) - centred(truth)).norm(dim=-1).mean() / flat)


@pytest.fixture(scope="module")
def still():
    """A walk before a camera that stands still, and its reconstruction by the default settings."""
    clip = walking_person(40, turn=0.0, yaw=40.0)
    return clip, PKC()(clip.tracks)


@pytest.fixture(scope="module")
def turning():
    """The same before a camera that goes half around."""
    clip = walking_person(50, turn=180.0, yaw=0.0)
    return clip, PKC()(clip.tracks)


# ---------------------------------------------------------------------- walks


def test_fixed_camera(still):
    clip, result = still
    assert error(result.points, clip.points) < 0.15
    assert error(result.points * FLIP, clip.points) > 1  # and the right one of the mirror images
    assert result.diagnostics.bone_variation < 2
    assert any("rests on the template and lengths" in note for note in result.diagnostics.notes)


def test_turning_camera(turning):
    clip, result = turning
    assert error(result.points, clip.points) < 0.1
    assert result.diagnostics.viewpoint_turn > 120
    assert not any("template" in note for note in result.diagnostics.notes)


def test_short_clips_and_single_images_of_other_bodies():
    """Bodies whose proportions are not the template's do not lean so that all their bones look shorter."""
    clip = walking_person(40, turn=0.0, yaw=20.0)
    body, noise = clip.skeleton, 4.0 * normal(40, 17, 2, seed=5)
    chain = chain_inverse(incidence(body.bones, 17, dtype=torch.float64))
    wrong, covered = [], []
    for seed in (1, 2, 3):
        factors = 1 + 0.12 * (2 * torch.rand(body.num_bones, 1, generator=torch.Generator().manual_seed(seed)) - 1)
        for a, b in body.mirror_bones:
            factors[b] = factors[a]
        points = centred(points_from_bones(bone_vectors(clip.points, body.bone_index()) * factors, chain))
        for start, count in ((5, 1), (20, 4), (26, 10)):
            some = slice(start, start + count)
            image = (points[..., :2] + noise)[some]
            found = PKC()(Tracks.from_arrays(image, skeleton=body, fps=30.0, units="mm"))
            depth, truth = centred(found.points)[..., 2], points[some, :, 2]
            off = min(depth - truth, depth + truth, key=lambda x: float(x.square().mean()))
            wrong.append(off.square().mean().sqrt() / truth.square().mean().sqrt())
            covered.append((off.abs() < found.uncertainty).double().mean())
    assert torch.stack(wrong).mean() < 0.5  # of what guessing a flat body is wrong by
    assert torch.stack(covered).mean() > 0.42


@pytest.mark.parametrize("frames", [3, 5, 8, 11])
def test_a_few_frames_from_several_sides(frames):
    """They tell depth of a body of which nothing is known; a template is believed until the viewpoint turns far."""
    clip = random_motion("cmu17", frames, turn=150.0, fps=100.0, generator=torch.Generator().manual_seed(1))
    plain = Skeleton(tuple(f"point {i}" for i in range(17)), clip.skeleton.bones)
    flat = torch.cat([clip.points[..., :2], torch.zeros_like(clip.points[..., 2:])], -1)
    for body in (plain, clip.skeleton):
        found = PKC()(replace(clip.tracks, skeleton=body))
        wrong = min(float(e3d(found.points * sign, clip.points)) for sign in (1.0, FLIP))
        assert wrong < 0.06 < 0.3 < float(e3d(flat, clip.points))
        assert found.uncertainty.isfinite().all()


@pytest.mark.filterwarnings("ignore:.*lengths of rigid bones vary")
def test_two_frames_are_too_few_for_the_viewpoint_to_tell():
    clip = random_motion("cmu17", 2, turn=150.0, generator=torch.Generator().manual_seed(1))
    plain = Skeleton(tuple(f"point {i}" for i in range(17)), clip.skeleton.bones)
    with pytest.warns(KcsWarning, match="two frames fit bodies of any depth"):
        found = PKC()(replace(clip.tracks, skeleton=plain))
    assert any("so few frames or joints are solved by sfam" in note for note in found.diagnostics.notes)


@pytest.mark.parametrize(("frames", "yaw"), [(50, 70.0), (40, 70.0)])
def test_feet_do_not_stand_before_a_camera_that_goes_round(frames, yaw):
    """By 4 degrees a frame: they seem to in the image, but what says so would lead astray."""
    clip = walking_person(frames, turn=180.0, yaw=yaw)
    assert standing_feet(clip.tracks) is not None
    result = PKC()(clip.tracks)
    assert error(result.points, clip.points) < 0.05
    known = PKC(seed=3).following()
    assert asdict(known) == asdict(PKC(seed=3, contacts=False)) and SfAM().following() == SfAM()
    assert PKC(seed=3).following(searched=False) == PKC(seed=3, contacts=False)
    body = Body(result.skeleton, clip.tracks.points - clip.tracks.points.mean(1, keepdim=True), 30.0,
                torch.zeros(frames, 17).double(), standing_feet(clip.tracks))  # fmt: skip
    depth = torch.stack([clip.points[..., 2], 0.5 * clip.points[..., 2]]) * body.factor
    depth = depth - depth.mean(-1, keepdim=True)
    cost = body.objective.contact(depth)
    found = Hypotheses(depth, torch.ones(2, 16).double(), torch.tensor([0.0, 1.0]).double() + cost)
    assert_close(body.without_contacts(found).energy, torch.tensor([0.0, 1.0]).double())
    assert not body.objective.contact(depth).any()


def test_contacts_are_an_option(still):
    clip, result = still
    plain = PKC(contacts=False)(clip.tracks)
    assert plain.objective < result.objective - 1  # which holds what contacts cost
    assert error(plain.points, result.points) < 0.05


def test_image_is_kept(still, turning):
    for clip, result in (still, turning):
        assert_close(result.points[..., :2], clip.points[..., :2], rtol=0, atol=1e-6)
        assert result.diagnostics.reprojection_rms < 1e-6
        assert_close(result.scales, torch.ones_like(result.scales))


def test_the_walker_walks_through_space(still):
    clip, result = still
    path = clip.points[:, 0, 2] - clip.points[0, 0, 2]
    found = result.in_space()[:, 0, 2]
    assert path[-1].abs() > 1000  # mm
    assert (found - found[0] - path).abs().max() < 0.2 * path.abs().max()


@pytest.mark.parametrize("case", ["fixed", "turning"])
def test_most_joints_are_within_two_deviations(case, still, turning):
    """Of several clips: an error of a length or a sign is one of all frames of a clip.

    Made-up walkers have the template's proportions, so that up to nine of ten joints are within one deviation; but
    their feet are further in front of the trunk than people's, which seen from the front (20 degrees) makes it lean.
    """
    pairs = [still if case == "fixed" else turning]
    for yaw in (20.0, 40.0, 70.0):
        clip = walking_person(50, turn=0.0 if case == "fixed" else 180.0, yaw=yaw)
        pairs.append((clip, PKC()(clip.tracks)))
    once, twice = [], []
    for clip, result in pairs:
        off = (centred(result.points) - centred(clip.points))[..., 2].abs()
        assert result.uncertainty.shape == off.shape and (result.uncertainty > 0).all()
        once.append(float((off < result.uncertainty).double().mean()))
        twice.append(float((off < 2 * result.uncertainty).double().mean()))
        size = centred(clip.points).square().sum(-1).mean().sqrt()
        assert result.uncertainty.mean() < 0.5 * size
    assert 0.5 < sum(once) / len(once) < 0.95, once
    assert sum(twice) / len(twice) > 0.8 and min(twice) > 0.5, twice


@pytest.mark.parametrize("case", ["fixed", "turning"])
def test_alternatives_differ_and_are_ranked(case, still, turning):
    _, result = still if case == "fixed" else turning
    every = (result, *result.alternatives)
    assert (2 if case == "fixed" else 1) <= len(every) <= 5  # the viewpoint's turn may leave but one
    values = [found.objective for found in every]
    assert values == sorted(values) and all(map(math.isfinite, values))
    size = centred(result.points).square().sum(-1).mean().sqrt()
    for k, one in enumerate(every):
        assert one.tracks is result.tracks and (k == 0 or one.alternatives == ())
        assert torch.isfinite(one.points).all() and torch.isfinite(one.uncertainty).all()
        for other in every[:k]:
            assert (one.points - other.points)[..., 2].square().mean().sqrt() > 0.01 * size


def test_fewer_alternatives_are_the_first_ones(still):
    clip, _ = still
    more, fewer = (PKC(**QUICK, alternatives=n)(clip.tracks) for n in (4, 1))
    assert torch.equal(more.points, fewer.points) and len(fewer.alternatives) == 1
    assert torch.equal(more.alternatives[0].points, fewer.alternatives[0].points)
    assert PKC(**QUICK, alternatives=0)(clip.tracks).alternatives == ()


# ---------------------------------------------------------------------- the viewpoint option


def test_each_solver_alone(still, turning):
    (clip, _), (other, _) = still, turning
    assert error(PKC(viewpoint="fixed", rounds=0)(clip.tracks).points, clip.points) < 0.15
    assert error(PKC(viewpoint="moving")(other.tracks).points, other.points) < 0.1


def test_fixed_needs_a_template_with_a_trunk():
    clip = walking_person(20)
    for body in (Skeleton.from_edges(clip.skeleton.bones, 17), replace(clip.skeleton, template=None)):
        with pytest.raises(OptionError, match="viewpoint: 'fixed' needs a skeleton with a template and a trunk"):
            PKC(viewpoint="fixed")(replace(clip.tracks, skeleton=body))


@pytest.mark.parametrize("frames", [1, module.LEAST_FRAMES - 1])
def test_too_few_frames_leave_no_choice(frames):
    clip = walking_person(frames)
    moving, fixed = (PKC(viewpoint=v, rounds=0, steps=5)(clip.tracks) for v in ("moving", "fixed"))
    assert torch.equal(moving.points, fixed.points)


# ---------------------------------------------------------------------- bodies


def robot():
    arm = Skeleton.from_names(["base", "one", "two", "three", "tip"], [
        ("base", "one"), ("one", "two"), ("two", "three"), ("three", "tip"),
    ])  # fmt: skip
    return random_motion(arm, 60, turn=180.0, generator=torch.Generator().manual_seed(3))


def test_a_body_that_nobody_has_described():
    clip = robot()
    result = PKC()(clip.tracks)
    assert min(error(result.points, clip.points), error(result.mirrored().points, clip.points)) < 0.1
    (mirror,) = result.alternatives  # nothing tells it from the truth
    assert_close(mirror.points, result.mirrored().points)
    assert mirror.objective == result.objective and "mirror" in mirror.diagnostics.notes[0]
    assert result.root_depth is None


@pytest.mark.filterwarnings("ignore:.*bone lengths vary")  # one start may end in the wrong valley
@pytest.mark.filterwarnings("ignore::kcs_torch.KcsWarning")
def test_seeds_of_random_starts():
    tracks = robot().tracks
    noise = torch.randn(tracks.points.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    tracks = replace(tracks, points=tracks.points + 5 * noise)  # without it, one answer is found from all starts
    one, same, other = (PKC(lifts=1, seed=seed)(tracks).points for seed in (1, 1, 2))
    assert torch.equal(one, same) and not torch.equal(one, other)


def test_known_cameras_tell_the_mirror_images_apart(turning):
    clip, _ = turning
    result = PKC(viewpoint="moving")(clip.tracks, clip.cameras)
    assert error(result.points, clip.points) < 0.1
    assert torch.equal(result.cameras, clip.cameras) and result.alternatives == ()


def test_deviations_do_not_depend_on_the_alternatives_asked_for(still):
    clip, result = still
    assert len(result.alternatives) > 1
    for count in (0, 1):
        few = PKC(alternatives=count)(clip.tracks)
        assert len(few.alternatives) == count
        assert_close(few.points, result.points)
        assert_close(few.uncertainty, result.uncertainty)


@pytest.mark.filterwarnings("ignore:.*never seen, so placed:kcs_torch.KcsWarning")
@pytest.mark.parametrize("joint", ["right_wrist", "left_ankle", "left_knee"])
def test_a_joint_never_seen_spoils_no_other(joint):
    clip = walking_person(60, turn=0.0, yaw=70.0)
    missing = clip.skeleton.index(joint)
    points = clip.tracks.points.clone()
    points[:, missing] = NAN
    hidden = PKC()(Tracks.from_arrays(points, skeleton=clip.skeleton, fps=30))
    others = [j for j in range(clip.skeleton.num_observed) if j != missing]
    whole = PKC()(clip.tracks)
    figures = [error(found.points[:, others], clip.points[:, others]) for found in (whole, hidden)]
    assert figures[1] < figures[0] + 0.1, figures


def test_known_cameras_are_those_of_every_solution(turning):
    clip, _ = turning
    result = PKC()(clip.tracks, clip.cameras)
    assert result.root_depth is None  # feet that stand still do not do so in the image
    assert error(result.points, clip.points) < 0.1
    for one in (result, *result.alternatives):
        assert torch.equal(one.cameras, clip.cameras)
        assert error(one.points * FLIP, clip.points) > 1  # none is the mirror image


@pytest.mark.parametrize("turn", [0.0, 120.0])
def test_polish(turn, monkeypatch):
    """Bones that would move in depth each by itself move together, in blocks of long clips, too."""
    clip = walking_person(72, turn=turn, yaw=40.0)
    polished = PKC()(clip.tracks)
    monkeypatch.setattr(body_module, "LONG", 48)
    blocks = PKC()(clip.tracks)
    monkeypatch.setattr(Body, "polished", lambda self, found, steps, other=None: left(found))
    plain = PKC()(clip.tracks)
    share = 0.9 if turn == 0 else 0.5
    assert error(polished.points, clip.points) < share * error(plain.points, clip.points)
    assert error(blocks.points, clip.points) < share * error(plain.points, clip.points)
    assert polished.diagnostics.bone_variation < 0.5 and blocks.diagnostics.bone_variation < 0.5


def test_gaps_are_filled_in_space(monkeypatch):
    """By what other joints do while one is unseen, with the bones that the first solution found."""
    draw = torch.Generator().manual_seed(3)
    clips = [walking_person(60, turn=20.0, yaw=yaw, missing=0.25, generator=draw) for yaw in (30.0, 60.0)]
    errors = []
    for _ in range(2):
        errors.append(sum(error(PKC()(clip.tracks).points, clip.points) for clip in clips))
        monkeypatch.setattr(body_module, "gaps_of", lambda noise: torch.zeros_like(noise, dtype=torch.bool))
    assert errors[0] < 0.8 * errors[1], errors


def test_gaps_of_a_swaying_viewpoint_are_filled_again(monkeypatch):
    """What is polished with better places is better; before a viewpoint at rest nothing is done again."""
    draw = torch.Generator().manual_seed(5)
    views = ((50.0, 30.0), (50.0, 60.0), (5.0, 30.0))
    clips = [walking_person(60, turn=turn, yaw=yaw, missing=0.2, generator=draw) for turn, yaw in views]
    again, once = [], []
    for fills, answers in ((module.FILLS, again), (1, once)):
        monkeypatch.setattr(module, "FILLS", fills)
        answers += [PKC()(clip.tracks).points for clip in clips]
    errors = [sum(error(some[k], clips[k].points) for k in (0, 1)) for some in (again, once)]
    assert errors[0] < 0.95 * errors[1], errors
    assert torch.equal(again[2], once[2])


def test_a_gap_at_the_end_of_a_clip_does_not_spoil_it(protocol, shared):
    """A neck that only ever shows now and then: nobody's neck is half a metre long."""
    case = {"src": "cmu_cs2s/train_directing_traffic_1", "sway": 20, "missing": 0.3, "yaw": 45, "pitch": 10}
    given, truth = protocol.build(shared / "data", case | {"max_frames": 150})
    tracks = Tracks.from_arrays(
        given["points2d"], edges=given["edges"], joint_names=given["joint_names"], fps=given["fps"], units="mm"
    )
    found = PKC()(tracks)
    assert protocol.score(found.observed.numpy(), truth["points3d"], truth["edges"])["rigid"] < 40  # flat is at 107


def test_joints_never_seen_do_not_tell_the_noise():
    noise = torch.full((40, 17), 0.004, dtype=torch.float64)
    noise[:, 7:] = 0.1  # more than half
    noise[:30, 0] = 0.1
    assert usual_noise(noise) == usual_noise(noise[:, :7]) == 0.004
    clip = walking_person(40, turn=0.0)
    image = centred(clip.points / 1000)[..., :2]
    few, all_seen = (Body(clip.skeleton, image, 30.0, each).objective for each in (noise, noise.clamp_max(0.004)))
    assert_close(few.weights.acceleration, all_seen.weights.acceleration, rtol=0.1, atol=0)


def test_what_counts_as_a_gap():
    """Joints that are seen elsewhere and not where they are; those never seen are not filled by what they never did."""
    clip = walking_person(40, turn=0.0)
    image = centred(clip.points / 1000)[..., :2]
    noise = torch.zeros(40, 17).double()
    noise[10:15, 3] = noise[:, 13] = 0.1
    body = Body(clip.skeleton, image, 30.0, noise)
    gap = torch.zeros(40, 17, dtype=torch.bool)
    gap[10:15, 3] = True
    assert torch.equal(gaps_of(body.noise), gap)
    moved = body.image + 0.05 * normal(40, 17, 2)
    other = body.filled(moved)
    scale = other.factor / body.factor
    away = other.image / scale - body.image
    away = away - away[:, :1]  # frames are centred anew
    assert_close(away[~gap.any(1)], torch.zeros_like(away[~gap.any(1)]), rtol=0, atol=1e-9)
    assert away[gap].norm(dim=-1).mean() > 0.02
    assert_close(other.noise[gap], 0.2 * scale * body.noise[gap])
    assert_close(other.noise[~gap], scale * body.noise[~gap])


def left(found):
    yield from ()
    return found


def test_polish_takes_no_mirror_image(turning):
    """It costs the same there: only the template tells which is right, however close the two are."""
    clip, _ = turning
    tracks = replace(
        clip.tracks, points=centred(clip.tracks.points) / centred(clip.tracks.points).square().mean().sqrt()
    )
    body = Body(tracks.skeleton, tracks.points, 30.0, torch.zeros_like(tracks.weights))
    depth = centred(clip.points)[..., 2] / centred(clip.points)[..., :2].square().mean().sqrt() * body.factor
    lengths = bone_lengths(torch.cat([body.image, depth[..., None]], -1), tracks.skeleton.bone_index()).median(0).values
    both = Hypotheses(torch.stack([depth, -depth]), lengths.expand(2, -1), torch.tensor([0.0, 0.1]).double())
    for found, sign in ((both, 1), (replace(both, depth=-both.depth), -1)):
        polished = run(body.polished(found, 0), serve)
        assert_close(polished.depth[0], sign * depth, rtol=0, atol=0.02)
        assert_close(polished.depth[1], -sign * depth, rtol=0, atol=0)


def test_what_the_turn_confirms_is_not_searched_further():
    """What it tells otherwise changes nothing; before a camera at rest it is not asked for."""
    clip = walking_person(60, turn=120.0)
    points = centred(clip.tracks.points) / centred(clip.tracks.points).square().mean().sqrt()
    body = Body(clip.skeleton, points, 30.0, torch.zeros_like(clip.tracks.weights))
    depth = centred(clip.points)[..., 2] / centred(clip.points)[..., :2].square().mean().sqrt() * body.factor
    asked = []

    def turned(depth):
        def told(far):
            assert not far
            asked.append(1)
            yield from ()
            return depth

        return told

    plain = run(body.search(1, 30), serve)
    for other, share in ((depth, 0.6), (-depth, 0.6), (depth.roll(20, 0), 1.0), (0 * depth, 1.0)):
        asked.clear()
        found = run(body.search(1, 30, turned(other)), serve)
        assert found.steps <= share * plain.steps and len(asked) == 1
        assert_close(found.depth[0], plain.depth[0], rtol=0, atol=0.06 if share < 1 else 0)
    still = walking_person(60, turn=0.0, yaw=40.0).tracks
    image = centred(still.points) / centred(still.points).square().mean().sqrt()
    asked.clear()
    run(Body(still.skeleton, image, 30.0, torch.zeros_like(still.weights)).search(0, 5, turned(depth)), serve)
    assert not asked


def test_polish_takes_nothing_that_the_template_rules_out(turning, monkeypatch):
    """Bones whose lengths and changes fit better than the truth's are no rival where the body would be no body."""
    clip, _ = turning
    tracks = replace(
        clip.tracks, points=centred(clip.tracks.points) / centred(clip.tracks.points).square().mean().sqrt()
    )
    body = Body(tracks.skeleton, tracks.points, 30.0, torch.zeros_like(tracks.weights))
    depth = centred(clip.points)[..., 2] / centred(clip.points)[..., :2].square().mean().sqrt() * body.factor
    asked = []

    def answer(requests):
        asked.extend(one for one in requests if isinstance(one, Descent))
        return serve(requests)

    found = run(body.rank(depth[None], 30), serve)
    assert_close(found.depth[0], depth, rtol=0, atol=0.05)
    near = depth + 0.02 * torch.sin(torch.arange(len(depth)).double() / 9)[:, None]
    knee = [tracks.skeleton.index(name) for name in ("right_ankle", "left_ankle", "right_knee", "left_knee")]
    wrong = depth.clone()
    wrong[:, knee] *= -1
    for other, count in ((near, 2), (-near, 2), (wrong, 1), (None, 1)):
        asked.clear()
        polished = run(body.polished(found, 30, other), answer)
        assert [len(one.points) for one in asked] == [count]
        assert_close(polished.depth[0], depth, rtol=0, atol=0.05)


def test_a_template_of_another_body_rules_little_out(turning):
    """What the viewpoint's turn tells is believed, though it costs more than such a template allows otherwise."""
    clip, _ = turning
    skeleton = clip.tracks.skeleton
    other = torch.tensor(skeleton.template) * torch.tensor([1.0, 0.6, 1.0])
    other[[skeleton.index(name) for name in ("left_wrist", "right_wrist", "left_knee", "right_knee")]] *= 1.3
    strange = replace(skeleton, template=tuple(map(tuple, other.tolist())))
    points = centred(clip.tracks.points) / centred(clip.tracks.points).square().mean().sqrt()
    depth = centred(clip.points)[..., 2] / centred(clip.points)[..., :2].square().mean().sqrt()
    legs = [skeleton.index(name) for name in ("right_ankle", "left_ankle", "right_knee", "left_knee")]
    for known, odd in ((skeleton, False), (strange, True)):
        body = Body(known, points, 30.0, torch.zeros_like(clip.tracks.weights))
        truth, wrong = depth * body.factor, depth.clone() * body.factor
        wrong[:, legs] *= -1
        found = run(body.rank(wrong[None], 30), serve)
        cheaper = run(body.rank(truth[None], 30), serve).energy - 30
        polished = run(body.polished(replace(found, energy=cheaper), 30, truth), serve)
        assert body.is_odd(found) == odd
        assert bool((polished.depth[0] - truth).abs().mean() < 0.02) == odd


@pytest.mark.parametrize("turn", [15.0, 60.0])
def test_known_cameras_make_nothing_worse(turn):
    """A little turn tells the sign of depth, but hardly depth: that still comes from the template."""
    clip = walking_person(50, turn=turn, yaw=40.0)
    plain, known = PKC()(clip.tracks), PKC()(clip.tracks, clip.cameras)
    assert error(known.points, clip.points) < 0.05
    assert error(known.points, clip.points) < 1.1 * error(plain.points, clip.points)


def test_cameras_that_are_known_to_stand_still_tell_nothing(still):
    clip, plain = still
    known = PKC()(clip.tracks, clip.cameras)
    assert torch.equal(known.points, plain.points) and torch.equal(known.cameras, clip.cameras)


@pytest.mark.filterwarnings("ignore::kcs_torch.KcsWarning")
@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("body", ["hand21", "robot"])
def test_known_cameras_tell_which_of_two_mirror_images(body, side):
    """Of a hand that may be the other one, and of a body without a template: the same tracks, cameras the other way."""
    if body == "robot":
        clip = robot()
    else:
        clip = random_motion(body, 90, turn=120.0, swing=15.0, generator=torch.Generator().manual_seed(3))
    flip = torch.tensor([1.0, 1.0, side]).double()
    rotations = flip[:, None] * complete_rotation(clip.cameras) * flip
    result = PKC(lifts=2)(clip.tracks, rotations[:, :2])
    assert error(result.points, clip.points * flip) < 0.3
    assert error(result.points * FLIP, clip.points * flip) > 1
    if body == "robot":
        assert result.alternatives == ()


@pytest.mark.filterwarnings("ignore::kcs_torch.KcsWarning")  # links that are no tree are pulled on but weakly
def test_known_cameras_and_markers():
    clip = robot()
    arm = clip.tracks.skeleton
    body = Skeleton(arm.joints, (*arm.bones, (0, 2), (1, 3)), flexible=(4, 5), tree=False)
    tracks = replace(clip.tracks, skeleton=body)
    plain, known = PKC()(tracks), PKC()(tracks, clip.cameras)
    best = min(error(points, clip.points) for points in (plain.points, plain.points * FLIP))
    assert error(known.points, clip.points) == pytest.approx(best)


# ---------------------------------------------------------------------- units, types


@pytest.mark.parametrize("factor", [2.0**-20, 2.0**13])
def test_units_scale_the_result(still, factor):
    """Powers of two are not rounded, so that not a bit of the result may change."""
    clip, _ = still
    points = clip.tracks.points
    plain, other = (PKC(**QUICK)(replace(clip.tracks, points=p)) for p in (points, factor * points))
    for found, expected in zip((other, *other.alternatives), (plain, *plain.alternatives), strict=True):
        assert torch.equal(found.points / factor, expected.points)
        assert torch.equal(found.uncertainty / factor, expected.uncertainty)
        assert torch.equal(found.lengths / factor, expected.lengths)
        assert found.objective == expected.objective


@pytest.mark.parametrize("factor", [1e-6, 1e-3, 1e4])
def test_rounding_changes_little(still, factor):
    """Polishing stops on its way along a shallow valley, where rounding moves a joint or two by a millimetre."""
    clip, _ = still
    points = clip.tracks.points
    plain, other = (PKC(**QUICK)(replace(clip.tracks, points=p)) for p in (points, factor * points - 5 * factor))
    for found, expected in zip((other, *other.alternatives), (plain, *plain.alternatives), strict=True):
        moved = centred(found.points) / factor - centred(expected.points)
        assert float(moved.square().mean().sqrt()) < 0.5 and float(moved.abs().amax()) < 3.0  # mm
        assert_close(found.uncertainty / factor, expected.uncertainty, rtol=0.02, atol=1.0)
        assert_close(found.lengths / factor, expected.lengths, rtol=0, atol=1.0)
        assert found.objective == pytest.approx(expected.objective, abs=0.1)


def test_single_precision(still):
    clip, _ = still
    wide = PKC(**QUICK)(clip.tracks)
    result = PKC(**QUICK)(clip.tracks.to(torch.float32))
    assert result.points.dtype == result.uncertainty.dtype == result.root_depth.dtype == torch.float32
    assert_close(result.points.double(), wide.points, rtol=0, atol=20.0)  # mm, of a person


def test_a_body_whose_size_in_the_image_changes(turning):
    clip, _ = turning
    size = torch.linspace(0.7, 1.3, 50).double()
    tracks = replace(clip.tracks, points=centred(clip.tracks.points) * size[:, None, None])
    result = PKC(viewpoint="moving")(tracks)
    assert_close(result.scales / result.scales.mean(), size / size.mean(), rtol=0, atol=0.08)
    assert any("size in the image varies" in note for note in result.diagnostics.notes)
    true = result.points * (centred(clip.points).std() / centred(result.points).std())
    assert error(true, clip.points) < 0.2


# ---------------------------------------------------------------------- clips that tell little


def check(result):
    frames, joints = result.tracks.num_frames, result.tracks.num_joints
    for one in (result, *result.alternatives):
        assert one.points.shape == (frames, joints, 3)
        assert one.uncertainty is None or one.uncertainty.shape == (frames, joints)
        for value in (one.points, one.cameras, one.scales, one.lengths, one.uncertainty, one.root_depth):
            assert value is None or torch.isfinite(value).all()


def of(points):
    return Tracks.from_arrays(points, skeleton="h36m17", fps=30.0)


WALK = walking_person(16, turn=60.0).tracks.points
LITTLE = {
    "one frame": lambda: WALK[:1],
    "static": lambda: WALK[:1].expand(16, -1, -1),
    "one place": lambda: torch.zeros(16, 17, 2),
    "on a line": lambda: WALK * torch.tensor([0.0, 1.0]),
    "a frame unseen": lambda: WALK.index_fill(0, torch.tensor([4]), NAN),
    "a leg unseen": lambda: WALK.index_fill(1, torch.tensor([4, 5, 6]), NAN),
    "the trunk unseen": lambda: WALK.index_fill(1, torch.tensor([0, 7, 8]), NAN),
    "all but two joints unseen": lambda: WALK.index_fill(1, torch.arange(2, 17), NAN),
    "all but one joint unseen": lambda: WALK.index_fill(1, torch.arange(1, 17), NAN),
}


@pytest.mark.parametrize("viewpoint", ["auto", "fixed", "moving"])
@pytest.mark.parametrize("case", LITTLE)
@pytest.mark.filterwarnings("ignore:.*never seen", "ignore:.*this is hardly a body of skeleton 'h36m17'")  # on a line
def test_clips_that_tell_little(case, viewpoint):
    check(PKC(viewpoint=viewpoint, rounds=1, steps=3)(of(LITTLE[case]())))


def test_one_pose_gives_one_pose():
    result = PKC(viewpoint="fixed", rounds=0)(of(LITTLE["static"]()))
    assert (result.points - result.points[:1]).abs().max() < 20  # mm
    assert result.points[0, :, 2].std() > 30  # and not flat


def test_a_leg_never_seen_is_told_and_uncertain():
    tracks = of(LITTLE["a leg unseen"]())
    with pytest.warns(KcsWarning, match="never seen.*left_knee"):
        result = PKC(**QUICK)(tracks)
    legs = {
        name: [result.skeleton.joints.index(f"{side}_{name}") for side in ("left", "right")]
        for name in ("knee", "ankle")
    }
    for left, right in legs.values():  # as long as the other one
        up = lambda joint: (result.points[:, joint] - result.points[:, 0]).norm(dim=-1).mean()  # noqa: E731
        assert up(left) / up(right) == pytest.approx(1, abs=0.35)


# ---------------------------------------------------------------------- noise, gaps, wrong detections


@pytest.mark.parametrize("turn", [0, 90])
@pytest.mark.parametrize("prepare", [smooth, resample])
def test_noise_that_was_filtered_is_noise_still(prepare, turn):
    """It has no floor in the spectrum; taken for motion it costs 80 mm, and 250 where frames were put between."""
    clip = walking_person(90, turn=turn, noise=5.0, generator=torch.Generator().manual_seed(0))
    if prepare is smooth:
        tracks, truth = smooth(clip.tracks, cutoff=6.0), clip.points
    else:
        tracks, truth = resample(clip.tracks, 60), walking_person(179, fps=60, turn=turn).points
    off = PKC()(tracks).points - truth
    assert (off - off.mean(1, keepdim=True)).norm(dim=-1).mean() < 20


@pytest.mark.parametrize("metres", [30, 120])
def test_small_changes_of_size_are_told(metres):
    """Of a walk towards a distant camera; taken for constant, they cost 95 and 35 mm."""
    clip = walking_person(120, turn=0, yaw=45.0)
    ahead = clip.points + clip.points.new_tensor([0.0, 0, 1000 * metres])
    result = PKC()(replace(clip.tracks, points=ahead[..., :2] / ahead[..., 2:] * 1000 * metres))
    assert any("weak perspective" in note for note in result.diagnostics.notes)
    assert error(result.points, clip.points) < 0.12  # 14 mm
    far = result.scales.log() + ahead[..., 2].mean(-1).log()
    assert (far - far.mean()).abs().max() < 0.01
    assert not any("weak perspective" in note for note in PKC()(clip.tracks).diagnostics.notes)


@pytest.mark.parametrize("yaw", [30.0, 60.0])
@pytest.mark.parametrize("disturb", ["noise", "less noise, more frames", "whole pixels"])
def test_a_little_noise_does_little_harm(disturb, yaw):
    """A millimetre a frame, taken for motion, made bones turn out of the image plane: errors of 33 to 46 mm."""
    frames, rate = (400, 120.0) if "frames" in disturb else (100, 30.0)
    clip = walking_person(frames, turn=0.0, yaw=yaw, fps=rate)
    if "noise" in disturb:
        points = clip.tracks.points + (0.5 if "less" in disturb else 1.3) * normal(frames, 17, 2, seed=1)
    else:
        points = (clip.tracks.points / 4).round() * 4  # of a person who is about 440 pixels tall
    found = PKC()(replace(clip.tracks, points=points))
    off = found.points - clip.points
    error = (off - off.mean(1, keepdim=True)).norm(dim=-1)
    assert float(error.mean()) < 16 and any("tracks smoothed" in note for note in found.diagnostics.notes)


def test_noise_gaps_and_wrong_detections_are_cleaned_first():
    clip = walking_person(60, turn=0.0, noise=20.0, missing=0.05, generator=torch.Generator().manual_seed(1))
    points = clip.tracks.points.clone()
    points[::9, 3] += 600.0
    tracks = of(torch.where(clip.tracks.seen[..., None], points, NAN))
    result, raw = PKC(rounds=0)(tracks), PKC(rounds=0, denoise=False)(tracks)
    notes = " ".join(result.diagnostics.notes)
    assert "rejected as outliers" in notes and "tracks smoothed" in notes
    assert error(result.points, clip.points) < 0.5
    assert error(result.points, clip.points) < error(raw.points, clip.points)
    bones = result.skeleton.bone_index()
    true = bone_lengths(clip.points, bones).mean(0)
    grown = result.lengths / true
    assert grown.median() == pytest.approx(1, abs=0.03)
    assert (grown[true > 200] - 1).abs().max() < 0.1  # mm; a hip of 130 is hardly longer than the noise is large


def test_clips_are_cleaned_together_as_alone():
    tasks = []
    for seed, frames in enumerate((30, 41, 30, 30, 5)):
        clip = walking_person(
            frames, noise=5.0 * seed, missing=0.1, generator=torch.Generator().manual_seed(seed)
        ).tracks
        tasks.append(Noisy(clip.points, clip.weights))
    for task, found in zip(tasks, clean_all(tasks), strict=True):
        (alone,) = clean_all([task])
        assert torch.equal(found.outliers, alone.outliers) and torch.equal(found.weights, alone.weights)
        assert_close(found.points, alone.points, rtol=1e-6, atol=1e-3)  # mm
        assert_close(found.noise, alone.noise, rtol=1e-6, atol=1e-3)


def test_confidences_that_vary_are_a_detector_s():
    """Its joints stray for long, which no smoothing tells: lengths need not be kept as if the image were exact."""
    clip = walking_person(30, turn=0.0)
    method = PKC(rounds=0)
    weights = torch.rand(clip.tracks.weights.shape, generator=torch.Generator().manual_seed(0)).double() * 0.8 + 0.2
    unsure = replace(clip.tracks, weights=weights, detector=None)
    _, noise, notes = run(cleaned(unsure, denoise=True), serve)
    assert_close(noise, detector.DETECTED / weights.sqrt())
    assert any("detector" in note for note in notes)
    chosen = torch.where(weights > 0.6, 1.0, 0.3)
    for sure in (torch.ones_like(weights), torch.full_like(weights, 0.5), (weights > 0.4).double(), chosen):
        assert not detector.detected(replace(clip.tracks, weights=sure, detector=None))
    assert detector.detected(unsure)
    assert not detector.detected(replace(unsure, weights=torch.zeros_like(weights)))
    spread = method(unsure).uncertainty.mean()
    assert spread > method(clip.tracks).uncertainty.mean()


def test_bones_are_constant_though_the_image_is_not_exact():
    """Where it is exact it stays as it is; otherwise joints move by less than their noise."""
    clip = walking_person(40, turn=0.0, noise=20.0, generator=torch.Generator().manual_seed(2))
    method, bones = PKC(rounds=0), clip.tracks.skeleton.bone_index()
    result = method(clip.tracks)
    lengths = bone_lengths(result.points, bones)
    assert (lengths.std(0) / lengths.mean(0)).median() < 0.004
    moved = centred(result.points)[..., :2] - centred(clip.points)[..., :2]
    assert moved.square().mean().sqrt() < 20.0
    exact = method(walking_person(40, turn=0.0).tracks)
    assert_close(centred(exact.points)[..., :2], centred(exact.tracks.points))


# ---------------------------------------------------------------------- fields


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("viewpoint", "still"),
        ("viewpoint", None),
        ("denoise", "yes"),
        ("denoise", 1),
        ("lifts", 0),
        ("lifts", 2.5),
        ("rounds", -1),
        ("rounds", NAN),
        ("steps", 0),
        ("alternatives", -1),
        ("alternatives", True),
        ("seed", "one"),
        ("seed", None),
    ],
)
def test_fields_out_of_range(field, value):
    with pytest.raises(OptionError, match=f"pkc: {field}: expected"):
        PKC(**{field: value})


def test_unknown_fields_are_answered_with_the_right_one():
    with pytest.raises(OptionError, match="did you mean 'rounds'"):
        PKC.from_options(round=1)


def test_says_whether_it_settled(still):
    clip, found = still
    assert found.diagnostics.converged
    with pytest.warns(ConvergenceWarning, match="did not settle"):
        hasty = PKC(viewpoint="fixed", rounds=0, steps=1)(clip.tracks)
    assert not hasty.diagnostics.converged


def test_depth_that_is_a_guess_is_told():
    """Without a template nothing tells depth before a camera that stands still."""
    body = replace(walking_person(2).tracks.skeleton, template=None, proportions=None, spread=None, hinges=())
    for turn, told in ((0.0, True), (180.0, False)):
        clip = walking_person(60, turn=turn, yaw=30.0)
        tracks = replace(clip.tracks, skeleton=body)
        if told:
            with pytest.warns(KcsWarning, match="little more than a guess"):
                found = PKC()(tracks)
            assert error(found.points, clip.points) > 0.3
            assert found.uncertainty.mean() > 0.3 * centred(clip.points)[..., 2].square().mean().sqrt()
        else:
            found = PKC()(tracks)
            assert error(found.points, clip.points) < 0.1 or error(found.points * FLIP, clip.points) < 0.1
        assert any("guess" in note for note in found.diagnostics.notes) == told
        assert not any("template and lengths" in note for note in found.diagnostics.notes)


def test_poses_are_held_where_nobody_is_seen():
    """A model of motion would run off beyond the clip's ends."""
    clip = walking_person(60, turn=0.0, yaw=40.0)
    weights = clip.tracks.weights.clone()
    weights[:12], weights[-9:] = 0, 0
    noise = 0.01 * centred(clip.points).square().sum(-1).mean().sqrt()
    points = clip.tracks.points + noise * torch.randn(
        clip.tracks.points.shape, generator=torch.Generator().manual_seed(0)
    )
    found = PKC()(replace(clip.tracks, points=torch.where(weights[..., None] > 0, points, 0), weights=weights))
    size = bone_lengths(found.points, clip.tracks.skeleton.bone_index())
    assert (size[:12] < 1.3 * size.median(0).values).all() and (size[-9:] < 1.3 * size.median(0).values).all()
    assert any("21 frames at the clip's ends show nobody" in note for note in found.diagnostics.notes)
    weights[:-1] = clip.tracks.weights[:-1]
    one = PKC(rounds=0, steps=3)(replace(clip.tracks, weights=weights))
    assert any("1 frame at the clip's ends shows nobody" in note for note in one.diagnostics.notes)


@pytest.mark.filterwarnings("ignore::kcs_torch.KcsWarning")
def test_too_little_for_the_moving_viewpoint_is_told():
    clip = random_motion(Skeleton.from_names(list("abc"), [("a", "b"), ("b", "c")]), turn=180)
    assert any("solved by sfam" in note for note in PKC()(clip.tracks).diagnostics.notes)


def test_many_clips_take_few_more_operations_than_one():
    """Counts, which no busy machine changes: six clips of six lengths, padded to few batches."""
    clips = [walking_person(24 + i, turn=20.0 * (i % 3), yaw=40.0 * i).tracks for i in range(6)]
    one, many = (count_operations(lambda c=some: PKC().many(c)).total for some in (clips[3:4], clips))
    assert many < 2.3 * one


def test_several_clips_at_once():
    """Clips of several lengths and frame rates, noisy and clean, give what each gives alone."""
    clips = [
        walking_person(n, turn=0.0, yaw=40.0, noise=x, fps=f).tracks
        for n, x, f in ((20, 0, 30.0), (31, 8, 30.0), (24, 0, 20.0))
    ]
    method = PKC(rounds=0, steps=4)
    for alone, one in zip(map(method, clips), method.many(clips), strict=True):
        assert_close(one.points, alone.points, rtol=1e-3, atol=2.0)
        assert_close(one.objective, alone.objective, rtol=1e-2, atol=0.5)
        assert len(one.alternatives) == len(alone.alternatives)
    assert method.many([]) == []


@pytest.mark.parametrize(
    ("flipped", "frames", "lens"), [({2}, 14, "parallel"), (range(16), 14, "parallel"), ({2}, 3, (1500, 1500, 0, 0))]
)
def test_the_direction_in_which_bones_are_written_changes_nothing(flipped, frames, lens):
    tracks = walking_person(frames, yaw=60.0).tracks
    body = tracks.skeleton
    other = replace(body, bones=tuple(b[::-1] if i in flipped else b for i, b in enumerate(body.bones)))
    usual, found = (reconstruct(replace(tracks, skeleton=s), intrinsics=lens, steps=4, rounds=0) for s in (body, other))
    assert found.skeleton == found.tracks.skeleton == other
    assert_close(found.points, usual.points, rtol=0, atol=1e-6 * float(usual.points.abs().max()))
    assert_close(found.lengths, usual.lengths)


@pytest.mark.filterwarnings("ignore::kcs_torch.KcsWarning")
@pytest.mark.parametrize("joints", ["ab", "abc"])
@pytest.mark.parametrize("frames", [1, 24])
def test_bodies_of_two_or_three_joints_keep_their_lengths(joints, frames):
    body = Skeleton(joints, [(i, i + 1) for i in range(len(joints) - 1)])
    tracks = random_motion(body, frames, turn=90.0, generator=torch.Generator().manual_seed(0)).tracks
    found = PKC()(tracks)
    lengths = bone_lengths(found.points, body.bone_index())
    assert_close(lengths, lengths.mean(0).expand_as(lengths), rtol=1e-6, atol=0)
    assert_close(found.points[..., :2], tracks.points, rtol=0, atol=1e-6 * float(tracks.points.abs().max()))


@pytest.mark.parametrize("width", [1.0, 3.0])
def test_a_body_unlike_its_template_is_not_searched_again_for_a_change_of_size(width, monkeypatch):
    """Where the viewpoint turns its template hardly counts, and no other search asks for such small changes."""
    tried, real = [], module.resized
    monkeypatch.setattr(module, "resized", lambda *given: tried.append(given) or real(*given))
    body = SKELETONS["coco17"]
    body = replace(body, template=tuple((width * x, y, z) for x, y, z in body.template))
    tracks = random_motion(body, 40, turn=120.0, generator=torch.Generator().manual_seed(0)).tracks
    size = torch.linspace(1, 1.03, 40, dtype=torch.float64)[:, None, None]
    with warnings.catch_warnings(action="ignore", category=KcsWarning):
        PKC(steps=10)(Tracks.from_arrays((tracks.points * size)[:, :17], skeleton="coco17", fps=30.0))
    assert len(tried) == (width == 1.0)


@pytest.mark.parametrize("detections", [False, True])
def test_a_large_change_of_size_that_explains_little_is_tried_of_a_detector_s_tracks_alone(detections, monkeypatch):
    """Whose errors hide what it explains."""
    tried, real = [], module.resized
    monkeypatch.setattr(module, "resized", lambda *given: tried.append(given) or real(*given))
    path = torch.linspace(0.9, 1.1, 40, dtype=torch.float64)
    sizes = lambda tracks: [Size(path, 0.1) for _ in tracks]  # noqa: E731
    monkeypatch.setattr(batch, "weak_perspectives", sizes)
    clip = walking_person(40, turn=0, yaw=40)
    PKC(steps=3, rounds=0, detections=detections)(clip.tracks)
    assert len(tried) == detections
