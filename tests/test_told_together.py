"""What is told of many clips is told of them together: each is told what it is told alone, by few operations."""

import math
import warnings
from dataclasses import dataclass, replace

import pytest
import torch
from method_clips import CASES, WALK, tracks_of
from numerics import count_operations, normal, turning
from torch.testing import assert_close

from kcs_torch import KCS, OptionError, ShapeError
from kcs_torch.data import walking_person
from kcs_torch.errors import NotFiniteError
from kcs_torch.methods import base
from kcs_torch.methods.answer import finish
from kcs_torch.methods.base import Estimate, Method

UP = torch.tensor([1.0, -1.0]).double()


def walk(frames, **options):
    return walking_person(frames, generator=torch.Generator().manual_seed(frames), **options).tracks


def film():
    """Two shots of a walk, from other sides."""
    shots = [walking_person(24, yaw=yaw, turn=0.0).tracks for yaw in (0.0, 110.0)]
    return replace(shots[0], points=torch.cat([one.points for one in shots]), weights=torch.ones(48, 17).double())


def stretching():
    """A body that stands still, but for a wrist that comes and goes."""
    points = WALK[:1].repeat(35, 1, 1)
    points[:, 16] += 300 * torch.linspace(0, 6, 35)[:, None].sin()
    return tracks_of(points)


LOT = [
    walk(30, turn=150.0),
    walk(1),
    walk(33, turn=60.0, missing=0.6),
    film(),
    stretching(),
    walk(25, turn=90.0, noise=3.0).to(torch.float32),
    walk(36, turn=90.0, skeleton="coco17"),
    tracks_of(WALK * UP),  # upside down
    tracks_of(WALK.flip(-1)),  # lies
    tracks_of(WALK.flip(1)),  # joints in another order
    walk(28, turn=90.0, noise=60.0),
    *(make() for make in CASES.values()),
]


@dataclass(frozen=True)
class Drawn(Method):
    """Depths are drawn, x and y those of the tracks: the cheapest method, whose solutions have all that they may."""

    name = "drawn"

    def solve(self, tracks, cameras):
        frames = tracks.num_frames
        clear = frames % 2 == 0
        found = [self.one(tracks, seed) for seed in range(1 + frames % 3)]
        notes = (f"{frames} frames",)
        return replace(
            found[0], alternatives=tuple(found[1:]), notes=notes, converged=clear, doubt="" if clear else "odd: a guess"
        )

    def one(self, tracks, seed):
        depth = normal(tracks.num_joints, seed=seed).to(tracks.points).expand(tracks.weights.shape)
        image = tracks.points.clone()
        image[:, 0] += tracks.num_frames % 7 == 0  # a joint that is elsewhere
        points = torch.cat([image, depth[..., None]], -1)
        cameras = turning(tracks.num_frames, 40.0 * tracks.num_joints % 90)[:, :2].to(points)
        scales = torch.linspace(0.9, 1.1, tracks.num_frames).to(points)
        deviation = None if tracks.num_frames % 5 == 0 else depth.abs()
        return Estimate(points, cameras, scales, True, 3, deviation=deviation, still=tracks.num_frames % 3 > 0)


class OneByOne(KCS):
    """Whose solutions are not those of a batch, which differ by more than rounding."""

    solve_all = Method.solve_all


