"""Clips of many lengths as padded batches: what goes with what, and that nobody notices."""

import math
import warnings
from dataclasses import replace

import pytest
import torch
from numerics import count_operations, normal
from torch.testing import assert_close

from kcs_torch import KCS, METHODS, SfAM, ShapeError, Tracks
from kcs_torch.data import walking_person
from kcs_torch.functional import best_path, complete_rotation, orbit, viewpoint_turn
from kcs_torch.methods import PND
from kcs_torch.methods.answer.mirror import mirror_sign
from kcs_torch.methods.clips import batches as module
from kcs_torch.methods.clips.batches import Clips, in_batches, padded
from kcs_torch.methods.clips.cameras import orthographic_cameras
from kcs_torch.solvers import complete_tracks, constant_path
from kcs_torch.solvers.cuts import cut_frames, find_cuts
from kcs_torch.solvers.ist import ist, metric_upgrade

pytestmark = pytest.mark.filterwarnings("ignore::kcs_torch.KcsWarning")


def walk(frames, **options):
    return walking_person(frames, generator=torch.Generator().manual_seed(frames), **options).tracks


def spoiled(frames, where):
    """A walk of which some entries are unseen."""
    points = walk(frames, turn=90.0).points.clone()
    points[where] = math.nan
    return Tracks.from_arrays(points, skeleton="h36m17")


def settled_notes(diagnostics):
    """Notes, without what rounding alone decides where nothing moves."""
    return [note for note in diagnostics.notes if "constant angular velocity (median deviation 0.0" not in note]


CLIPS = [
    walk(40, turn=150.0),
    walk(1),
    walk(31, turn=120.0, missing=0.1, yaw=30.0),
    spoiled(33, (slice(None), 3)),  # a joint that is never seen
    walk(36, turn=150.0, skeleton="coco17"),
    replace(walk(35), points=walk(35).points[:1].expand(35, -1, -1)),  # nothing moves
    spoiled(45, ([0, 10, 11], slice(None))),  # frames that show nothing
    walk(2),
    walk(9, turn=60.0),
    walk(230, turn=180.0),
    walk(11, turn=60.0),
]


@pytest.mark.parametrize(
    "method",
    [KCS(), KCS(arrangement="frames", scale_range=math.inf, bone_steps=2), SfAM(), SfAM(trajectories=9), PND()],
    ids=["kcs", "kcs in frames", "sfam", "sfam, few cosines", "pnd"],
)
def test_many_clips_are_those_of_one_after_the_other(method):
    """Of any length, with gaps and without; the world in which cameras are told is anybody's."""
    for one, clip in zip(method.many(CLIPS), CLIPS, strict=True):
        alone = method(clip)
        size = float(alone.points.std())
        assert_close(one.points, alone.points, rtol=0, atol=1e-5 * size)
        assert_close(one.scales, alone.scales, rtol=0, atol=1e-5)
        assert one.points.shape == (clip.num_frames, clip.num_joints, 3)
        told, expected = one.diagnostics, alone.diagnostics
        assert (told.converged, told.iterations) == (expected.converged, expected.iterations)
        assert settled_notes(told) == settled_notes(expected)


@pytest.mark.parametrize("name", ["rigid", "pta", "csf", "bmm", "smsr", "local_rigidity", "pnd"])
def test_many_clips_by_the_classical_methods(name):
    """Clips of one length go together, gaps, stiff bodies and all: the result is that of each one alone."""
    method = METHODS[name]()
    clips = [*CLIPS[1:4], *(walk(31, turn=90.0, missing=0.1 * k, yaw=20.0 * k, noise=2.0 * k) for k in range(3))]
    clips.append(
        replace(clips[0], points=clips[0].points[:1].expand(31, -1, -1), weights=clips[0].weights.expand(31, -1))
    )
    for one, clip in zip(method.many(clips), clips, strict=True):
        alone = method(clip)
        assert_close(one.points, alone.points, rtol=0, atol=1e-5 * float(alone.points.std()))
        assert (one.diagnostics.converged, one.diagnostics.iterations) == (
            alone.diagnostics.converged, alone.diagnostics.iterations
        )  # fmt: skip
    if name in ("rigid", "bmm", "smsr"):  # whose shapes go together, too
        few = [walk(20, turn=90.0, yaw=10.0 * k) for k in range(6)]
        alone, together = (count_operations(lambda k=k: method.many(few[:k])).total for k in (1, 6))
        assert together < 3 * alone


def test_windows_of_many_clips_are_searched_and_joined_together():
    """Three windows each, of two lengths that come in turns; a batch has no more operations than one of its clips."""
    clips = [walk(n, turn=150.0, yaw=20.0 * i) for i, n in enumerate((50, 46, 50, 46))]
    method = SfAM(window=20, overlap=5, num_steps=20)
    for one, clip in zip(method.many(clips), clips, strict=True):
        alone = method(clip)
        assert_close(one.points, alone.points, rtol=0, atol=1e-6 * float(alone.points.std()))
        assert_close(one.cameras, alone.cameras, rtol=0, atol=1e-6)
    alone, together = (count_operations(lambda k=k: method.many(clips[::2][:1] * k)).total for k in (1, 8))
    assert together < 1.5 * alone


