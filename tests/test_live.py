"""The live mode: one frame at a time, causal, of bounded memory, and near the offline method."""

import math
import threading
import time
from concurrent.futures import Future
from dataclasses import replace

import numpy as np
import pytest
import torch

import kcs_torch as kt
from kcs_torch.data import walking_person
from kcs_torch.functional.align import superpose
from kcs_torch.functional.chain import bone_lengths
from kcs_torch.live import tracker as live
from kcs_torch.live.filter import BodyFilter
from kcs_torch.types import Intrinsics

FRAMES = 120


@pytest.fixture(scope="module")
def clip():
    return walking_person(
        FRAMES, skeleton="coco17", yaw=60, turn=0, noise=3, generator=torch.Generator().manual_seed(1)
    )


def observed(clip):
    """(T, 17, 2), NaN where unseen."""
    count = clip.tracks.skeleton.num_observed
    return torch.where(clip.tracks.seen[..., None], clip.tracks.points, torch.nan)[:, :count]


def follow(tracker, frames, confidence=None):
    return [tracker.update(xy, None if confidence is None else confidence[t]) for t, xy in enumerate(frames)]


@pytest.fixture(scope="module")
def poses(clip):
    tracker = kt.Tracker("coco17", fps=30, units="mm")
    return tracker, follow(tracker, observed(clip))


def error(points, truth):
    """Mean distance after one rotation per frame, in mm, of the better of the two mirror images."""
    flips = (points, points * torch.tensor([1.0, 1.0, -1.0]).to(points))
    return min(float((superpose(p, truth, "rigid") - truth).norm(dim=-1).mean()) for p in flips)


def test_near_the_offline_method(clip, poses):
    _, found = poses
    ready = [p.frame for p in found if p.ready]
    points = torch.stack([p.points for p in found])[ready]
    truth = clip.points[ready]
    flat = torch.cat([truth[..., :2], torch.zeros_like(truth[..., :1])], -1)
    offline = error(kt.reconstruct(clip.tracks, method="pkc", viewpoint="fixed").points[ready], truth)
    live = error(points, truth)
    assert offline < live < 25.0  # mm: it is polished offline, and not from frame to frame (7.9 and 22.6)
    assert live < 0.5 * error(flat, truth)


def test_what_a_pose_says(clip, poses):
    _, found = poses
    assert [p.frame for p in found] == list(range(FRAMES))
    ready = [p.ready for p in found]
    assert not ready[0] and ready[-1] and ready == sorted(ready)
    assert all((p.delay >= 0) == p.ready for p in found)
    last = found[-1]
    assert last.points.shape == (19, 3) and last.uncertainty.shape == last.seen.shape == (19,)
    assert bool(last.seen.all()) and bool((last.uncertainty > 0).all())
    assert abs(float(last.points[:, 2].mean())) < 1e-6
    off = (last.points[:, :2] - clip.tracks.points[-1]).norm(dim=-1)
    assert float(off.median()) < 10 and float(off.max()) < 80  # mm


def test_bones_keep_their_length(poses):
    tracker, found = poses
    since = next(p.frame for p in found if p.ready and p.delay >= 15)
    until = next((p.frame for p in found if p.frame > since and p.delay < found[p.frame - 1].delay), FRAMES)
    rigid = tracker.skeleton.bone_index()[list(tracker.skeleton.rigid)]
    lengths = bone_lengths(torch.stack([p.points for p in found[since:until]]), rigid)
    size = lengths.mean(1, keepdim=True)  # the body's, in the image
    assert float((size / size.mean() - 1).abs().max()) < 0.02
    assert float(((lengths / size).std(0) / (lengths / size).mean(0)).max()) < 1e-9


def seen_from_afar(depth, yaw):
    """(T, 17, 2) in px of a walk at a depth (T,), in mm."""
    points = walking_person(len(depth), skeleton="coco17", yaw=yaw, turn=0).points
    points = points - points.mean(1, keepdim=True)
    return 1000 * points[:, :17, :2] / (points[:, :17, 2:] + depth[:, None, None])


@pytest.mark.parametrize("depth", [torch.linspace(6000, 3000, 150), torch.linspace(3500, 6500, 150)])
def test_a_body_that_comes_nearer_or_goes_away_keeps_to_the_image(depth):
    image = seen_from_afar(depth.double(), 30)
    with kt.Tracker("coco17", fps=30, period=1000) as tracker:
        points = torch.stack([p.points for p in follow(tracker, image)])[:, :17, :2]
    height = image[..., 1].amax(1) - image[..., 1].amin(1)
    off = (points - image).norm(dim=-1).amax(1) / height
    assert height[40] / height[-1] > 1.3 or height[-1] / height[40] > 1.3
    assert float(off[40:].max()) < 0.05


