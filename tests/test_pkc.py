"""PKC end to end: walks before fixed and turning cameras, what is told of them, options, and several clips at once."""

import math
from dataclasses import asdict, replace

import pytest
import torch
from numerics import count_operations, normal
from pkc_walks import FLIP, NAN, QUICK, centred, error, robot
from torch.testing import assert_close

from kcs_torch import PKC, ConvergenceWarning, KcsWarning, OptionError, SfAM, Skeleton, Tracks, reconstruct
from kcs_torch.data import random_motion, walking_person
from kcs_torch.functional import bone_vectors, chain_inverse, incidence, points_from_bones
from kcs_torch.methods.answer.root import standing_feet
from kcs_torch.methods.pkc.body import Body
from kcs_torch.methods.pkc.clip import LEAST_FRAMES
from kcs_torch.methods.pkc.hypotheses import Hypotheses
from kcs_torch.metrics import e3d

# Many tests take few steps, after which nothing has settled.
pytestmark = pytest.mark.filterwarnings("ignore::kcs_torch.ConvergenceWarning")


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
        assert result.uncertainty.mean() < 0.05 * size
    assert 0.5 < sum(once) / len(once) < 0.97, once
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


@pytest.mark.parametrize("frames", [1, LEAST_FRAMES - 1])
def test_too_few_frames_leave_no_choice(frames):
    clip = walking_person(frames)
    moving, fixed = (PKC(viewpoint=v, rounds=0, steps=5)(clip.tracks) for v in ("moving", "fixed"))
    assert torch.equal(moving.points, fixed.points)


# ---------------------------------------------------------------------- bodies


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