def test_metric_upgrades_stop_in_groups():
    """Neighbours that belong together stop together, and what is beside them makes no difference."""
    easy, hard = normal(20, 2, 6), normal(20, 2, 6, seed=1)
    easy[:, :, 3:] *= 1e-6
    motion, starts = torch.stack([easy, hard, hard, easy]), normal(2, 4, 6, 3, seed=2)
    options = {"tolerance": 1e-3, "num_steps": 200}
    pairs, _ = metric_upgrade(motion, starts, together=2, **options)
    for k in (0, 2):
        alone, _ = metric_upgrade(motion[k : k + 2], starts[:, k : k + 2], **options)
        assert_close(pairs[:, k : k + 2], alone)


def test_clips_settle_each_for_itself():
    """One is far from settled when it ends, the others are settled: each is told so as if it were alone."""
    method = SfAM(num_steps=12, final=0.2)
    clips = [walk(30, turn=150.0), walk(30, turn=150.0, missing=0.4)]
    alone = [method(one).diagnostics.converged for one in clips]
    assert [one.diagnostics.converged for one in method.many(clips)] == alone


def test_little_is_padding():
    lengths = [30, 300, 29, 45, 46, 31, 2, 30, 299, 1000]
    groups = []

    def solve(batch):
        groups.append([one.num_frames for one in batch])
        return [one.num_frames for one in batch]

    clips = [walk(n) for n in lengths]
    assert in_batches(clips, solve) == lengths
    for group in groups:
        assert len(group) * max(group) <= 1.5 * sum(group)
    assert len(groups) == 5  # 2; 29..31 and 45 less than half as long again; 46; 299 and 300; 1000
    groups.clear()
    in_batches(clips, solve, kind=lambda one: one.num_frames % 2)
    assert all(len({n % 2 for n in group}) == 1 for group in groups)
    assert in_batches([], solve) == []


def test_batches_are_no_larger_than_what_helps():
    groups = []
    in_batches([walk(300)] * 20, lambda batch: groups.append(len(batch)) or [0] * len(batch))
    assert groups == [6, 6, 6, 2] and 6 * 300 <= module.FRAMES < 7 * 300


@pytest.mark.parametrize("counts", [(5, 5), (3, 5, 4)])
def test_padding_and_back(counts):
    parts = [normal(n, 2, seed=n) for n in counts]
    batch = Clips.of([replace(walk(n), points=normal(n, 17, 2)) for n in counts])
    values = padded(parts)
    assert values.shape == (len(counts), 5, 2) and (batch.inside is None) == (len(set(counts)) == 1)
    flat = batch.frames(values)
    assert torch.equal(flat, torch.cat(parts)) and torch.equal(batch.as_clips(flat.mT), values.movedim(-1, 0))
    for one, part, mean in zip(batch.cut(values), parts, batch.mean(values), strict=True):
        assert torch.equal(one, part)
        assert_close(mean, part.mean(0))
    some = batch.take(torch.tensor([1]))
    assert some.counts == counts[1:2] and torch.equal(some.points, batch.points[1:2])


# ---------------------------------------------------------------------- parts that take padding


def rotations(frames, seed):
    yaw = torch.linspace(0, 80 + 10 * seed, frames, dtype=torch.float64)
    return orbit(yaw) @ torch.linalg.matrix_exp(
        0.05 * (normal(frames, 3, 3, seed=seed) - normal(frames, 3, 3, seed=seed).mT)
    )


def test_constant_paths_of_many_lengths():
    parts = [rotations(n, n) for n in (20, 33, 27)]
    counts = torch.tensor([20, 33, 27])
    paths, angles = constant_path(padded(parts), counts=counts)
    for path, angle, part in zip(paths, angles, parts, strict=True):
        expected, off = constant_path(part)
        assert_close(path[: len(part)], expected)
        assert_close(angle[: len(part)], off)
        assert angle[len(part) :].isnan().all()


def test_tracks_of_many_lengths_are_completed():
    parts = [
        normal(n, 3, 4, seed=n) @ normal(4, 12, seed=1).unflatten(-1, (6, 2)).flatten(-2) for n in (20, 33, 27, 30)
    ]
    parts = [x.mean(1).unflatten(-1, (6, 2)) for x in parts]
    seen = [torch.rand(len(x), 6, generator=torch.Generator().manual_seed(len(x))) > 0.2 for x in parts]
    seen[2][:] = True  # what has no gaps is left alone
    inside = padded([torch.ones(len(x), dtype=torch.bool) for x in parts])
    found = complete_tracks(padded(parts), padded(seen), inside=inside)
    for one, part, there in zip(found, parts, seen, strict=True):
        assert_close(one[: len(part)], complete_tracks(part, there))
        assert not one[len(part) :].any()