def test_a_body_without_a_template_grows_with_the_image():
    body = replace(kt.SKELETONS["coco17"], template=None, spread=None, proportions=None)
    clip = walking_person(110, skeleton="coco17", turn=300)
    scale = torch.cat([torch.ones(60), torch.linspace(1, 1.5, 50)])[:, None, None].double()
    image = scale * (clip.tracks.points - clip.tracks.points.mean(1, keepdim=True))[:, :17]
    with kt.Tracker(body, fps=30, window=24, period=1000, method=kt.METHODS["pkc"](lifts=1)) as tracker:
        found = follow(tracker, image)
    lengths = bone_lengths(torch.stack([p.points for p in found]), tracker.skeleton.bone_index()[:12]).mean(1)
    assert found[55].ready and 1.35 < float(lengths[109] / lengths[59]) < 1.65


def test_what_is_off_in_the_image_is_doubted(clip):
    frames = observed(clip)[:61].clone()
    frames[60] *= 1.18
    found = follow(kt.Tracker("coco17", fps=30), frames)[60]
    off = (found.points[:17, :2] - frames[60]).norm(dim=-1)
    assert float(off.max()) > 50 and bool((found.uncertainty[:17] >= off).all())


def test_deviations_are_true_of_a_hand_too():
    """Of three, as of one the rounding of a machine may choose another solution."""
    hand, covered = kt.SKELETONS["hand21"], []
    for seed in (0, 4, 5):
        clip = kt.data.random_motion(hand, 120, fps=30, turn=0, generator=torch.Generator().manual_seed(seed))
        with kt.Tracker(hand, fps=30) as tracker:
            found = [p for p in follow(tracker, clip.tracks.points) if p.ready]
        points, spread = (torch.stack([getattr(p, name) for p in found]) for name in ("points", "uncertainty"))
        covered.append(float(kt.metrics.coverage(points, spread, clip.points[found[0].frame :])))
    assert 0.35 < sum(covered) / 3 < 0.9


def test_the_same_frames_give_the_same_poses_and_later_ones_change_nothing(clip, poses):
    again = follow(kt.Tracker("coco17", fps=30), observed(clip)[:60])
    for a, b in zip(again, poses[1], strict=False):
        assert torch.equal(a.points, b.points) and torch.equal(a.uncertainty, b.uncertainty)


def test_memory_is_bounded_by_the_window(clip):
    tracker = kt.Tracker("coco17", fps=30, window=20, period=10_000)
    sizes = []
    for t, xy in enumerate(torch.cat([observed(clip)] * 2)):
        tracker.update(xy)
        if t % 60 == 59:
            state = [v for v in vars(tracker).values() if hasattr(v, "maxlen")]
            sizes.append([len(v) for v in state])
            assert all(len(v) <= 20 for v in state) and len(state) == 4
    assert sizes[0] == sizes[-1]
    assert tracker.tracks().num_frames == 20


@pytest.mark.filterwarnings("ignore::kcs_torch.ConvergenceWarning")
def test_result_is_the_window(clip):
    tracker = kt.Tracker("coco17", fps=30, window=20, units="mm", method=kt.METHODS["pkc"](viewpoint="fixed", steps=3))
    frames = observed(clip)[:30]
    follow(tracker, frames)
    result = tracker.result()
    assert result.points.shape == (20, 19, 3) and result.units == "mm" and result.fps == 30
    assert torch.equal(result.tracks.points[:, :17], frames[10:].double())


def test_unseen_joints_are_held_and_doubted(clip, poses):
    frames = observed(clip)[:70].clone()
    frames[50:, 9] = torch.nan  # the left wrist
    found = follow(kt.Tracker("coco17", fps=30), frames)
    assert all(bool(torch.isfinite(p.points).all()) for p in found)
    assert bool(found[49].seen[9]) and not bool(found[50].seen[9])
    more = [float(found[t].uncertainty[9] / poses[1][t].uncertainty[9]) for t in (49, 52, 69)]
    assert more[0] == 1 and 1 < more[1] < more[2]
    near = (found[52].points[9, :2] - clip.tracks.points[52, 9]).norm()
    assert float(near) < 150  # mm; the arm is 600 long


