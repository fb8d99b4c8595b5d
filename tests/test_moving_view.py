"""PKC's half for viewpoints that turn: from a clip to ranked poses, cameras and uncertainty."""

import dataclasses
import itertools
import sys

import pytest
import torch

import kcs_torch as kt
from kcs_torch import KcsWarning
from kcs_torch.data.synthetic import random_motion, walking_person
from kcs_torch.functional import bone_lengths, complete_rotation, viewpoint_turn
from kcs_torch.methods.base import Estimate
from kcs_torch.methods.pkc import moving_answer
from kcs_torch.methods.pkc.descents import Descent, descend_all
from kcs_torch.methods.pkc.moving_solutions import MovingView
from kcs_torch.methods.pkc.moving_view import moving_view
from kcs_torch.skeleton import Skeleton
from kcs_torch.solvers.procrustean import Pose, Stage, align_rotations


@pytest.fixture(scope="module")
def film():
    """Points (T, N, 3) of a walk seen from half around, centred, rms of the image 1, and its skeleton."""
    clip = walking_person(70, turn=180)
    points = clip.points - clip.points.mean(1, keepdim=True)
    return points / points[..., :2].square().sum(-1).mean().sqrt(), clip


def depth_error(found, points):
    depth = found[..., 2] - found[..., 2].mean(-1, keepdim=True)
    return float(min((depth - s * points[..., 2]).abs().mean() for s in (1, -1)))


def solve(points, skeleton, **options):
    """From a flat start that knows nothing of the cameras."""
    flat = torch.cat([points[..., :2], torch.zeros_like(points[..., :1])], -1)
    still = torch.eye(3, dtype=points.dtype).expand(len(points), 3, 3)
    return moving_view(points[..., :2], skeleton, flat, still, turns=(90.0, 180.0), lifts=4, **options)


def test_finds_depths_and_the_turning_camera_from_a_flat_start(film):
    points, clip = film
    found = solve(points, clip.skeleton, coarse_frames=40, alternatives=2)
    assert found.pose.points.shape[1:] == (70, 17, 3) and len(found.value) == len(found.pose.points) <= 2
    assert depth_error(found.pose.points[0], points) < 0.05 < depth_error(0 * points, points) / 4
    path, kind = found.cameras()
    assert kind == "constant"
    assert float(viewpoint_turn(path[:, :2])) == pytest.approx(180, abs=25)
    deviation = found.deviation(path)
    assert deviation.shape == (70, 17) and bool((deviation > 0).all())


@pytest.mark.parametrize(("agree", "told"), [(0.9, False), (0.75, False), (0.65, True)])
def test_depths_are_as_unsure_as_another_method_finds_others(film, agree, told):
    """What correlates by 1 less a share is off by sqrt(2) of that share of the body's depth."""
    points, clip = film
    depth, zero, bones = points[..., 2], points.new_zeros(1), clip.skeleton.bone_index()
    pose = Pose(points[None], complete_rotation(clip.cameras)[None], zero, zero)
    moving = MovingView(pose, zero, bones, bones, 1.0)
    other = torch.randn(depth.shape, generator=torch.Generator().manual_seed(0), dtype=depth.dtype)
    other = other - other.mean(1, keepdim=True)
    other = other - depth * (other * depth).sum() / depth.square().sum()
    other = agree * depth / depth.norm() + (1 - agree**2) ** 0.5 * other / other.norm()
    seen = torch.cat([points[..., :2], other[..., None]], -1)
    first = Estimate(seen, clip.cameras, torch.ones_like(depth[:, 0]), True, 0)
    found = moving_answer.from_moving(moving, first, clip.skeleton, None, (), alternatives=0)
    own = moving.deviation(moving.cameras()[0])
    lack = 2**0.5 * (1 - agree) * depth.square().mean().sqrt()
    torch.testing.assert_close(found.deviation, torch.hypot(own, lack))
    assert ("hardly agree" in found.doubt) == told


def test_same_seed_same_answer(film):
    points, clip = film
    first, second = (solve(points[:30], clip.skeleton, seed=3).pose.points for _ in range(2))
    assert torch.equal(first, second)


