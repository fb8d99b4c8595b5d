"""KCS: what its shape step must give in closed form, its options, and real walks."""

import math
from dataclasses import replace

import pytest
import torch
from animal_samples import four_legged
from torch.testing import assert_close

from kcs_torch import KCS, ShapeError, Skeleton, SkeletonError, Tracks
from kcs_torch.data import random_motion, walking_person
from kcs_torch.functional import (
    back_project,
    bone_lengths,
    bone_vectors,
    complete_rotation,
    nuclear_norm,
    procrustes,
    project,
    superpose,
)
from kcs_torch.methods.answer.mirror import mirror_sign

NAN = math.nan
CLIP = walking_person(40, turn=60.0)
TRACKS, BODY = CLIP.tracks, CLIP.tracks.skeleton
PRINTED = {"scale_range": math.inf, "robust": None, "continuity": 0.0}


def centred(points):
    return points - points.mean(-2, keepdim=True)


def rigid_error(found, truth):
    """Mean distance after a rotation of each frame, the better of the result and its mirror image."""
    mirrors = (found, found * torch.tensor([1.0, 1.0, -1.0]).to(found))
    return min(float((superpose(m, truth, "rigid") - truth).norm(dim=-1).mean()) for m in mirrors)


def flat(points):
    return points * torch.tensor([1.0, 1.0, 0.0]).to(points)


# ---------------------------------------------------------------------- the shape step


@pytest.mark.parametrize("options", [{}, PRINTED])
def test_stacked_deviation_is_the_back_projected_residual(options):
    """In the printed 3T x B arrangement the least nuclear norm leaves depth to the template.

    Rotating each frame's three rows into its camera changes no singular value; two of them are then given by the
    tracks, and the third, the depth of the deviation, only adds. So A = R^T (W / s - R B0).
    """
    result = KCS(num_weights=12, steps_per_weight=40, **options)(TRACKS)
    rotation = complete_rotation(result.cameras)
    template = centred(BODY.template_points(dtype=torch.float64)) @ rotation.mT  # in each frame's camera
    points = centred(result.points)
    factor = (points[..., 2] * template[..., 2]).sum() / template[..., 2].square().sum()
    assert factor > 0
    assert_close(points[..., 2], factor * template[..., 2], rtol=0, atol=1e-6 * float(points.std()))
    scaled = result.scales[:, None, None] * points[..., :2]
    assert_close(scaled, centred(TRACKS.points), rtol=0, atol=1e-6 * float(points.std()))
    assert result.diagnostics.reprojection_rms < 1e-3


def test_no_other_depth_has_a_smaller_nuclear_norm():
    """The closed form above, checked against deviations that project equally."""
    bones = BODY.bone_index()
    rest = bone_vectors(centred(BODY.template_points(dtype=torch.float64)), bones)
    goal = bone_vectors(TRACKS.points / 1000, bones)
    least = back_project(goal - project(rest.expand(40, -1, -1), CLIP.cameras), CLIP.cameras)
    stacked = lambda a: a.mT.flatten(0, 1)  # noqa: E731
    viewing = complete_rotation(CLIP.cameras)[:, 2:]  # (T, 1, 3)
    for seed in range(10):
        depth = torch.randn(40, len(bones), 1, generator=torch.Generator().manual_seed(seed)).double()
        for size in (1e-3, 0.1, 10.0):
            other = least + size * depth * viewing
            assert_close(project(other, CLIP.cameras), project(least, CLIP.cameras))
            assert nuclear_norm(stacked(other)) > nuclear_norm(stacked(least))


@pytest.mark.filterwarnings("ignore::kcs_torch.errors.ConvergenceWarning")
def test_a_rigid_body_with_its_own_template_is_found_exactly():
    """The deviation is nothing but rounding, whose own share of change settles or not by chance."""
    shape = centred(torch.randn(17, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64))
    turned = 250 * shape @ complete_rotation(CLIP.cameras).mT
    body = Skeleton.from_edges(BODY.bones, 17)
    tracks = Tracks.from_arrays(turned[..., :2], skeleton=body)
    for arrangement in ("stacked", "frames"):
        result = KCS(template=shape.tolist(), arrangement=arrangement, **PRINTED)(tracks)
        assert_close(centred(result.points), turned, rtol=0, atol=1e-3 * float(turned.std()))
        assert_close(result.scales, torch.ones_like(result.scales), rtol=0, atol=1e-4)
        assert result.diagnostics.bone_variation < 0.1
        assert result.diagnostics.viewpoint_turn == pytest.approx(60, abs=2)