def test_frames_without_the_person(clip):
    frames = observed(clip)[:80].clone()
    frames[:5] = torch.nan
    frames[50:60] = torch.nan
    found = follow(kt.Tracker("coco17", fps=30), frames)
    assert all(bool(torch.isnan(p.points).all()) and bool(p.uncertainty.isinf().all()) for p in found[:5])
    assert all(bool(torch.isfinite(p.points).all()) for p in found[5:])
    assert torch.allclose(found[50].points[:, :2], found[59].points[:, :2])
    assert not bool(found[55].seen.any()) and bool(found[60].seen.all())
    assert error(torch.stack([p.points for p in found[62:]]), clip.points[62:80]) < 60


def test_starts_anew_after_a_window_without_the_person(clip):
    tracker = kt.Tracker("coco17", fps=30, window=20)
    frames = torch.cat([observed(clip)[:40], torch.full((20, 17, 2), torch.nan), observed(clip)[:3]])
    found = follow(tracker, frames)
    assert found[39].ready and not found[-1].ready
    assert tracker.tracks().num_frames == 3


def test_zeros_are_unseen_where_the_body_is_to_their_right_and_below(clip):
    lost = observed(clip)[:40] + 3000
    lost[:5], lost[20:25], lost[10:, 9] = torch.nan, torch.nan, torch.nan
    nans = follow(kt.Tracker("coco17", fps=30), lost)
    for place in (0.0, -1.0):
        found = follow(kt.Tracker("coco17", fps=30), lost.nan_to_num(place))
        assert all(torch.equal(p.seen, q.seen) for p, q in zip(found, nans, strict=True))
        assert all(torch.allclose(p.points, q.points, equal_nan=True) for p, q in zip(found, nans, strict=True))
    frame = lost[30].nan_to_num(0.0)
    assert bool(kt.Tracker("coco17").update(frame, torch.ones(17)).seen.all())  # confidences say what is unseen
    assert bool(kt.Tracker("coco17").update(frame - frame[0]).seen.all())  # the nose is the origin


def test_low_confidence_is_unseen(clip):
    frame = observed(clip)[0].clone()
    sure = torch.ones(17)
    sure[4] = 0.1
    frame[4] = 1e6
    pose = kt.Tracker("coco17", fps=30).update(frame, sure)
    assert not bool(pose.seen[4]) and float(pose.points.abs().max()) < 1e5


HALF = (torch.float16, torch.bfloat16)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, *HALF, np.float16, np.float32, ">f4", np.float64, int])
def test_dtype_follows_the_input(clip, dtype):
    frame = observed(clip)[0]
    frame = frame.to(dtype) if isinstance(dtype, torch.dtype) else frame.numpy().astype(dtype)
    pose = kt.Tracker("coco17", fps=30).update(frame)
    expected = torch.float64 if dtype in (torch.float64, np.float64, int) else torch.float32
    assert pose.points.dtype == pose.uncertainty.dtype == expected


def test_arrays_do_as_well(clip):
    frame = observed(clip)[0]
    a, b = (kt.Tracker("coco17", fps=30).update(x) for x in (frame, frame.numpy()))
    assert torch.equal(a.points, b.points)


def test_the_image_may_be_of_any_size_and_place(clip):
    frames = observed(clip)[:45]
    a, b = (
        torch.stack([pose.points for pose in follow(kt.Tracker("coco17", fps=30), given)])
        for given in (frames, 0.01 * frames + 500)
    )
    off = (100 * (b - torch.tensor([500.0, 500, 0])) - a).abs().amax(-1)
    assert off.median() < 0.1 and (off < 5).double().mean() > 0.97  # whose sign is a toss-up, rounding tells


def test_shares_of_an_image_of_known_size_are_its_pixels(clip):
    frames = 0.2 * observed(clip)[:30] + 500
    size = torch.tensor([1920.0, 1080.0], dtype=frames.dtype)
    a, b = (
        follow(kt.Tracker("coco17", fps=30, image_size=(1920, 1080)), given)[0].points
        for given in (frames, frames / size)
    )
    torch.testing.assert_close(a, b)