def test_links_that_are_no_tree_are_aligned_in_a_tree_that_is_found(film):
    points, clip = film
    loop = Skeleton.from_edges([*clip.skeleton.bones, (1, 4)], 17, tree=False)
    found = solve(points[:40], loop)
    assert found.bones.shape == (16, 2) and found.rigid.shape == (17, 2)
    assert found.stiffness < 1
    assert found.pose.points.isfinite().all()


def test_noise_frees_the_image(film):
    points, clip = film
    noisy = points[:40].clone()
    noisy[..., :2] += 0.02 * torch.randn(40, 17, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    weights = torch.ones(40, 17, dtype=torch.float64)
    found = solve(noisy, clip.skeleton, noise=0.02, weights=weights).pose.points[0]
    error = lambda x: float(((x - x.mean(1, keepdim=True) - points[:40])[..., :2]).norm(dim=-1).mean())  # noqa: E731
    assert 0 < error(found) < 0.9 * error(noisy)


def turn(axis, angle):
    """Rotations (T, 3, 3) about an axis by angles (T,)."""
    step = torch.zeros(3, 3, dtype=torch.float64)
    step[axis - 2, axis - 1], step[axis - 1, axis - 2] = -1.0, 1.0
    return torch.linalg.matrix_exp(angle.double()[:, None, None] * step)


def test_a_tail_that_swings_keeps_its_length():
    """Links of 15 joints follow each other, but for one that swings by itself, whose path has to be tried alone."""
    time = torch.arange(120, dtype=torch.float64) / 30
    place = lambda rotations, x, y, z: rotations @ torch.tensor([x, y, z], dtype=torch.float64)  # noqa: E731
    trunk = turn(0, 0.1 * (3 * time).sin()) @ turn(1, 0.15 * (3 * time).sin())
    neck = place(trunk, 0, -0.05, -0.7)
    joints = [0 * neck, neck, neck + place(turn(0, 0.4 * (2 * time).sin()), 0, -0.2, -0.2)]  # hip, neck, head
    joints.append(place(turn(1, 0.7 * (4 * time).sin()), 0, -0.15, 0.3))
    bones = [(1, 0), (1, 2), (0, 3)]
    for side in (1, -1):
        for parent in (0, 1):
            wave = 6 * time + torch.pi * (side == 2 * parent - 1)
            shoulder = joints[parent] + torch.tensor([0.12 * side, 0.05, 0.0])
            knee = shoulder + place(turn(0, 0.5 * wave.sin()), 0, 0.25, 0)
            paw = knee + place(turn(0, 0.5 * wave.sin() - 0.4 - 0.4 * wave.cos()), 0, 0.25, 0)
            count = len(joints)
            joints += [shoulder, knee, paw]
            bones += [(parent, count), (count, count + 1), (count + 1, count + 2)]
    seen = turn(0, 0 * time + 0.15) @ turn(1, 0.4 + torch.pi * time / time[-1])
    points = torch.stack(joints, 1) @ seen.mT
    skeleton = Skeleton.from_edges(bones, len(joints))
    found = kt.reconstruct(points[..., :2], skeleton=skeleton).points
    lengths = bone_lengths(found, skeleton.bone_index())
    assert float((lengths.std(0) / lengths.mean(0)).amax()) < 0.01


@pytest.mark.parametrize("frames", [1, 2, 4])
def test_short_clips_stay_finite(film, frames):
    points, clip = film
    found = solve(points[:frames], clip.skeleton)
    path, kind = found.cameras()
    assert kind == "free"
    assert found.pose.points.isfinite().all() and path.isfinite().all()
    assert found.deviation(path).isfinite().all()


def test_needs_no_further_start_where_the_first_is_good(film):
    points, clip = film
    cameras = complete_rotation(clip.cameras)
    found = moving_view(points[..., :2], clip.skeleton, points, cameras, turns=(), lifts=0)
    assert depth_error(found.pose.points[0], points) < 0.05


def test_descents_of_several_clips_together_as_alone(monkeypatch):
    """Padded to one batch, in runs that are not too large and of similar length, each with its own answer."""
    stages = (Stage(1e-2, 4, 1.0, 0.0, 0.1), Stage(1e-3, 4, 0.01, 1.0, 0.03))
    tasks = []
    for i, (frames, count) in enumerate(((12, 2), (15, 1), (12, 3), (24, 1))):
        clip = walking_person(frames, turn=120.0, yaw=30.0 * i)
        points = clip.points - clip.points.mean(1, keepdim=True)
        points = points / points.square().sum(-1).mean().sqrt()
        start = points.repeat(count, 1, 1, 1)
        start[..., 2] *= torch.linspace(0.2, 0.8, count, dtype=torch.float64)[:, None, None]
        bones = clip.tracks.skeleton.bone_index()
        turned = align_rotations(start, torch.eye(3).double().expand(count, frames, 3, 3), bones)
        tasks.append(Descent(points[..., :2], start, turned, bones, None, bones, 1.0, 0.0, stages))
    for most in (8192, 40):
        monkeypatch.setattr(sys.modules[Descent.__module__], "TOGETHER", most)
        for task, found in zip(tasks, descend_all(tasks), strict=True):
            (alone,) = descend_all([task])
            assert found.points.shape == task.points.shape
            torch.testing.assert_close(found.points, alone.points, rtol=0, atol=1e-6)
            torch.testing.assert_close(found.objective, alone.objective, rtol=1e-6, atol=1e-6)


@pytest.fixture(scope="module")
def robot():
    """Points (T, N, 3) of an arm of five bones that turn anyhow, before a camera that turns by 120 degrees."""
    skeleton = Skeleton.from_edges([(i, i + 1) for i in range(5)], 6)
    clip = random_motion(skeleton, num_frames=120, turn=120, generator=torch.Generator().manual_seed(0))
    points = clip.points - clip.points.mean(1, keepdim=True)
    return points / points[..., :2].square().sum(-1).mean().sqrt(), skeleton


def test_few_bones_of_constant_length_are_put_together_from_paths(robot):
    points, skeleton = robot
    exact, loose = (solve(points, skeleton, exact=exact) for exact in (True, False))
    error = depth_error(exact.pose.points[0], points)
    assert error < 0.05 < 0.2 < depth_error(loose.pose.points[0], points)
    lengths = bone_lengths(exact.pose.points[0], skeleton.bone_index())
    assert float((lengths.std(0) / lengths.mean(0)).amax()) < 0.01
    assert exact.lead > 1 and loose.lead == 0


def test_long_clips_are_not_put_together_from_paths(robot, monkeypatch):
    points, skeleton = robot
    module = sys.modules["kcs_torch.methods.pkc.moving_search"]
    monkeypatch.setattr(module, "LONG", 100)
    monkeypatch.setattr(module, "bone_paths", None)  # to call it would fail
    found = solve(points, skeleton)
    assert found.lead == 0 and found.pose.points.isfinite().all()


def test_paths_lead_between_the_frames_that_are_compared(robot):
    points, skeleton = robot
    found = solve(points, skeleton, coarse_frames=40)
    assert depth_error(found.pose.points[0], points) < 0.05


def test_a_viewpoint_that_turns_too_little_is_told(monkeypatch):
    """Along rays as well; depths are less sure then."""
    tracks = walking_person(32, turn=150.0).tracks
    free = dataclasses.replace(tracks.skeleton, name="free", template=None)
    tracks = dataclasses.replace(tracks, skeleton=free)
    sure = kt.reconstruct(tracks)
    assert sure.diagnostics.doubt == ""
    monkeypatch.setattr(moving_answer, "TURN", 170.0)
    with pytest.warns(KcsWarning, match=r"drawn out.* only 1\d\d degrees"):
        unsure = kt.reconstruct(tracks)
    assert unsure.diagnostics.doubt in unsure.diagnostics.notes
    assert torch.equal(unsure.points, sure.points) and bool((unsure.uncertainty > sure.uncertainty).all())
    with pytest.warns(KcsWarning, match="drawn out"):
        along = kt.reconstruct(tracks, intrinsics=(9000.0, 9000.0, *tracks.points.mean((0, 1)).tolist()))
    assert along.diagnostics.doubt and along.distance is not None


def chain(links, seed, turn=90):
    """Tracks (T, N, 2) and depths (T, N) of a short chain, of which nothing but its bones' lengths is known."""
    skeleton = Skeleton.from_edges([(i, i + 1) for i in range(links)], links + 1)
    made = random_motion(skeleton, num_frames=150, turn=turn, generator=torch.Generator().manual_seed(seed))
    points = made.points - made.points.mean(1, keepdim=True)
    return points[..., :2], points[..., 2], skeleton


def relative(result, depth):
    found = result.points[..., 2] - result.points[..., 2].mean(-1, keepdim=True)
    return float(min((found - s * depth).norm() for s in (1, -1)) / depth.norm())


@pytest.mark.parametrize("count", [0, 1, 2, 8])
def test_bodies_that_fit_nearly_as_well_are_among_the_alternatives(count):
    tracks, depth, skeleton = chain(6, 4)
    with pytest.warns(KcsWarning, match="guess"):
        result = kt.reconstruct(tracks, skeleton=skeleton, fps=30, method="pkc", alternatives=count)
    mirror, *others = result.alternatives or (None,)
    assert len(result.alternatives) <= count and (mirror is None) == (count == 0)
    if mirror is not None:
        assert mirror.objective == result.objective
    values = [one.objective for one in (result, *others)]
    assert values == sorted(values)
    shown = [one.points[..., 2] for one in (result, *others)]
    for k, a in enumerate(shown):  # no two are one body, or its mirror image
        assert all(relative(result, depth) > 0 and min((a - s * b).norm() for s in (1, -1)) > 0.01 for b in shown[:k])
    if count == 8:
        assert others and min(relative(one, depth) for one in others) < 0.2 < relative(result, depth)
        assert all(any("nearly as well" in note for note in one.diagnostics.notes) for one in others)


def test_a_solution_that_hardly_leads_is_doubted():
    tracks, depth, skeleton = chain(5, 109)
    with pytest.warns(KcsWarning, match=r"fit the tracks nearly as well \(see the alternatives\)"):
        result = kt.reconstruct(tracks, skeleton=skeleton, fps=30)
    assert len(result.alternatives) > 1 and relative(result, depth) > 0.3


@pytest.mark.parametrize(("noise", "most"), [(0.02, 0.03), (0.0025, 0.005)], ids=["noise", "a little noise"])
def test_noise_of_a_body_without_template_is_told_from_its_motion(noise, most):
    """Taken as exact, smoothed tracks with noise of 2 % of the size make errors of 6.4 %; as they are, .25 % 1.2 %."""
    clip = walking_person(60, turn=180)
    body = Skeleton.from_edges(clip.skeleton.bones, 17)
    size = (clip.tracks.points - clip.tracks.points.mean(1, keepdim=True)).square().sum(-1).mean().sqrt()
    shift = torch.randn(60, 17, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    tracks = dataclasses.replace(clip.tracks, points=clip.tracks.points + noise * size * shift, skeleton=body)
    result = kt.PKC(alternatives=0)(tracks)
    found, mirror = result.points, result.points.new_tensor([1.0, 1.0, -1.0])
    error = min(kt.metrics.mpjpe(one, clip.points, align="rigid") for one in (found, found * mirror))
    assert float(error / size) < most


def test_deviations_of_depth_know_of_noise(protocol, shared):
    """A dog, in noise of 2 % of its size: fewer than half of its depths were as near as they were said to be."""
    case = {"src": "dog/dog_walk01", "orbit": 180, "yaw": 250, "pitch": 10, "max_frames": 120}
    given, truth = protocol.build(shared / "data", case)
    points, true = torch.from_numpy(given["points2d"]), torch.from_numpy(truth["points3d"])
    size = (true - true.mean(1, keepdim=True)).square().sum(-1).mean().sqrt()
    points = points + 0.02 * size * torch.randn(points.shape, generator=torch.Generator().manual_seed(0)).double()
    found = kt.PKC(alternatives=0)(kt.Tracks.from_arrays(points, edges=given["edges"], fps=given["fps"]))
    depth, true = (x[..., 2] - x[..., 2].mean(1, keepdim=True) for x in (found.points, true))
    off = min(((depth - s * true).abs() for s in (1, -1)), key=torch.mean)
    assert 0.5 < float((off <= found.uncertainty).double().mean()) < 0.85


def test_a_guessed_template_does_not_outvote_the_turn(protocol, shared):
    """A dog that runs before a viewpoint that turns by 70 degrees, whose template is a guess by names."""
    data = protocol.load(shared / "data", "dog/dog_run00")
    points = torch.from_numpy(data["points3d"]).double()[::2][60:113] * torch.tensor([-1.0, 1, 1])
    turns = torch.from_numpy(protocol.rotation(protocol.np.linspace(0, 70, len(points)), 10.0)).double()
    truth = points @ turns.mT
    names, bones = data["joint_names"].tolist(), data["edges"].tolist()
    tracks = kt.Tracks.from_arrays(truth[..., :2], edges=bones, joint_names=names, fps=30.0, units="mm")
    assert tracks.skeleton.template is not None
    found = kt.PKC(alternatives=0)(tracks)
    size = (truth - truth.mean(1, keepdim=True)).square().sum(-1).mean().sqrt()
    assert float(kt.metrics.mpjpe(found.points, truth, align="rigid") / size) < 0.05


def test_gaps_of_a_body_without_template_are_filled_in_space():
    clip = walking_person(60, turn=180)
    body = Skeleton.from_edges(clip.skeleton.bones, 17)
    hidden = torch.rand(12, 17, generator=torch.Generator().manual_seed(0)).repeat_interleave(5, 0) < 0.15
    tracks = dataclasses.replace(clip.tracks, weights=(~hidden).double(), skeleton=body)
    errors = []
    for rounds in (0, 1):  # 0 leaves them as each joint's own path has them
        found = kt.PKC(alternatives=0, rounds=rounds)(tracks).points
        mirror = found.new_tensor([1.0, 1.0, -1.0])
        errors.append(min(kt.metrics.mpjpe(one, clip.points, align="rigid") for one in (found, found * mirror)))
    assert errors[1] < 0.7 * errors[0]


def legs(count):
    """A body of so many legs of three bones each, of which nothing but the bones is known."""
    joints, bones = ["front", "back", "head"], [("front", "back"), ("front", "head")]
    for leg in range(count):
        chain = ["front" if 2 * leg < count else "back", *(f"{part}_{leg}" for part in ("coxa", "knee", "foot"))]
        joints += chain[1:]
        bones += itertools.pairwise(chain)
    return Skeleton.from_names(joints, bones)


CHAIN = Skeleton.from_names([f"s{i}" for i in range(10)], [(f"s{i}", f"s{i + 1}") for i in range(9)])


@pytest.mark.parametrize(
    ("body", "seed", "swing", "hidden"),
    [(legs(6), 61, 20.0, slice(None)), (CHAIN, 1, 15.0, slice(None)), (CHAIN, 3, 15.0, slice(-2, None))],
)
def test_gaps_of_exact_tracks_bend_nothing_else(body, seed, swing, hidden):
    """Held where its own path fills a gap, each joint would pull the others along."""
    clip = random_motion(body, 80, turn=360.0, swing=swing, generator=torch.Generator().manual_seed(seed))
    points = clip.tracks.points.clone()
    points[30:45, hidden] = torch.nan
    found = kt.PKC(alternatives=0)(kt.Tracks.from_arrays(points, skeleton=body, fps=30.0)).points
    mirror = found.new_tensor([1.0, 1.0, -1.0])
    off = min(kt.metrics.mpjpe(one, clip.points, align="rigid") for one in (found, found * mirror))
    assert off < 0.02 * (clip.points - clip.points.mean(1, keepdim=True)).norm(dim=-1).mean()


def test_a_robot_that_two_searches_see_otherwise_is_doubted(protocol, shared):
    """Half a second shows nothing of it: SfAM follows where it is wrong, and bones that are held lead it there."""
    data = protocol.load(shared / "data", "robot/franka_panda_fk")
    turns = protocol.rotation(45.0 + protocol.np.linspace(0, 180, 80), 10.0)
    points = torch.from_numpy(data["points3d"][:80]).double() @ torch.from_numpy(turns).double().mT
    points[30:45] = torch.nan
    tracks = kt.Tracks.from_arrays(points[..., :2], edges=data["edges"].tolist(), fps=float(data["fps"]), units="mm")
    with pytest.warns(KcsWarning, match="depth is"):
        assert kt.PKC(alternatives=0)(tracks).diagnostics.doubt