def test_a_flat_rigid_body_settles():
    """Its images have two cameras each, mirror images that explain them equally; in each round rounding chooses."""
    body = Skeleton.from_edges(BODY.bones, 17)
    cameras = walking_person(26, turn=280.0).cameras
    for seed in range(24):
        shape = torch.randn(17, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        shape = centred(shape * torch.tensor([1.0, 1.0, 0.0]))
        turned = shape @ complete_rotation(cameras).mT
        result = KCS(template=shape.tolist())(Tracks.from_arrays(turned[..., :2], skeleton=body))
        assert result.diagnostics.converged  # a warning would be an error, too
        assert rigid_error(centred(result.points), turned) < 1e-6


def test_a_deviation_that_recurs_gains_depth_in_frames():
    clip = walking_person(100, turn=90.0)
    error = {a: rigid_error(KCS(arrangement=a)(clip.tracks).points, clip.points) for a in ("stacked", "frames")}
    assert error["frames"] < 0.6 * error["stacked"] < 0.6 * rigid_error(flat(clip.points), clip.points)


@pytest.mark.parametrize("turn", [0.0, 90.0])
def test_better_than_flat_without_a_turn_and_with_one(turn):
    clip = walking_person(60, turn=turn)
    result = KCS()(clip.tracks)
    assert rigid_error(result.points, clip.points) < 0.7 * rigid_error(flat(clip.points), clip.points)


def test_bone_steps_make_lengths_constant_and_leave_the_image():
    plain, steady = (KCS(arrangement="frames", bone_steps=k)(TRACKS) for k in (0, 20))
    assert steady.diagnostics.bone_variation < 0.6 * plain.diagnostics.bone_variation
    assert steady.diagnostics.reprojection_rms < 2 * plain.diagnostics.reprojection_rms + 1e-6
    assert_close(steady.cameras, plain.cameras, rtol=0, atol=0)


def test_bone_steps_move_unseen_joints_in_the_image_only():
    points = TRACKS.points.clone()
    points[10:20, 6] = NAN
    tracks = Tracks.from_arrays(points, skeleton=BODY)
    plain, steady = (KCS(bone_steps=k)(tracks) for k in (0, 20))
    moved = (centred(steady.points)[..., :2] - centred(plain.points)[..., :2]).norm(dim=-1)
    assert moved[10:20, 6].max() > 10 * moved[20:, 6].max()


# ---------------------------------------------------------------------- template


@pytest.mark.parametrize("kind", [list, torch.Tensor.numpy, torch.Tensor.clone])
def test_template_given_is_as_good_as_the_skeletons(kind):
    """Its unit and its place do not matter."""
    rest = BODY.template_points(dtype=torch.float64)
    given = 1000 * rest + torch.tensor([5.0, -7.0, 9.0])
    template = given.tolist() if kind is list else kind(given)
    result = KCS(template=template)(TRACKS)
    assert_close(result.points, KCS()(TRACKS).points, rtol=0, atol=1e-3)


def test_a_rough_template_will_do_and_a_wrong_one_will_not():
    rest = BODY.template_points(dtype=torch.float64)
    noise = torch.randn(17, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    plain = rigid_error(KCS()(TRACKS).points, CLIP.points)
    rough = rigid_error(KCS(template=rest + 0.02 * rest.std() * noise)(TRACKS).points, CLIP.points)
    assert rough < 1.3 * plain
    wrong = rest * torch.tensor([1.0, 1.0, 0.0]) + noise * torch.tensor([0.0, 0.0, 0.5]) * rest.std()
    assert rigid_error(KCS(template=wrong)(TRACKS).points, CLIP.points) > 2 * plain


@pytest.mark.parametrize(
    ("template", "words"),
    [
        ([[0.0, 0.0, 0.0]] * 16, "expected 17 finite positions (x, y, z), got shape (16, 3)"),
        ([[0.0, 0.0]] * 17, "got shape (17, 2)"),
        ([[0.0, 0.0, math.inf]] * 17, "17 finite positions"),
        ([[0.0, 1.0], [2.0]], "expected an array of numbers"),
    ],
)
def test_bad_templates(template, words):
    with pytest.raises(ShapeError) as caught:
        KCS(template=template)(TRACKS)
    assert str(caught.value).startswith("kcs: template") and words in str(caught.value)


def test_a_guessed_template_of_an_animal_gives_way_to_the_tracks_own_shape():
    """Where the viewpoint turns; one that somebody gave stays, and so does the guess before a camera at rest."""
    guess = four_legged()
    given = replace(guess, template=tuple((x, y, 1.2 * z) for x, y, z in guess.template))
    for body, turn, expected in ((guess, 120.0, True), (given, 120.0, False), (guess, 0.0, False)):
        clip = random_motion(body, 60, turn=turn, yaw=60.0, swing=8.0, generator=torch.Generator().manual_seed(0))
        result = KCS()(clip.tracks)
        assert any("not a template of any animal" in note for note in result.diagnostics.notes) == expected


def test_without_a_template_the_rigid_shape_serves():
    clip = walking_person(60, turn=120.0)
    body = Skeleton.from_edges(BODY.bones, 17)
    result = KCS()(Tracks.from_arrays(clip.tracks.points, skeleton=body))
    assert "has no template: the tracks' best rigid shape serves" in result.diagnostics.notes[0]
    assert rigid_error(result.points, clip.points) < 0.7 * rigid_error(flat(clip.points), clip.points)


# ---------------------------------------------------------------------- chains


def test_links_hold_two_hands_together():
    """The hands of this walker keep no distance; told that they do, KCS gives them one."""
    hands = ("left_wrist", "right_wrist")
    link = torch.tensor([[BODY.index(h) for h in hands]])
    spread = []
    for links in ((), (hands,)):
        result = KCS(links=links, bone_steps=30)(TRACKS)
        size = bone_lengths(result.points, link)
        spread.append(float(size.std() / size.mean()))
        assert result.lengths.shape == (BODY.num_bones,) and result.diagnostics.reprojection_rms < 0.1
    assert spread[1] < 0.5 * spread[0]


def test_links_of_unknown_or_doubled_joints():
    with pytest.raises(SkeletonError, match="unknown joint of skeleton 'h36m17' 'left_hand'"):
        KCS(links=(("left_hand", "right_wrist"),))(TRACKS)
    with pytest.raises(SkeletonError, match="given twice"):
        KCS(links=(("left_elbow", "left_wrist"),))(TRACKS)


@pytest.mark.parametrize("edges", [[], [(0, 1), (1, 2), (2, 0)], [(0, 1), (2, 3)]])
def test_any_graph_reprojects(edges):
    clip = random_motion("h36m17", 30, turn=90.0, generator=torch.Generator().manual_seed(2))
    body = Skeleton.from_edges(edges, 5, tree=False)
    result = KCS()(Tracks.from_arrays(clip.tracks.points[:, :5], skeleton=body))
    assert result.diagnostics.reprojection_rms < 0.1


# ---------------------------------------------------------------------- cameras


def test_turned_template_is_seen_by_the_cameras_that_turned_it():
    """The template itself, filmed: cameras come out as they were, up to the world's own turn."""
    rest = centred(BODY.template_points(dtype=torch.float64))
    seen = 400 * rest @ CLIP.cameras.mT
    result = KCS()(Tracks.from_arrays(seen, skeleton=BODY))
    assert_close(result.cameras, CLIP.cameras, rtol=0, atol=0.02)
    assert result.diagnostics.viewpoint_turn == pytest.approx(60, abs=2)


def test_continuity_prefers_cameras_that_do_not_jump():
    generator = torch.Generator().manual_seed(0)
    noisy = Tracks.from_arrays(TRACKS.points + 60 * torch.randn(40, 17, 2, generator=generator), skeleton=BODY)

    def roughness(continuity):
        rotation = complete_rotation(KCS(continuity=continuity, rounds=1)(noisy).cameras)
        return float((rotation[1:] - rotation[:-1]).square().sum())

    with pytest.warns(UserWarning, match="did not settle"):
        assert roughness(5.0) <= roughness(0.0)


def test_scale_range_bounds_each_frames_scale():
    for bound in (1.0, 1.05):
        scales = KCS(scale_range=bound)(TRACKS).scales
        assert scales.max() / scales.min() <= bound**2 + 1e-9


@pytest.mark.parametrize("scale_range", [1.1, math.inf])
def test_frames_that_tell_no_scale_take_their_neighbours(scale_range):
    weights = TRACKS.weights.clone()
    weights[8:36] = 0
    weights[20, 3] = 1  # alone
    result = KCS(scale_range=scale_range)(replace(TRACKS, weights=weights))
    assert result.scales[8:36].sub(1).abs().max() < 0.05
    assert float(result.lengths.sum()) == pytest.approx(float(KCS()(TRACKS).lengths.sum()), rel=0.05)


# ---------------------------------------------------------------------- real walks


def test_static_walk(protocol, shared):
    case = next(c for c in protocol.suites()["static_walk"] if c["yaw"] == 90)
    given, truth = protocol.build(shared / "data", case)
    tracks = Tracks.from_arrays(given["points2d"], edges=given["edges"], joint_names=given["joint_names"])
    guess = flat(torch.nn.functional.pad(tracks.points, (0, 1)))
    error, guess_error = (
        protocol.score(p[:, : len(given["joint_names"])].numpy(), truth["points3d"], truth["edges"])["rigid"]
        for p in (KCS()(tracks).points, guess)
    )
    assert error < 50 and error < 0.5 * guess_error


@pytest.mark.parametrize("turn", [0.0, 90.0])
def test_known_cameras_tell_where_the_template_stands(turn):
    """Known cameras give the template its place in their world; the pose is no worse than with own cameras."""
    clip = walking_person(60, turn=turn)
    own, known = (KCS()(clip.tracks, c) for c in (None, clip.cameras))
    assert_close(known.cameras, clip.cameras, rtol=0, atol=0)
    assert rigid_error(known.points, clip.points) < 1.1 * rigid_error(own.points, clip.points)
    if turn:
        rotation, _ = procrustes(centred(known.points[30]), centred(clip.points[30]))
        assert (rotation.trace() - 1) / 2 > math.cos(math.radians(12))  # and it faces the right way


@pytest.mark.filterwarnings("ignore::kcs_torch.KcsWarning")
def test_without_a_template_hinges_tell_the_mirror_image():
    clip = random_motion(BODY, 24, turn=120.0, generator=torch.Generator().manual_seed(0)).tracks
    body = replace(BODY, template=None, spread=None)
    for side in (1.0, -1.0):
        found = KCS()(replace(clip, skeleton=body, points=clip.points * torch.tensor([side, 1.0]).to(clip.points)))
        assert float(mirror_sign(centred(found.points), body)) == 1.0
        image = project(centred(found.points) @ complete_rotation(found.cameras), found.cameras)
        assert_close(image, centred(found.points)[..., :2])


@pytest.mark.filterwarnings("ignore::kcs_torch.ConvergenceWarning")
def test_several_clips_at_once():
    """Cameras are fitted together, over clips of different lengths and skeletons; all give what each gives alone."""
    clips = [
        walking_person(n, skeleton=k, yaw=30.0 * n).tracks for n, k in ((20, "coco17"), (9, "body25"), (31, "coco17"))
    ]
    method = KCS(num_weights=3, steps_per_weight=5)
    for one, other in zip(method.many(clips), map(method, clips), strict=True):
        assert_close(one.points, other.points, rtol=1e-6, atol=1e-3)
        assert_close(one.cameras, other.cameras, rtol=0, atol=1e-6)
        assert one.diagnostics.iterations == other.diagnostics.iterations
