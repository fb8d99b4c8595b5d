"""Training data: clips of files, cameras that film them, and the order in which they come."""

import math
from pathlib import Path

import pytest
import torch
from training_samples import motion, write_motions

import kcs_torch as kt
from kcs_torch.data import walking_person
from kcs_torch.errors import FormatError, KcsWarning, OptionError, SkeletonError
from kcs_torch.functional import bone_lengths, orbit
from kcs_torch.skeleton import SKELETONS
from kcs_torch.training import TracksDataModule
from kcs_torch.training.clips import file_clips, find_files, resampled, synthetic_clips
from kcs_torch.training.film import RUN, film, hidden, random_cameras
from kcs_torch.training.loader import BatchLoader, Deck
from kcs_torch.training.seeds import generator_of

CMU = Path(__file__).parents[2] / "shared" / "data" / "cmu"


@pytest.fixture
def folder(tmp_path):
    return write_motions(tmp_path)


# ---------------------------------------------------------------------- clips


def test_files_by_patterns(folder):
    names = lambda patterns: [p.name for p in find_files(patterns, folder)]  # noqa: E731
    assert names("s1_*.npz") == ["s1_a.npz", "s1_b.npz"]
    assert names(["*.npz", "!s[1-3]_*"]) == ["s4_a.npz", "s4_b.npz"]
    assert names(["s2_a.npz", "s1_a.npz", "s2_*"]) == ["s1_a.npz", "s2_a.npz", "s2_b.npz"]
    assert names(["*.npz", f"!{folder}/s[1-3]_*"]) == ["s4_a.npz", "s4_b.npz"]
    assert names(["s1_*.npz", f"{folder}/s1_a.npz"]) == ["s1_a.npz", "s1_b.npz"]
    with pytest.raises(OptionError, match=r"pattern !s5_\*: expected it to leave out some"):
        names(["*.npz", "!s1_*", "!s5_*"])
    for patterns in ("none*.npz", ["*.npz", "!*"], []):
        with pytest.raises(OptionError, match="found none"):
            find_files(patterns, folder)


def test_the_folder_is_no_pattern(tmp_path):
    folder = write_motions(tmp_path / "take [1]*")
    assert [p.name for p in find_files(["s1_*.npz", "!s1_b*"], folder)] == ["s1_a.npz"]


def test_a_clip_is_what_the_motion_is_from_the_front(folder):
    (clip,) = file_clips([folder / "s1_a.npz"], skeleton=None, fps=30, up="y", units="mm")
    torch.testing.assert_close(clip.points, motion(60).in_camera().float(), atol=1e-2, rtol=0)
    assert clip.known.all() and clip.skeleton == SKELETONS["h36m17"]


def test_files_of_another_rate_unit_and_order(tmp_path):
    fast = motion(61, fps=60.0)
    fast.scaled(units="m", factor=0.001).save(tmp_path / "a.npz")
    (clip,) = file_clips([tmp_path / "a.npz"], skeleton="h36m17", fps=30, up="y", units="mm")
    assert clip.points.shape == (31, 17, 3)
    expected = fast.in_camera()[::2].float()
    far = (clip.points - clip.points.mean((0, 1))) - (expected - expected.mean((0, 1)))
    assert far.abs().max() < 0.02


def test_names_of_another_body_are_refused_and_no_names_are_told(tmp_path):
    """As many joints as the skeleton has, in their order: only who knows the file can say whether they are these."""
    points = motion(12, skeleton="cmu21").points
    read = lambda name: file_clips([tmp_path / name], skeleton="hand21", fps=30, up="y", units="mm")  # noqa: E731
    kt.save(kt.Motion.from_arrays(points, skeleton="cmu21", fps=30, units="mm"), tmp_path / "named.npz")
    with pytest.raises(
        SkeletonError, match=r"named\.npz: expected the joints of skeleton 'hand21', .* they are pelvis"
    ):
        read("named.npz")
    kt.save(kt.Motion.from_arrays(points, fps=30, units="mm"), tmp_path / "numbers.npz")
    with pytest.warns(KcsWarning, match=r"numbers\.npz: joints taken in their order as those of skeleton 'hand21'"):
        assert len(read("numbers.npz")) == 1


