"""Left and right swapped back: exactly where they were swapped, and nowhere else."""

import itertools
import math
from dataclasses import replace

import pytest
import torch

import kcs_torch as kt
from kcs_torch.data.synthetic import random_motion, walking_person
from kcs_torch.errors import ShapeError
from kcs_torch.solvers import swapped_frames
from kcs_torch.solvers.swaps import LEAST, MEMORY, MOST, PAIRS, USUAL

LIMBS = {
    "arms": ["left_elbow", "left_wrist"],
    "legs": ["left_knee", "left_ankle"],
}


def swap(tracks, frames, joints=None):
    """The tracks with left and right exchanged in some frames, of all pairs or of those of some left joints."""
    body = tracks.skeleton
    pairs = [p for p in body.mirror if max(p) < body.num_observed and (joints is None or body.joints[p[0]] in joints)]
    left, right = torch.tensor(pairs).T
    points, weights = tracks.points[:, : body.num_observed].clone(), tracks.weights[:, : body.num_observed].clone()
    frames = torch.tensor(frames)[:, None]
    for values in (points, weights):
        values[frames, left], values[frames, right] = values[frames, right], values[frames, left]
    points, weights = body.complete(points, weights)
    return kt.Tracks(points, weights, body, fps=tracks.fps, units=tracks.units)


def walk(frames=90, yaw=40):
    generator = torch.Generator().manual_seed(3)
    one = walking_person(frames, yaw=yaw, skeleton="coco17", noise=3.0, generator=generator).tracks
    confidence = 0.5 + 0.5 * torch.rand(one.weights.shape, generator=generator, dtype=one.weights.dtype)
    points, weights = one.skeleton.complete(
        one.points[:, : one.skeleton.num_observed], confidence[:, : one.skeleton.num_observed]
    )
    return kt.Tracks(points, weights, one.skeleton, fps=one.fps)


def same(a, b):
    torch.testing.assert_close(a.points, b.points)
    torch.testing.assert_close(a.weights, b.weights)