def test_without_a_template():
    body = replace(kt.SKELETONS["coco17"], template=None, spread=None, proportions=None)
    clip = walking_person(60, skeleton="coco17", turn=200)
    tracker = kt.Tracker(body, fps=30, window=24, method=kt.METHODS["pkc"](lifts=1))
    found = follow(tracker, observed(clip))
    ready = [p.ready for p in found]
    assert not any(ready[:47]) and all(ready[48:])
    assert all(bool(torch.isfinite(p.points).all()) for p in found)
    lengths = bone_lengths(torch.stack([p.points for p in found[48:]]), tracker.skeleton.bone_index()[:12])
    assert float((lengths.std(0) / lengths.mean(0)).max()) < 1e-9


def test_poses_wait_for_the_solve_and_no_longer(clip):
    found = follow(kt.Tracker("coco17", fps=30, window=36), observed(clip)[:60])
    first = next(p.frame for p in found if p.ready)
    assert first == 11 + 4 + 1  # 12 frames, solved while a third as many come
    assert [p.delay for p in found[first : first + 3]] == [5, 6, 7]
    assert found[35 + 12 + 1].delay == 13


def test_never_waits_if_so_told(clip):
    tracker = kt.Tracker("coco17", fps=30, window=36, wait=False)
    for xy in observed(clip)[:16]:
        tracker.update(xy)
    frames = 0
    while not tracker.update(observed(clip)[16 + frames % 60]).ready and frames < 3000:
        frames += 1
        time.sleep(0.01)
    assert 0 <= frames < 3000


class AtOnce:
    """An executor that is done when it is asked."""

    def submit(self, call, *args):
        future = Future()
        future.set_result(call(*args))
        return future


def test_what_a_solve_finds_is_taken_over_a_few_frames_at_a_time_if_no_update_may_wait(clip, monkeypatch):
    found, steps = [], []
    step = BodyFilter.step
    monkeypatch.setattr(BodyFilter, "step", lambda *args: steps.append(None) or step(*args))
    for wait in (True, False):
        tracker = kt.Tracker("coco17", fps=30, window=24, period=1000, wait=wait)
        monkeypatch.setattr(tracker, "_thread", AtOnce())
        counts = []
        for xy in observed(clip)[:48]:
            steps.clear()
            pose = tracker.update(xy)
            counts.append(len(steps))
        found.append(pose.points)
        assert max(counts) <= 1 + live.AT_ONCE if not wait else max(counts) > live.REPLAYED
    assert torch.equal(*found)  # the same frames have been taken in the end


def test_bodies_that_show_nothing(clip):
    still = observed(clip)[:1].expand(45, -1, -1)
    line = torch.stack([torch.zeros(17), torch.arange(17.0)], -1).expand(45, -1, -1)
    for frames in (line, still):
        found = follow(kt.Tracker("coco17", fps=30, window=24), frames)
        assert all(bool(torch.isfinite(p.points).all()) for p in found)
    assert float((found[-1].points - found[-2].points).abs().max()) < 1e-6


def test_a_frame_whose_joints_lie_at_one_point_is_one_without_the_person(clip):
    """About a middle that is 0 detectors' zeros are no corner."""
    frames = observed(clip)[:60] - observed(clip).mean((0, 1))
    blank, zero = frames.clone(), frames.clone()
    blank[20:30], zero[20:30] = math.nan, 0.0
    for one, other in zip(follow(kt.Tracker("coco17"), zero), follow(kt.Tracker("coco17"), blank), strict=True):
        assert torch.equal(one.points, other.points) and torch.equal(one.seen, other.seen)
    assert follow(kt.Tracker("coco17"), torch.full((3, 17, 2), 7.0))[-1].points.isnan().all()


def test_a_jump_in_the_image_changes_nothing_and_a_bad_detection_little(clip, poses):
    frames = observed(clip)[:90].clone()
    frames[70:] += 5000
    found = follow(kt.Tracker("coco17", fps=30), frames)
    moved = found[89].points - torch.tensor([5000.0, 5000.0, 0.0])
    assert torch.allclose(moved, poses[1][89].points, atol=1e-6)
    frames[80, 3] += 3000
    found = follow(kt.Tracker("coco17", fps=30), frames)
    points = torch.stack([p.points for p in found[82:]])
    assert error(points, clip.points[82:90]) < 60


@pytest.mark.parametrize(("joint", "off"), [(9, 2000), (9, 200), (7, 2000), (5, 2000), (11, 2000)])
def test_a_wrong_joint_moves_no_other(clip, poses, joint, off):
    frames = observed(clip)[:58].clone()
    frames[55, joint] += off  # mm
    found = follow(kt.Tracker("coco17", fps=30), frames)
    assert bool(found[54].seen[joint]) and not bool(found[55].seen[joint]) and bool(found[56].seen[joint])
    moved = (found[55].points - poses[1][55].points)[:17, :2].norm(dim=-1)
    assert float(moved[torch.arange(17) != joint].max()) < 10 and float(moved[joint]) < 100
    assert float((found[57].points - poses[1][57].points).norm(dim=-1).median()) < 10