def test_bodies_on_their_heads_are_told(tmp_path):
    walk = kt.Motion.from_arrays(walking_person(40).points, up="-y", skeleton="h36m17", fps=30, units="mm")
    for name, up in (("right", "y"), ("wrong", "-y")):
        kt.Motion.from_arrays(walk.points, up=up, skeleton="h36m17", fps=30, units="mm").save(tmp_path / f"{name}.npz")
    read = lambda name, up: file_clips(  # noqa: E731
        [tmp_path / f"{name}.npz"], skeleton=None, fps=30, up=up, units="mm"
    )
    read("right", None)
    with pytest.warns(KcsWarning, match=r"wrong\.npz: the body stands on its head: say which axis"):
        read("wrong", None)
    read("wrong", "y")  # as was asked for


def test_bvh_files_of_one_skeleton(tmp_path):
    walk = kt.Motion.from_arrays(walking_person(40).points, up="-y", skeleton="h36m17", fps=30, units="mm")
    walk.save(tmp_path / "a.bvh")
    options = {"skeleton": "h36m17", "fps": 30, "up": None, "units": "mm"}
    with pytest.raises(FormatError, match=r"a\.bvh: expected a unit of length.*file_units"):
        file_clips([tmp_path / "a.bvh"], **options)
    (clip,) = file_clips([tmp_path / "a.bvh"], **options, file_units="cm")
    length = bone_lengths(clip.points, clip.skeleton.bones).mean(0)
    true = bone_lengths(walk.points, clip.skeleton.bones).mean(0).float()
    torch.testing.assert_close(length, true, rtol=0.02, atol=2)


def test_what_is_said_of_files_holds_of_those_that_do_not_say(tmp_path):
    walk = kt.Motion.from_arrays(walking_person(40).points, up="-y", skeleton="h36m17", fps=30, units="mm")
    names = ["a.bvh", "b.trc", "c.npz"]
    for name in names:
        walk.save(tmp_path / name)
    files = [tmp_path / name for name in names]
    clips = file_clips(files, skeleton="h36m17", fps=30, up="y", units="mm", file_units="cm")
    body = clips[0].skeleton
    true = bone_lengths(walk.points, body.bones).mean(0).float()
    for clip in clips:
        torch.testing.assert_close(bone_lengths(clip.points, body.bones).mean(0), true, rtol=0.02, atol=2)
    (clip,) = file_clips(files[2:3], skeleton="h36m17", fps=30, up="z", units="mm")
    torch.testing.assert_close(clip.points, clips[2].points)


def test_tracks_sized_motion_is_no_motion_to_train_on(tmp_path):
    walk = kt.Motion.from_arrays(walking_person(40).points, up="-y", skeleton="h36m17", fps=30, units="px")
    walk.save(tmp_path / "a.npz")
    with pytest.raises(FormatError, match=r"a\.npz: expected a unit .*, got px: set its true size first"):
        file_clips([tmp_path / "a.npz"], skeleton="h36m17", fps=30, up=None, units="mm", file_units="cm")


def test_resampling_keeps_what_a_parabola_has():
    time = torch.arange(13.0, dtype=torch.float64)
    values = torch.stack([time, time**2, 3 - time + 0.5 * time**2], -1)[:, None]
    known = torch.ones(13, 1, dtype=torch.bool)
    for rate in (30.0, 20.0, 45.0, 60.0, 7.3):
        out, seen = resampled(values, known, 30.0, rate)
        at = torch.arange(len(out), dtype=torch.float64) * 30.0 / rate
        assert len(out) == math.floor(12 * rate / 30 + 1e-6) + 1 and seen.all()
        exact = torch.stack([at, at**2, 3 - at + 0.5 * at**2], -1)[:, None]
        inside = (at >= 1) & (at <= 11)  # cubic between four frames
        torch.testing.assert_close(out[inside], exact[inside])
        assert (out - exact).abs().max() <= 0.25  # linear at the ends: a quarter of what a parabola bends
    out, _ = resampled(values, known, 30.0, 30.0)
    assert torch.equal(out, values)


