"""Linking people: names are kept over shuffles, crossings, gaps and ghosts."""

import numpy as np
import pytest

from kcs_torch.io import link_people


def crowd(
    seed,
    *,
    num_people=2,
    num_frames=120,
    fps=30,
    speed=200.0,
    noise=3.0,
    unseen=0.1,
    lost=0.0,
    ghosts=0.0,
    hidden=0.0,
    away=(0, 0),
):
    """People who swing their limbs and cross each other, as a detector lists them.

    Returns the detections of each frame in random order, and who each one is (-1: a ghost, half of somebody).
    ``hidden``: whoever is that near, in pixels, to somebody in front is not detected; ``away``: frames in which
    person 1 is not.
    """
    rng = np.random.default_rng(seed)
    joints = 17
    shape = rng.normal(0, 1, (num_people, joints, 2)) * [40, 120] * (1 + 0.1 * rng.random((num_people, 1, 1)))
    start = np.stack([np.linspace(0, speed * num_frames / fps, num_people), 20 * rng.random(num_people)], -1)
    velocity = np.stack([np.linspace(speed, -speed, num_people) / fps, np.zeros(num_people)], -1)
    time = np.arange(num_frames)[:, None, None]
    centre = start + velocity * time
    phase = 6 * rng.random((num_people, joints, 1))
    swing = 20 * np.sin(2 * np.pi * time[..., None] / fps + phase)
    places = centre[:, :, None] + shape + swing + noise * rng.standard_normal((num_frames, num_people, joints, 2))
    frames, names = [], []
    for t in range(num_frames):
        found = []
        for p in range(num_people):
            in_front = np.abs(centre[t, p, 0] - centre[t, :p, 0])
            if rng.random() < lost or (in_front < hidden).any() or (p == 1 and away[0] <= t < away[1]):
                continue
            confidence = np.where(rng.random(joints) < unseen, 0, rng.uniform(0.4, 0.9, joints))
            pose = np.column_stack([places[t, p], confidence]) * (confidence > 0)[:, None]
            found.append((pose, p))
            if rng.random() < ghosts:
                half = pose.copy()
                half[6:] = 0
                half[:6, :2] += rng.normal(0, 6, (6, 2))
                found.append((half * [1, 1, 0.7], -1))
        order = rng.permutation(len(found))
        frames.append(np.stack([found[i][0] for i in order]) if found else np.zeros((0, joints, 3)))
        names.append([found[i][1] for i in order])
    return frames, names


def who(track, frames, names):
    """The name behind each frame of a track; None where it is unseen."""
    out = []
    for t, found in enumerate(frames):
        match = [n for pose, n in zip(found, names[t], strict=True) if pose.any() and np.array_equal(pose, track[t])]
        out.append(match[0] if match else None)
    return out


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(
    "scene",
    [
        {},
        {"noise": 10, "unseen": 0.4},
        {"hidden": 100},
        {"fps": 10, "num_frames": 60},
        {"away": (20, 48)},
        {"lost": 0.15},
        {"ghosts": 0.2},
        {"num_people": 3, "lost": 0.05},
    ],
    ids=str,
)
def test_everybody_keeps_their_name(seed, scene):
    frames, names = crowd(seed, **scene)
    people = scene.get("num_people", 2)
    tracks = link_people(frames)
    found = [who(t, frames, names) for t in tracks[:people]]
    one_each = [{n for n in f if n is not None} for f in found]
    assert sorted(one_each, key=min) == [{n} for n in range(people)]
    for f, (name,) in zip(found, one_each, strict=True):
        assert sum(n is not None for n in f) == sum(name in n for n in names)


@pytest.mark.parametrize("gap", [1, 2, 5, 10])
def test_a_duplicate_after_a_gap_takes_nobody_over(gap):
    """One person, missed for some frames, and then found twice in a single one."""
    frames, _ = crowd(3, num_people=1, noise=1)
    frames[10 : 10 + gap] = [np.zeros((0, *frames[0].shape[1:]))] * gap
    one = frames[10 + gap]
    frames[10 + gap] = np.concatenate([one + np.array([4.0, 0, 0]), one])
    found = [int((t[..., 2] > 0).any(1).sum()) for t in link_people(frames)]
    assert found == [len(frames) - gap, 1]


def test_nothing_is_lost_or_invented():
    frames, _ = crowd(1, num_people=4, lost=0.2, ghosts=0.3, hidden=40)
    tracks = link_people(frames)
    assert sum(int((t[..., 2] > 0).any(1).sum()) for t in tracks) == sum(len(f) for f in frames)
    assert np.isclose(sum(t.sum() for t in tracks), sum(f.sum() for f in frames))
    amounts = [t[..., 2].sum() for t in tracks]
    assert amounts == sorted(amounts, reverse=True)


def test_somebody_long_away_is_somebody_new():
    frames, _ = crowd(2, away=(30, 70))
    assert len(link_people(frames, max_gap=30)) == 3
    assert len(link_people(frames, max_gap=60)) == 2


def test_somebody_far_off_is_somebody_new_however_well_seen():
    pose = np.array([[[100.0, 100.0, 1.0], [150.0, 200.0, 1.0]]])
    assert len(link_people([pose, pose + np.array([500.0, 0, 0])])) == 2
    assert len(link_people([pose, pose + np.array([20.0, 0, 0])])) == 1


def test_a_person_among_more_ghosts_than_are_remembered():
    frames, names = crowd(4, num_people=1, num_frames=20, lost=0.2)
    rng = np.random.default_rng(0)
    for t, found in enumerate(frames):
        far = rng.uniform(10_000, 1e6, (60, 1, 1)) + rng.normal(0, 50, (60, 17, 2))
        frames[t] = np.concatenate([np.concatenate([far, np.full((60, 17, 1), 0.2)], -1), found])
        names[t] = [-1] * 60 + names[t]
    main = link_people(frames)[0]
    assert [n for n in who(main, frames, names) if n is not None] == [0] * sum(0 in n for n in names)


def test_empty_and_blank_detections():
    assert link_people([]) == []
    assert link_people([np.zeros((0, 3, 3)), np.zeros((2, 3, 3))]) == []


def test_the_detections_stay_as_they_were():
    frames, _ = crowd(3, ghosts=0.2)
    before = [f.copy() for f in frames]
    link_people(frames)
    assert all(np.array_equal(a, b) for a, b in zip(frames, before, strict=True))