def test_a_joint_that_stays_where_it_jumped_to_is_believed(clip):
    frames = observed(clip)[:40].clone()
    frames[25:, 9] += 400
    found = follow(kt.Tracker("coco17", fps=30), frames)
    seen = [bool(p.seen[9]) for p in found[25:]]
    assert not seen[0] and all(seen[4:])


@pytest.fixture(scope="module")
def with_a_gap(clip):
    frames = observed(clip)[:36].clone()
    frames[20] = torch.nan
    return follow(kt.Tracker("coco17", fps=30, window=24), frames)


@pytest.mark.parametrize("wild", ["random", "another", "scaled", "reversed"])
def test_one_wild_frame_is_as_one_without_the_person(clip, with_a_gap, wild):
    frames = observed(clip)[:36].clone()
    others = {
        "random": 1500 * torch.rand(17, 2, generator=torch.Generator().manual_seed(0)).double(),
        "another": frames[5] / 2 + 3000,
        "scaled": frames[20] * 1e12,
        "reversed": frames[20].flip(0),
    }
    frames[20] = others[wild]
    tracker = kt.Tracker("coco17", fps=30, window=24)
    for one, other in zip(with_a_gap, follow(tracker, frames), strict=True):
        assert torch.equal(one.points, other.points) and torch.equal(one.seen, other.seen)
    assert not bool(tracker.tracks().seen[8].any())


def test_what_stays_after_a_cut_is_believed_after_a_tenth_of_a_second(clip):
    frames = observed(clip)[:30].clone()
    frames[20:] = frames[20:] / 2 + 3000
    seen = [bool(p.seen.all()) for p in follow(kt.Tracker("coco17", fps=30, window=24), frames)[20:]]
    assert seen == [False] * 3 + [True] * 7


def test_finds_the_body_again_after_it_turned_unseen(clip):
    behind = walking_person(60, skeleton="coco17", yaw=-150, turn=0)
    frames = torch.cat([observed(clip)[:60], torch.full((30, 17, 2), torch.nan), observed(behind)])
    found = follow(kt.Tracker("coco17", fps=30), frames)
    assert all(bool(torch.isfinite(p.points).all()) for p in found)
    assert error(torch.stack([p.points for p in found[-40:]]), behind.points[-40:]) < 40  # flat: 87


@pytest.mark.parametrize(("before", "away"), [(60, 20), (42, 16)])  # a solve may be under way while they change
def test_who_comes_back_may_be_another(before, away):
    """The bones of whoever went are not kept until the period ends: the first window without them tells."""
    body = kt.SKELETONS["coco17"]
    clip = walking_person(150, skeleton="coco17", yaw=30, turn=0)
    other = clip.points[:, :17].clone()
    for side in ("left", "right"):  # arms half as long
        shoulder, *rest = (body.index(f"{side}_{joint}") for joint in ("shoulder", "elbow", "wrist"))
        other[:, rest] = (other[:, rest] + other[:, [shoulder]]) / 2
    gap = torch.full((away, 17, 2), torch.nan)
    after = kt.Tracker("coco17", fps=30, window=45), torch.cat([observed(clip)[:before], gap, other[..., :2]])
    alone = kt.Tracker("coco17", fps=30, window=45), other[..., :2]
    ends = [body.index("left_shoulder"), body.index("left_elbow")]
    arms = []
    for tracker, frames in (after, alone):
        with tracker:
            points = torch.stack([tracker.update(frame).points for frame in frames])
        arms.append(points[:, ends].diff(dim=1).norm(dim=-1)[:, 0])
    assert float(arms[0][before + away + 20]) > 1.2 * float(arms[1][-1])
    assert abs(float(arms[0][-1] / arms[1][-1]) - 1) < 0.05


def test_who_goes_and_comes_is_solved_all_the_same(clip):
    """Each return put the next solve off, so that there was none."""
    frames = observed(clip)[:60].repeat(4, 1, 1)
    frames[torch.arange(len(frames)) % 40 >= 23] = torch.nan
    with kt.Tracker("coco17", fps=30, window=60, period=45) as tracker:
        delays = [tracker.update(frame).delay for frame in frames]
    assert max(delays[100:]) <= 45 + 20