def test_resampling_keeps_gaps():
    values, known = torch.rand(9, 1, 3), torch.ones(9, 1, dtype=torch.bool)
    known[4] = False
    values[4] = math.nan
    out, seen = resampled(values, known, 30.0, 60.0)
    assert seen[:, 0].tolist() == [i not in (7, 8, 9) for i in range(17)]
    assert torch.isfinite(out).all() and (out[~seen] == 0).all()
    for i in (5, 6, 10, 11):
        low, high = values[i // 2], values[(i + 1) // 2]
        assert ((out[i] - (low + high) / 2).abs() < 0.5).all()


def test_made_up_motion_has_rigid_bones_and_the_seed_alone_makes_it():
    for name in ("h36m17", "coco17", "hand21"):
        first = synthetic_clips(4, skeleton=name, fps=30, units="mm", seed=3, split="train", num_frames=40)
        again = synthetic_clips(4, skeleton=name, fps=30, units="mm", seed=3, split="train", num_frames=40)
        other = synthetic_clips(4, skeleton=name, fps=30, units="mm", seed=4, split="train", num_frames=40)
        for a, b, c in zip(first, again, other, strict=True):
            assert torch.equal(a.points, b.points) and not torch.equal(a.points, c.points)
            length = bone_lengths(a.points, a.skeleton.bones)[:, list(a.skeleton.rigid)]
            real = length.mean(0) > 1
            assert ((length.std(0) / length.mean(0))[real] < 0.01).float().mean() > 0.8  # but for virtual joints'
    heights = [c.points[..., 1].max() - c.points[..., 1].min() for c in first[::2]]
    assert heights[0] != heights[1]


# ---------------------------------------------------------------------- film


def test_cameras_stand_on_all_sides_and_look_down_as_asked():
    cameras = random_cameras((4000,), (5.0, 25.0), generator_of(0))
    eye = torch.eye(3).expand(4000, 3, 3)
    torch.testing.assert_close(cameras @ cameras.mT, eye, atol=1e-5, rtol=0)
    assert (torch.linalg.det(cameras) > 0).all()
    down = torch.rad2deg(torch.asin(cameras[:, 2, 1]))  # the vertical as seen along the line of sight
    assert 5 <= down.min() < 5.1 and 24.9 < down.max() <= 25
    assert (cameras[:, 0, 1].abs() < 1e-6).all()  # no roll
    yaw = torch.atan2(cameras[:, 0, 2], cameras[:, 0, 0])
    assert abs(yaw.cos().mean()) < 0.05 and abs(yaw.sin().mean()) < 0.05 and abs((2 * yaw).cos().mean()) < 0.05
    one = random_cameras((1,), (12.0, 12.0), generator_of(1))[0]
    yaw = torch.rad2deg(torch.atan2(-one[0, 2], one[0, 0]))
    torch.testing.assert_close(one, orbit(yaw, 12.0))


@pytest.mark.parametrize("share", [0.1, 0.4])
def test_hidden_joints_are_as_many_as_asked_from_the_first_frame_on(share):
    gone = hidden((300, 40, 20), share, generator_of(0)).float()
    assert abs(gone.mean() - share) < 0.01
    assert (gone.mean((0, 2)) - share).abs().max() < 0.03  # in every frame
    assert (gone.mean((0, 1)) - share).abs().max() < 0.03  # of every joint
    alone = (gone[:, 1:-1] * (1 - gone[:, :-2]) * (1 - gone[:, 2:])).mean() / share
    long = gone.unfold(1, RUN, 1).amin(-1).mean() / share
    assert alone > 0.15 and long > 0.03  # single frames and runs
    assert long > 20 * share ** (RUN - 1)  # which independent frames would hardly give


def test_film_projects_adds_noise_and_hides():
    body = SKELETONS["coco17"]
    points = 100 * torch.randn(50, 30, body.num_joints, 3)
    cameras = random_cameras((50,), (0, 20), generator_of(0))
    clean, weights = film(points, cameras, body, noise=0, occlusion=0, generator=generator_of(1))
    assert (weights == 1).all()
    exact = torch.einsum("bij,btnj->btni", cameras, points)[..., :2]
    seen = body.num_observed
    torch.testing.assert_close(clean[..., :seen, :], exact[..., :seen, :], atol=1e-3, rtol=1e-5)
    for joint, sources in body.virtual:  # as of tracks, whatever the motion says
        torch.testing.assert_close(clean[..., joint, :], clean[..., list(sources), :].mean(-2), atol=1e-3, rtol=0)
    noisy, weights = film(points, cameras, body, noise=7.0, occlusion=0.2, generator=generator_of(1))
    error = (noisy - clean)[..., :seen, :][weights[..., :seen] > 0]
    assert abs(error.std() - 7) < 0.1 and abs(error.mean()) < 0.1
    assert (noisy[weights == 0] == 0).all() and abs((weights[..., :seen] == 0).float().mean() - 0.2) < 0.01
    for joint, sources in body.virtual:
        assert torch.equal(weights[..., joint], weights[..., list(sources)].amin(-1))


# ---------------------------------------------------------------------- order


def test_a_deck_shows_every_card_once_before_any_twice():
    deck = Deck(torch.arange(7) + 10, "key")
    long = deck.draw(0, 70)
    for turn in long.split(7):
        assert sorted(turn.tolist()) == list(range(10, 17))
    assert len({tuple(turn.tolist()) for turn in long.split(7)}) > 5
    parts = torch.cat([deck.draw(start, 5) for start in range(0, 70, 5)])
    assert torch.equal(parts, long)
    assert torch.equal(Deck(torch.arange(7) + 10, "key").draw(31, 20), long[31:51])
    assert not torch.equal(Deck(torch.arange(7) + 10, "other").draw(0, 70), long)
    assert len(deck.draw(3, 0)) == 0


def numbered(steps, **options):
    return BatchLoader(lambda epoch, step: (epoch, step), steps, **options)  # type: ignore[arg-type,return-value]


def test_a_loader_goes_from_epoch_to_epoch():
    loader = numbered(3)
    assert list(loader) == [(0, 0), (0, 1), (0, 2)] and list(loader) == [(1, 0), (1, 1), (1, 2)]
    for batch in loader:
        if batch == (2, 1):
            break
    assert list(loader) == [(2, 0), (2, 1), (2, 2)]  # an epoch that was left begins anew
    loader.set_epoch(9)
    assert next(iter(loader)) == (9, 0)
    assert list(numbered(2, fixed=True)) * 2 == [*(f := numbered(2, fixed=True)), *f]


def test_a_loader_goes_on_where_it_was():
    loader = numbered(3)
    every = [*loader, *loader, *loader]
    for done in range(9):
        first, second = numbered(3), numbered(3)
        got, left = [], done
        while left > 0:
            for batch in first:
                got.append(batch)
                left -= 1
                if left == 0:
                    break
        second.load_state_dict(first.state_dict())
        rest = [*second, *second, *second]
        assert (got + rest)[:9] == every


def test_processes_deal_out_the_batches_of_an_epoch(monkeypatch):
    dealt = []
    for rank in (0, 1):
        monkeypatch.setattr("kcs_torch.training.loader._rank", lambda rank=rank: (rank, 2))
        loader = numbered(7)
        assert len(loader) == 3
        dealt.append([*loader, *loader])
        assert len(numbered(7, fixed=True)) == 7  # validation is everybody's
    assert dealt[0] == [(e, s) for e in (0, 1) for s in (0, 2, 4)]
    assert dealt[1] == [(e, s) for e in (0, 1) for s in (1, 3, 5)]


def test_generators_differ_by_their_key():
    draw = lambda *key: torch.rand(4, generator=generator_of(*key)).tolist()  # noqa: E731
    assert draw(1, "a") == draw(1, "a")
    assert len({tuple(draw(*key)) for key in [(1, "a"), (1, "b"), (2, "a"), (1, "a", 0), (11, "a"), (1, "1a")]}) == 6


# ---------------------------------------------------------------------- real motion


@pytest.mark.skipif(not CMU.is_dir(), reason="needs the CMU motion files beside the project")
def test_cmu_motion_by_subjects():
    data = TracksDataModule(
        ["cmu/*.npz", "cmu_cs2s/*.npz", "!cmu/cmu_35*"],
        test="cmu/cmu_35*.npz",
        folder=CMU.parent,
        skeleton="cmu17",
        up="y",
        noise=5.0,
    )
    data.setup()
    assert len(data.sets["train"].clips) == 21 and len(data.sets["test"].clips) == 13
    batch = next(iter(data.train_dataloader()))
    head, ankle = data.skeleton.index("head_top"), data.skeleton.index("l_ankle")
    upright = batch.points[:, :, head, 1] < batch.points[:, :, ankle, 1]  # y down
    assert upright.float().mean() > 0.9
    length = bone_lengths(batch.points, data.skeleton.bones)
    assert (length.std(1) / length.mean(1)).max() < 0.05
