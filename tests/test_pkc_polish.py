"""PKC: solutions that are polished, gaps that are filled in space, and joints never seen."""

import math
from dataclasses import replace

import pytest
import torch
from numerics import CHAIN, normal
from pkc_walks import NAN, centred, error
from torch.testing import assert_close

from kcs_torch import PKC, Tracks
from kcs_torch.data import walking_person
from kcs_torch.functional import bone_lengths
from kcs_torch.methods.clips.lockstep import run
from kcs_torch.methods.pkc import body as body_module
from kcs_torch.methods.pkc import method as module
from kcs_torch.methods.pkc.batch import serve
from kcs_torch.methods.pkc.blocks import search
from kcs_torch.methods.pkc.body import Body
from kcs_torch.methods.pkc.descents import Descent
from kcs_torch.methods.pkc.gaps import gaps_of, usual_noise
from kcs_torch.methods.pkc.hypotheses import Hypotheses
from kcs_torch.solvers.procrustean import Pose

# Many tests take few steps, after which nothing has settled.
pytestmark = pytest.mark.filterwarnings("ignore::kcs_torch.ConvergenceWarning")


def left(found):
    """What polishing would begin from, as it is."""
    yield from ()
    return found


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


@pytest.mark.parametrize("turn", [0.0, 120.0])
def test_polish(turn, monkeypatch):
    """Bones that would move in depth each by itself move together, in blocks of long clips, too."""
    clip = walking_person(72, turn=turn, yaw=40.0)
    polished = PKC()(clip.tracks)
    monkeypatch.setattr(body_module, "LONG", 48)
    blocks = PKC()(clip.tracks)
    monkeypatch.setattr(Body, "polished", lambda self, found, *rest: left(found))
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

    plain = run(search(body, 1, 30), serve)
    for other, share in ((depth, 0.6), (-depth, 0.6), (depth.roll(20, 0), 1.0), (0 * depth, 1.0)):
        asked.clear()
        found = run(search(body, 1, 30, turned(other)), serve)
        assert found.steps <= share * plain.steps and len(asked) == 1
        assert_close(found.depth[0], plain.depth[0], rtol=0, atol=0.06 if share < 1 else 0)
    still = walking_person(60, turn=0.0, yaw=40.0).tracks
    image = centred(still.points) / centred(still.points).square().mean().sqrt()
    asked.clear()
    body = Body(still.skeleton, image, 30.0, torch.zeros_like(still.weights))
    run(search(body, 0, 5, turned(depth)), serve)
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
        assert len(asked[0].points) == count
        assert_close(polished.depth[0], depth, rtol=0, atol=0.05)


def test_rivals_that_are_dearer_by_far_go_no_further(turning):
    """And what goes on is as it was when all went through the last stage."""
    clip, _ = turning
    points = centred(clip.tracks.points) / centred(clip.tracks.points).square().mean().sqrt()
    body = Body(clip.skeleton, points, 30.0, torch.zeros_like(clip.tracks.weights))
    depth = centred(clip.points)[..., 2] / centred(clip.points)[..., :2].square().mean().sqrt() * body.factor
    wrong = depth + 0.1 * torch.sin(torch.arange(len(depth)).double() / 5)[:, None] * normal(depth.shape[1])
    rows = []

    def answer(requests):
        rows.append(len(requests[0].points))
        return serve(requests)

    for other, dearer, counts in ((depth, 0.0, [2, 2]), (wrong, 100.0, [2, 1])):
        rows.clear()
        both = torch.stack([depth, other])
        found, _, value = run(body.descended(both, body_module.POLISH, torch.tensor([0.0, dearer])), answer)
        whole, _, last = run(body.descended(both, body_module.POLISH), serve)
        assert rows == counts
        assert_close(found[0], whole[0], rtol=0, atol=1e-6)
        assert_close(value[0], last[0], rtol=1e-6, atol=0)
        assert value[1] >= value[0]


def test_rivals_that_stay_behind_stay_so():
    """By the value, too, of which the last stage's scales make more: nor do costs that are not finite stop it."""
    points, behind = normal(5, 4, 3), 2 * body_module.BEHIND * body_module.ONE
    asked = []

    def answer(requests):
        (one,) = requests
        asked.append(len(one.points))
        value = torch.tensor([100.0, 100.0 + behind] if len(asked) == 1 else [500.0] * asked[-1]).double()
        return [Pose(one.points, one.rotations, value, torch.zeros_like(value))]

    task = Descent(
        points[..., :2], points.expand(2, -1, -1, -1), torch.eye(3).double().expand(2, 5, 3, 3), CHAIN.bone_index(),
        None, CHAIN.bone_index(), 1.0, 0.0, body_module.POLISH,
    )  # fmt: skip
    for energy in ([0.0, 0.0], [math.inf, math.inf], [math.nan, 0.0]):
        asked.clear()
        pose = run(body_module._raced(task, torch.tensor(energy).double()), answer)
        assert asked == [2, 1]
        if energy == [0.0, 0.0]:
            assert pose.objective.tolist() == [500.0, 500.0 + behind]


@pytest.mark.parametrize(("turn", "searches"), [(0.0, 1), (120.0, 2)])
def test_gaps_that_are_filled_call_for_another_search_only_where_the_viewpoint_turns(turn, searches, monkeypatch):
    draw = torch.Generator().manual_seed(0)
    clip = walking_person(60, turn=turn, yaw=40.0, missing=0.05, generator=draw)
    asked = []
    monkeypatch.setattr(module, "search", lambda *given: asked.append(given) or search(*given))
    found = PKC(alternatives=0)(clip.tracks)
    assert len(asked) == searches
    hidden = ~clip.tracks.seen
    off = (centred(found.points) - centred(clip.points)).norm(dim=-1)
    assert float(off[hidden].mean()) < 40 and float(found.diagnostics.bone_variation) < 1


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