@pytest.mark.parametrize("error", [torch.linalg.LinAlgError("svd"), MemoryError("full")])
def test_a_solve_that_fails_is_told_once_and_costs_no_pose(clip, monkeypatch, error):
    def fail(*_):
        raise error

    monkeypatch.setattr("kcs_torch.live.tracker.solve_window", fail)
    with kt.Tracker("coco17", fps=30, window=24) as tracker, pytest.warns(kt.KcsWarning) as told:
        poses = follow(tracker, observed(clip)[:60])
    assert [str(w.message) for w in told] == [
        f"Tracker: a window could not be solved, and is left out ({type(error).__name__}: {error})"
    ]
    assert [pose.frame for pose in poses] == list(range(60)) and not poses[-1].ready


def test_closing_ends_the_thread_and_keeps_the_window(clip):
    frames = observed(clip)
    before = set(threading.enumerate())
    fields = {"viewpoint": "fixed", "steps": 3}
    with kt.Tracker("coco17", fps=30, window=20, method=kt.METHODS["pkc"](**fields)) as tracker:
        poses = follow(tracker, frames[:22])
        (thread,) = set(threading.enumerate()) - before
    assert not thread.is_alive() and len(poses) == 22
    assert tracker.tracks().num_frames == 20
    with pytest.raises(kt.OptionError, match="Tracker: closed"):
        tracker.update(frames[22])
    tracker.close()
    with pytest.raises(ZeroDivisionError), kt.Tracker("coco17", fps=30) as tracker:
        raise ZeroDivisionError
    with pytest.raises(kt.OptionError, match="Tracker: closed"):
        tracker.update(frames[0])


def test_the_direction_in_which_bones_are_written_changes_nothing(clip):
    body = kt.SKELETONS["coco17"]
    other = replace(body, bones=tuple(b[::-1] for b in body.bones))
    fields = {"fps": 30, "window": 24, "method": kt.PKC(steps=2, rounds=0)}
    found = []
    for skeleton in (body, other):
        with kt.Tracker(skeleton, **fields) as tracker:
            found.append(torch.stack([p.points for p in follow(tracker, observed(clip)[:40])]))
            assert tracker.tracks().skeleton == skeleton
    torch.testing.assert_close(*found)


def test_bones_that_have_not_been_seen_leave_no_nan():
    lost = [math.nan, math.nan]
    with kt.Tracker(kt.Skeleton(["a", "b", "c"], [(0, 1), (1, 2)]), fps=30) as tracker:
        first = tracker.update([[1.0, 2.0], lost, lost])
        two = tracker.update([[1.0, 2.0], lost, [3.0, 3.0]])
        all_seen = tracker.update([[1.0, 2.0], [2.0, 4.0], [3.0, 3.0]])
    assert bool(first.uncertainty.isinf().all()) and bool(first.points.isfinite().all())
    for pose in (two, all_seen):
        assert bool(pose.uncertainty.isfinite().all()) and bool((pose.uncertainty > 0).all())


@pytest.mark.filterwarnings("ignore::kcs_torch.KcsWarning", "ignore::kcs_torch.ConvergenceWarning")
def test_by_the_size_of_the_image_the_result_is_before_a_near_camera(monkeypatch):
    """Else rays are parallel. Live poses are the same."""
    walk = walking_person(12, skeleton="coco17", yaw=60, turn=0)
    seen = Intrinsics(1500.0, 1500.0, 960.0, 540.0).project(walk.points[:, :17] + torch.tensor([900.0, 0.0, 3500.0]))
    method = kt.PKC(viewpoint="fixed", steps=2, lifts=1, rounds=0, alternatives=0)
    sizes = (1920, 1080), None, (1080, 1920)
    trackers = [kt.Tracker("coco17", window=12, image_size=size, method=method) for size in sizes]
    poses = [follow(one, seen.double()) for one in trackers]
    assert all(torch.equal(a.points, b.points) for a, b in zip(*poses[:2], strict=True))
    tracks = [one.tracks() for one in trackers]
    assert [one.image_size for one in tracks] == [(1920, 1080), None, None]
    assert ["image_size=(1920, 1080)" in "".join(one.notes) for one in tracks] == [False, False, True]
    monkeypatch.setattr(live, "reconstruct_uncalibrated", lambda *given: given)
    used, shown = trackers[0].result()
    assert used is method and shown.image_size == (1920, 1080)
    assert trackers[1].result().distance is None