def told(make):
    """What is made, with the warnings, in their order."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        return make(), [str(one.message) for one in said]


def same(one, alone):
    """Check that two results are the same up to rounding."""
    ours, expected = one.diagnostics, alone.diagnostics
    assert (ours.notes, ours.doubt, ours.loosest_bone) == (expected.notes, expected.doubt, expected.loosest_bone)
    assert (ours.converged, ours.iterations) == (expected.converged, expected.iterations)
    fine = 1e-9 if one.points.dtype == torch.float64 else 1e-4
    for name in ("viewpoint_turn", "unseen_share", "bone_variation", "reprojection_rms", "largest_bone_variation"):
        assert getattr(ours, name) == pytest.approx(getattr(expected, name), rel=fine, abs=fine**2, nan_ok=True)
    for name in ("points", "cameras", "scales", "lengths", "uncertainty", "root_depth"):
        value, wanted = getattr(one, name), getattr(alone, name)
        assert (value is None) == (wanted is None)
        if value is not None:
            assert_close(value, wanted, rtol=fine, atol=fine * max(wanted.abs().flatten().tolist(), default=0.0))
            assert not value.is_inference()
            if name in ("points", "lengths"):  # they hold no batch
                assert value.untyped_storage().nbytes() == value.nbytes
    assert len(one.alternatives) == len(alone.alternatives)
    for ours, expected in zip(one.alternatives, alone.alternatives, strict=True):
        same(ours, expected)


@pytest.mark.parametrize("room", [base.FRAMES, 60], ids=["as they fit", "few together"])
@pytest.mark.parametrize("method, lot", [(Drawn(), LOT), (OneByOne(), LOT[:12])], ids=["drawn", "kcs"])
def test_each_clip_is_told_what_it_is_told_alone(method, lot, room, monkeypatch):
    """In any lot: lengths, skeletons and precisions, gaps, cuts, points, bodies that lie, solutions more than one."""
    alone, expected = told(lambda: [method(one) for one in lot])
    monkeypatch.setattr(base, "FRAMES", room)
    monkeypatch.setattr(finish, "FRAMES", room)
    found, said = told(lambda: method.many(lot))
    assert said == expected
    for one, other in zip(found, alone, strict=True):
        same(one, other)


def test_the_lot_is_told_of_much():
    """So that what is compared above is more than silence."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        every = [*Drawn().many(LOT), *OneByOne().many(LOT[:12])]
    notes = " | ".join(note for one in every for note in one.diagnostics.notes)
    for words in (
        *("the view jumps at frame 24", "lies on its side", "feet are above", "at one point", "has no bones"),
        *("lengths of rigid bones vary", "bone lengths vary by", "joints are away from", "hardly a body of skeleton"),
        *("in depth found from feet", "a single image", "no root depth", "the viewpoint turned by only"),
    ):
        assert words in notes, words


def test_telling_many_clips_takes_few_more_operations_than_one():
    """What is left clip by clip are copies, and what tracks say of themselves."""
    clips = [walk(n, turn=150.0, yaw=3.0 * n, missing=0.1) for n in range(24, 40)]
    method = KCS()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        parts = [method._normalised(one) for one in clips]
        found, sizes = method.solve_all([one for one, _ in parts]), [size for _, size in parts]
        alone, together = (
            count_operations(lambda k=k: method._finished(clips[:k], found[:k], sizes[:k], 0.0)).total for k in (1, 16)
        )
    assert together < 3 * alone


@pytest.mark.parametrize(
    "part, change, error, match",
    [
        (
            "points",
            lambda x: torch.where(torch.arange(len(x))[:, None, None] == 3, math.nan, x),
            NotFiniteError,
            "e 3$",
        ),
        (
            "cameras",
            lambda x: x * torch.linspace(1, 2, len(x))[:, None, None],
            ShapeError,
            "27 frames, the first .* is 1;",
        ),
        ("scales", lambda x: torch.where(torch.arange(len(x)) == 5, -x, x), ShapeError, "got -.* in frame 5$"),
        ("deviation", lambda x: x[1:], ShapeError, r"expected a tensor \(28, 17\), got \(27, 17\)"),
        ("points", lambda _: None, ShapeError, "points: expected a tensor .* got NoneType"),
    ],
)
def test_of_many_estimates_the_wrong_one_is_named_by_its_own_frame(part, change, error, match):
    class Wrong(Drawn):
        def solve(self, tracks, cameras):
            found = super().solve(tracks, cameras)
            return replace(found, **{part: change(getattr(found, part))}) if tracks.num_frames == 28 else found

    with pytest.raises(error, match=f"drawn: solve: {part}: ") as told:
        Wrong().many([walk(26), walk(28), walk(29)])
    assert told.match(match)


def test_what_is_no_estimate_is_refused_among_others():
    class Lost(Drawn):
        def solve(self, tracks, cameras):
            return super().solve(tracks, cameras) if tracks.num_frames > 26 else None

    with pytest.raises(OptionError, match="drawn: solve: expected an Estimate, got NoneType"):
        Lost().many([walk(27), walk(26)])


def test_no_clips_are_told_of():
    assert KCS().many([]) == [] and Drawn().many([]) == []