def naive(left, right, seen, size, penalty):
    """The least cost of all signs, by trying all, and those signs."""
    apart = left - right
    frames, pairs = seen.shape
    memory = min(MEMORY, frames - 1)
    spans = [(a, b) for b in range(2, memory + 1) for a in range(1, b)]

    def error(t, a, b, x, y):
        line = (a * x * apart[t - b] + (b - a) * y * apart[t]) / b
        return (apart[t - a] - line).norm(dim=-1)

    usual = {}
    for a, b in spans:
        for p in range(pairs):
            plain = [float(error(t, a, b, 1, 1)[p]) for t in range(b, frames) if seen[[t - b, t - a, t], p].all()]
            middle = sorted(plain)[(len(plain) - 1) // 2] if plain else 0.0
            usual[a, b, p] = max(USUAL * middle, LEAST * size)
    best = math.inf, None
    for signs in itertools.product((1, -1), repeat=frames):
        cost = penalty * sum(s != t for s, t in itertools.pairwise(signs))
        for a, b in spans:
            for t in range(b, frames):
                far = error(t, a, b, signs[t - b] * signs[t - a], signs[t] * signs[t - a])
                for p in range(pairs):
                    if seen[[t - b, t - a, t], p].all():
                        e = min(float(far[p]) / usual[a, b, p], MOST)
                        cost += 3 / len(spans) * min(1, PAIRS / pairs) * math.log1p(e * e)
        best = min(best, (cost, signs))
    return best


@pytest.mark.parametrize("seed", range(12))
def test_the_signs_are_the_best_of_all(seed):
    generator = torch.Generator().manual_seed(seed)
    frames, pairs = 4 + seed % 6, 2 + seed % 4
    left = torch.randn(frames, pairs, 2, generator=generator, dtype=torch.float64).cumsum(0) / 3 + 1
    right = torch.randn(frames, pairs, 2, generator=generator, dtype=torch.float64) / 5
    seen = torch.rand(frames, pairs, generator=generator) > 0.15
    seen[:, 0] = True  # no frame is left out, as the naive twin knows no gaps
    turned = torch.rand(frames, generator=generator) > 0.7
    left[turned], right[turned] = right[turned], left[turned]
    cost, signs = naive(left, right, seen, 1.0, 1.5)
    found = swapped_frames(left, right, seen, 1.0, 1.5)
    expected = torch.tensor(signs) < 0
    expected = ~expected if 2 * int(expected.sum()) > frames else expected
    other = ~expected if 2 * int(expected.sum()) == frames else expected
    assert torch.equal(found, expected) or torch.equal(found, other), cost


@pytest.mark.parametrize("frames", [[30], [40, 41], list(range(10, 50)), [5, 7, 11, 12, 13, 60], list(range(80, 90))])
@pytest.mark.parametrize("joints", [None, *LIMBS.values()], ids=["body", *LIMBS])
def test_what_was_swapped_is_swapped_back(frames, joints):
    tracks = walk()
    mended = kt.clean.unswap(swap(tracks, frames, joints))
    same(mended, tracks)
    (note,) = mended.notes
    alone = f"; of limbs by themselves, from {(joints or [''])[0]} on in {len(frames)}"
    whole, limb = (len(frames), "") if joints is None else (0, alone)
    assert f"swapped back in {whole} of 90" in note and note.endswith(f") frames{limb}")


def test_legs_that_come_back_slowly_from_a_swap_do_not_cross_before():
    """A detector that smooths its joints shows legs in between after all of the body was swapped for a moment."""
    tracks = walk(150, yaw=90)
    body = tracks.skeleton
    wrong = swap(tracks, list(range(80, 84)))
    points = wrong.points[:, :17].clone()
    for name in ("knee", "ankle"):
        pair = [body.index(f"{side}_{name}") for side in ("left", "right")]
        before, after = points[83, pair], points[88, pair]
        for t in range(84, 88):
            points[t, pair] = before + (t - 83) / 5 * (after - before)
    points, weights = body.complete(points, wrong.weights[:, :17])
    mended = kt.clean.unswap(replace(wrong, points=points, weights=weights))
    early = slice(0, 84)
    torch.testing.assert_close(mended.points[early], tracks.points[early])
    torch.testing.assert_close(mended.points[88:], tracks.points[88:])


@pytest.mark.parametrize(("clip", "whole", "knees"), [("mediapipe_dancer", 0, 0), ("mediapipe_sports2d", 4, 28)])
def test_legs_of_real_people_do_not_cross_for_seconds(shared, clip, whole, knees):
    """Legs that jump in a turn (the dancer's at 222), or come back slowly from a swap (after 71)."""
    tracks = kt.load_tracks(shared / "data" / "video2d" / f"{clip}.npz")
    mended = kt.clean.unswap(tracks)
    changed = (mended.points != tracks.points).any(-1)
    knee, hip = (changed[:, tracks.skeleton.index(f"left_{name}")] for name in ("knee", "hip"))
    assert (int(hip.sum()), int(knee.sum())) == (whole, whole + knees)


def test_both_at_once_and_while_nobody_is_seen():
    tracks = walk()
    weights = tracks.weights[:, :17].clone()
    weights[48:52] = 0
    points, weights = tracks.skeleton.complete(torch.where(weights[..., None] > 0, tracks.points[:, :17], 0), weights)
    tracks = kt.Tracks(points, weights, tracks.skeleton, fps=tracks.fps)
    mended = kt.clean.unswap(swap(swap(tracks, list(range(20, 31))), list(range(52, 70)), LIMBS["legs"]))
    same(mended, tracks)


@pytest.mark.parametrize("yaw", [0, 45, 90, 170])
@pytest.mark.parametrize("rate", [1, 2])
def test_a_walk_is_left_alone(yaw, rate):
    tracks = walk(120, yaw=yaw)
    tracks = kt.Tracks(tracks.points[::rate], tracks.weights[::rate], tracks.skeleton, fps=30 / rate)
    assert kt.clean.unswap(tracks) is tracks  # seen from the side legs and arms cross at every step


@pytest.mark.parametrize(("yaw", "at"), [(40, [8]), (60, [22]), (90, [22]), (60, [22, 39])])
@pytest.mark.parametrize("kind", ["dropped", "repeated"])
def test_legs_that_moved_on_while_frames_were_lost_are_not_swapped(yaw, at, kind):
    """All that came before was swapped: the whole body leaps ahead, and legs may have passed each other."""
    whole = walking_person(60, yaw=yaw, turn=0.0).tracks
    frames = torch.arange(60)
    for begin in at:
        away = (frames >= begin) & (frames < begin + 6)
        frames = frames[~away] if kind == "dropped" else torch.where(away, begin, frames)
    lost = replace(whole, points=whole.points[frames], weights=whole.weights[frames])
    assert kt.clean.unswap(lost) is lost
    swapped = swap(lost, [44, 45, 46], LIMBS["legs"])  # elsewhere it is told as ever
    same(kt.clean.unswap(swapped), lost)


def test_outliers_are_no_swaps():
    tracks = walk()
    generator = torch.Generator().manual_seed(1)
    hit = torch.rand(90, 17, generator=generator) < 0.05
    tracks.points[:, :17][hit] += 150 * torch.randn(int(hit.sum()), 2, generator=generator, dtype=torch.float64)
    points, weights = tracks.skeleton.complete(tracks.points[:, :17], tracks.weights[:, :17])
    tracks = kt.Tracks(points, weights, tracks.skeleton, fps=tracks.fps)
    assert kt.clean.unswap(tracks) is tracks


def test_joints_anywhere_are_no_swaps():
    for seed in range(6):
        tracks, chance = walk(), torch.Generator().manual_seed(seed)
        count = tracks.skeleton.num_observed
        points = tracks.points[:, :count].clone()
        wrong = torch.rand(points.shape[:2], generator=chance) < 0.2
        points[wrong] = 6000 * torch.rand(int(wrong.sum()), 2, generator=chance, dtype=points.dtype) - 3000
        points, weights = tracks.skeleton.complete(points, tracks.weights[:, :count])
        tracks = replace(tracks, points=points, weights=weights)
        assert kt.clean.unswap(tracks) is tracks


def test_a_body_that_turns_about_itself_is_left_alone():
    tracks = walking_person(90, turn=1080).tracks
    assert kt.clean.unswap(tracks) is tracks


@pytest.mark.parametrize("frames", [1, 2, 3, 4])
def test_hardly_any_frames(frames):
    tracks = walk(frames)
    assert kt.clean.unswap(tracks).num_frames == frames


def test_nothing_to_tell():
    still = walk(1)
    still = kt.Tracks(still.points.expand(20, -1, -1), still.weights.expand(20, -1), still.skeleton)
    assert kt.clean.unswap(still) is still
    one_sided = walk()
    one_sided.weights[:, [i for i in range(17) if one_sided.skeleton.side(i) == "left"]] = 0
    assert kt.clean.unswap(one_sided) is one_sided
    chain = kt.Tracks.from_arrays(torch.rand(10, 3, 2), skeleton=kt.Skeleton.from_edges([(0, 1), (1, 2)], 3))
    assert kt.clean.unswap(chain) is chain
    point = kt.Tracks(torch.zeros_like(still.points), still.weights, still.skeleton)
    assert kt.clean.unswap(point) is point


def test_single_precision_and_what_is_given_stay():
    tracks = swap(walk(), [20, 21, 22])
    before = tracks.points.clone()
    kt.clean.unswap(tracks)
    assert torch.equal(tracks.points, before)
    small = kt.Tracks(tracks.points.float(), tracks.weights.float(), tracks.skeleton, fps=tracks.fps)
    mended = kt.clean.unswap(small)
    assert mended.points.dtype == mended.weights.dtype == torch.float32
    torch.testing.assert_close(mended.points.double(), kt.clean.unswap(tracks).points, rtol=1e-5, atol=1e-3)


def test_pkc_does_so_by_itself():
    tracks = walk(60)
    frames = list(range(20, 32))
    wrong = swap(tracks, frames)
    right, result = kt.reconstruct(tracks), kt.reconstruct(wrong)
    torch.testing.assert_close(result.points, right.points)
    same(result.tracks, tracks)
    assert "unswap: left and right swapped back in 12 of 60 (20 %) frames" in result.tracks.notes
    assert result.diagnostics.reprojection_rms == pytest.approx(right.diagnostics.reprojection_rms)
    (many,) = kt.reconstruct_all([wrong])
    same(many.tracks, tracks)
    lens = (50000.0, 50000.0, 0.0, 0.0)  # pixels of a lens so long that rays are parallel
    same(kt.reconstruct(wrong, intrinsics=lens).tracks, tracks)
    assert kt.reconstruct(wrong, denoise=False).tracks is wrong
    assert kt.reconstruct(wrong, method="sfam").tracks is wrong


def test_a_detector_that_mistook_a_person(shared, protocol):
    (case,) = [c for c in protocol.suites()["real_mediapipe"] if c["camera"] == 1]
    given, _ = protocol.build(shared / "data", case)
    tracks = kt.Tracks.from_arrays(
        given["points2d"], given["confidence"], skeleton="mediapipe33", fps=float(given["fps"])
    )
    wrong = [60, 61, 63, 65, *range(67, 75)]  # from 41 on all the time, then to and fro; seen in the pictures
    mended = kt.clean.unswap(tracks)
    wrist, other = (mended.skeleton.index(f"{side}_wrist") for side in ("left", "right"))
    swapped = (mended.points[:, wrist] == tracks.points[:, other]).all(-1)
    assert swapped.nonzero().flatten().tolist() == [*range(41, 60), *wrong, 81]


def test_legs_of_an_animal():
    """Without a template, the pairs that hang on the body's middle line are its trunk."""
    body = replace(kt.SKELETONS["ap10k"], template=None, spread=None)
    clip = random_motion(body, 80, turn=60.0, swing=20.0, generator=torch.Generator().manual_seed(2))
    tracks = kt.Tracks(clip.tracks.points, clip.tracks.weights, body, fps=30.0)
    assert kt.clean.unswap(tracks) is tracks
    leg = [body.joints[a] for a, _ in body.mirror if "paw" in body.joints[a] or "elbow" in body.joints[a]]
    assert len(leg) >= 2
    same(kt.clean.unswap(swap(tracks, [*range(20, 33), 50])), tracks)
    front = [name for name in leg if "front" in name or "elbow" in name]
    mended = kt.clean.unswap(swap(tracks, list(range(20, 33)), front))
    assert "13" in mended.notes[-1]
    same(mended, tracks)


def test_shapes_that_do_not_fit():
    left, seen = torch.ones(6, 2, 2), torch.ones(6, 2, dtype=torch.bool)
    for arguments in ((left[0], left[0], seen), (left, left[1:], seen), (left, left, seen[:, :1])):
        with pytest.raises(ShapeError, match=r"swapped_frames: expected left and right \(T, P, 2\)"):
            swapped_frames(*arguments, 1.0, 1.5)


def test_hands_that_are_mistaken_do_not_take_the_body_along():
    """Forty joints of fingers against seventeen: a detector takes one hand for the other, and arms are right."""
    body = kt.SKELETONS["wholebody63"]
    clip = random_motion(body, 60, turn=20, swing=15, generator=torch.Generator().manual_seed(0)).tracks
    fingers = [a for a, b in body.mirror if a >= 23 and b < body.num_observed]
    assert len(fingers) == 20
    wrong = swap(clip, list(range(20, 40)), [body.joints[a] for a in fingers])
    found = kt.clean.unswap(wrong)
    same(found, clip)
    assert "in 0 of 60 (0 %) frames; of limbs by themselves, from left_thumb1 on in 20" in found.notes[-1]
    everything = swap(clip, list(range(20, 40)))
    same(kt.clean.unswap(everything), clip)


def test_sides_of_one_shot_say_nothing_of_the_next(protocol, shared):
    """Two people in one clip: the second was turned over, as at the cut all joints seemed to change sides."""
    data_of = lambda name: protocol.load(shared / "data", f"cmu/cmu_{name}")["points3d"][::4][:100, protocol.CMU17]  # noqa: E731
    time = protocol.np.linspace(0, 1, 100)
    shots = []
    for name, yaw in (("35_01", 45.0), ("07_01", 225.0)):
        points = torch.from_numpy(data_of(name)).double()
        turns = torch.from_numpy(protocol.rotation(yaw + 0 * time[: len(points)], 10.0)).double()
        shots.append((points @ turns.mT)[..., :2])
        shots[-1] = shots[-1] - shots[-1][0].mean(0)
    noise = torch.randn(sum(map(len, shots)), 17, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    tracks = kt.Tracks.from_arrays(torch.cat(shots) + 8 * noise, skeleton="cmu17", fps=30.0, units="mm")
    assert kt.clean.unswap(tracks) is tracks