def test_metric_upgrades_of_many_lengths():
    parts = [normal(n, 2, 6, seed=n) for n in (20, 33, 27)]
    motion, counts = padded(parts), torch.tensor([20, 33, 27])
    starts = torch.stack([ist(motion), normal(3, 6, 3)])
    options = {"smoothness": 0.1, "tolerance": 1e-2, "num_steps": 40}
    q, defect = metric_upgrade(motion, starts, counts=counts, together=1, **options)
    for k, part in enumerate(parts):
        alone, off = metric_upgrade(part, starts[:, k], **options)
        assert_close(q[:, k], alone)
        assert_close(defect[:, k], off)


def test_cameras_of_many_lengths():
    parts = [walk(n, turn=120.0).points for n in (30, 40, 36)]
    parts = [(x - x.mean(1, keepdim=True)) / x.std() for x in parts]
    found = orthographic_cameras(padded(parts), counts=torch.tensor([30, 40, 36]))
    for one, part in zip(found, parts, strict=True):
        ours, alone = (complete_rotation(x) for x in (one[: len(part)], orthographic_cameras(part[None])[0]))
        turns = [x[1:] @ x[:-1].mT for x in (ours, alone)]  # the world is anybody's
        assert_close(*turns, rtol=0, atol=1e-6)


def test_mirrors_of_many_lengths():
    parts = [walking_person(n, turn=60.0, yaw=20.0).points for n in (20, 33, 27)]
    parts = [x - x.mean(1, keepdim=True) for x in parts]
    parts[1] = parts[1] * torch.tensor([1.0, 1.0, -1.0])
    inside = padded([torch.ones(len(x), dtype=torch.bool) for x in parts])
    skeleton = walk(2).skeleton
    found = mirror_sign(padded(parts), skeleton, inside)
    assert found.tolist() == [float(mirror_sign(x, skeleton)) for x in parts]
    assert found[0] == -found[1]


def test_viewpoint_turns_of_many_lengths():
    parts = [rotations(n, seed)[:, :2] for seed, n in enumerate((20, 33, 27, 1))]
    inside = padded([torch.ones(len(x), dtype=torch.bool) for x in parts])
    found = viewpoint_turn(padded(parts), inside)
    assert_close(found, torch.stack([viewpoint_turn(x) for x in parts]))
    with pytest.raises(ShapeError, match=r"viewpoint_turn: inside: expected shape \(..., 33\), got \(4, 32\)"):
        viewpoint_turn(padded(parts), inside[:, 1:])


def test_cuts_of_many_lengths():
    """Clips of which some frames show little, or all; one is too short for a cut."""
    shots = [walk(n, turn=0.0, yaw=yaw) for n, yaw in ((20, 0.0), (12, 110.0), (25, 50.0))]
    whole = [torch.cat([one.points for one in some]) for some in (shots, shots[1:], shots[:1], shots[::2])]
    whole.append(whole[0][17:25])
    whole[2][11:] += 3000  # leaps
    seen = [torch.ones(x.shape[:-1], dtype=torch.bool) for x in whole]
    seen[0][[3, 25, 40]] = False
    seen[3][torch.rand(seen[3].shape, generator=torch.Generator().manual_seed(0)) < 0.2] = False
    pairs = torch.tensor(shots[0].skeleton.mirror)
    for leaps, expected in ((True, [[20, 32], [12], [11], [20], []]), (False, [[20, 32], [12], [], [20], []])):
        found = cut_frames(padded(whole), padded(seen), pairs, leaps=leaps)
        assert [one.nonzero().flatten().tolist() for one in found] == expected
        assert [find_cuts(*one, pairs, leaps=leaps) for one in zip(whole, seen, strict=True)] == expected


def test_rounding_of_straight_joints_tells_no_mirror():
    """In a plane no joint bends: how the body leans decides, whatever is beside it in a batch."""
    flat = walk(2, turn=0.0).points
    flat = (flat - flat.mean(1, keepdim=True)) / flat.std()
    flat = torch.cat([flat, flat @ torch.tensor([[0.5], [0.3]], dtype=flat.dtype)], -1)
    rough = flat + 1e-15 * normal(40, *flat.shape)
    body = walk(2).skeleton
    assert (mirror_sign(rough, body) == 1).all()
    assert (mirror_sign(rough * torch.tensor([1.0, 1.0, -1.0]), body) == -1).all()


@pytest.mark.parametrize("frames", [2, 17, 40, 300])
def test_best_paths_of_batches(frames):
    cost, transition = normal(3, frames, 4).abs(), normal(3, frames - 1, 4, 4, seed=1).abs()
    paths = [best_path(*one) for one in zip(cost, transition, strict=True)]
    assert torch.equal(best_path(cost, transition), torch.stack(paths))
    assert torch.equal(best_path(cost[None], transition[None]), torch.stack(paths)[None])


# ---------------------------------------------------------------------- what a batch is for


@pytest.mark.parametrize("method", [KCS(), SfAM()], ids=["kcs", "sfam"])
def test_a_batch_takes_few_more_operations_than_a_clip(method):
    """Sixteen clips of nearly one length, counted: what is done clip by clip shows here however busy the machine is."""
    clips = [walk(n, turn=150.0, yaw=3.0 * n) for n in range(24, 40)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        one, many = (count_operations(lambda c=some: method.many(c)).total for some in (clips[-1:], clips))
    assert many < 2.7 * one  # they are two batches
