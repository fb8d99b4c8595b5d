"""Training data: the module that makes batches of windows."""

import itertools
import json
import math
import re

import lightning
import numpy as np
import pytest
import torch
from training_samples import motion, write_motions

import kcs_torch as kt
from kcs_torch.data import walking_person
from kcs_torch.errors import FormatError, OptionError, ShapeError, SkeletonError
from kcs_torch.functional import bone_lengths
from kcs_torch.skeleton import SKELETONS
from kcs_torch.training import Batch, TracksDataModule


@pytest.fixture
def folder(tmp_path):
    return write_motions(tmp_path)


def module(folder, train=("*.npz",), **options):
    options = {"window": 10, "views": 3, "batch_size": 8, "up": "y", **options}
    return TracksDataModule(list(train), folder=folder, **options)


def same(a, b):
    return all(torch.equal(x, y) for x, y in zip(a, b, strict=True))


def test_a_batch_holds_windows_of_one_clip_each_and_their_truth(folder):
    data = module(folder, batch_size=5)
    data.setup("fit")
    items = data.sets["train"]
    assert len(items) == 8 * 6 * 3  # clips, windows, views
    drawn = torch.tensor([0, 4, 50, 100, 143])
    batch = items.batch(drawn, torch.ones(5, dtype=torch.bool))
    assert isinstance(batch, Batch) and batch.tracks.dtype == torch.float32
    assert batch.tracks.shape == (5, 10, 17, 2) and batch.points.shape == (5, 10, 17, 3)
    for k, item in enumerate(drawn.tolist()):
        window, view = divmod(item, 3)
        clip, place = divmod(window, 6)
        world = items.clips[clip].points[place * 10 : place * 10 + 10]
        torch.testing.assert_close(
            bone_lengths(batch.points[k], SKELETONS["h36m17"].bones), bone_lengths(world, SKELETONS["h36m17"].bones)
        )
        seen = world @ items.cameras[clip, view].mT
        torch.testing.assert_close(batch.points[k, ..., :2], seen[..., :2], atol=1e-2, rtol=0)
        torch.testing.assert_close(batch.points[k].diff(dim=1), seen.diff(dim=1), atol=1e-2, rtol=0)
    torch.testing.assert_close(batch.tracks, batch.points[..., :2], atol=1e-2, rtol=0)
    assert batch.points[..., 2].mean(-1).abs().max() < 1e-2
    assert (batch.labelled == 1).all() and (batch.pseudo == 0).all() and (batch.weights == 1).all()


def test_the_seed_makes_the_batches_and_nothing_else(folder):
    options = {"noise": 5.0, "occlusion": 0.2, "labelled": 0.25}
    data, twin, other = (module(folder, seed=seed, **options) for seed in (0, 0, 1))
    loaders = [one.train_dataloader() for one in (data, twin, other)]
    torch.manual_seed(123)  # the global generator has no say
    first = [list(loader) for loader in loaders]
    assert all(same(a, b) for a, b in zip(first[0], first[1], strict=True))
    assert not any(same(a, b) for a, b in zip(first[0], first[2], strict=True))
    second = list(loaders[0])
    assert not any(same(a, b) for a in first[0] for b in second)
    assert same(loaders[1].make(1, 7), second[7])  # reached at once
    state = torch.get_rng_state()
    next(iter(loaders[0]))
    assert torch.equal(state, torch.get_rng_state())


def test_a_finite_set_stays_the_same_and_fresh_cameras_do_not(folder):
    for fresh in (False, True):
        data = module(folder, noise=5.0, occlusion=0.2, fresh_cameras=fresh)
        loader = data.train_dataloader()
        windows = [{}, {}]
        for epoch in (0, 1):
            for batch in loader:
                for tracks, points in zip(batch.tracks, batch.points, strict=True):
                    key = tuple(bone_lengths(points[:1], [(0, 10), (3, 6)]).round().flatten().int().tolist())
                    windows[epoch].setdefault(key, set()).add(tuple(tracks[0, :2].flatten().tolist()))
        shared = set(windows[0]) & set(windows[1])
        assert len(shared) > 20
        kept = sum(bool(windows[0][key] & windows[1][key]) for key in shared)
        assert kept > 20 if not fresh else kept == 0


@pytest.mark.parametrize("share", [0.0, 0.001, 0.05, 0.25, 0.5, 1.0])
def test_the_labelled_share_is_exact(folder, share):
    data = module(folder, labelled=share, steps_per_epoch=60)
    total = 144
    expected = 3 * max(1, math.floor(share * 48)) if share else 0  # windows that share no frame, each from three views
    seen, blind = data.labelled_items, data.unlabelled_items
    assert len(seen) == expected and len(blind) == total - expected
    assert sorted([*seen.tolist(), *blind.tolist()]) == list(range(total))
    count = 0
    truths = set()
    for batch in data.train_dataloader():
        count += int(batch.labelled.sum())
        assert (batch.points[batch.labelled == 0] == 0).all()
        truths |= {tuple(p[0, :3].flatten().tolist()) for p in batch.points[batch.labelled == 1]}
    assert len(truths) == expected  # so many and no more truths were shown in 480 windows
    assert count == {0.0: 0, 1.0: 480}.get(share, 240)


@pytest.mark.parametrize(("window", "stride"), [(10, 3), (10, 1), (10, 17), (60, 10)])
@pytest.mark.parametrize("share", [0.0, 0.01, 0.1, 0.3, 0.7, 1.0])
def test_no_more_frames_than_the_labelled_share_show_their_truth(folder, window, stride, share):
    data = module(folder, window=window, stride=stride, labelled=share)
    data.setup("fit")
    cut = data.sets["train"]
    frames = cut.starts[:, None] + torch.arange(window)  # of each window
    shown = torch.zeros(len(cut.points), dtype=torch.bool)
    shown[frames[data.labelled_items // 3].flatten()] = True  # in any view
    count = len(frames.unique())
    limit = max(share * count, window if share else 0)
    assert limit - window < int(shown.sum()) <= limit
    inside = shown[frames].all(1)  # all that shows its truth in every frame is labelled, from all views
    for items, kind in ((data.labelled_items, inside), (data.unlabelled_items, ~inside)):
        assert sorted(items.tolist()) == kind.repeat_interleave(3).nonzero()[:, 0].tolist()
    if share == 1:
        assert inside.all()


@pytest.mark.parametrize("stride", [3, 10])
def test_smaller_shares_are_among_greater_ones(folder, stride):
    options = {"stride": stride}
    chosen = [set(module(folder, labelled=s, **options).labelled_items.tolist()) for s in (0.01, 0.05, 0.25, 1.0)]
    assert all(a < b for a, b in itertools.pairwise(chosen))
    other = set(module(folder, labelled=0.25, seed=1, **options).labelled_items.tolist())
    assert other != chosen[2]
    views = {item % 3 for item in chosen[2]}
    assert views == {0, 1, 2}


def test_batches_mix_as_asked(folder):
    for per, expected in ((0.25, 2), (0.5, 4), (0.01, 1), (0.999, 7), (0.0, 0), (1.0, 8)):
        batch = next(iter(module(folder, labelled=0.1, labelled_per_batch=per).train_dataloader()))
        assert batch.labelled.tolist() == [1.0] * expected + [0.0] * (8 - expected)


def test_few_labelled_windows_come_equally_often(folder):
    data = module(folder, labelled=0.02, steps_per_epoch=9)  # one from three views, 4 in each batch
    assert len(data.labelled_items) == 3
    drawn = [tuple(p[0, 0].tolist()) for batch in data.train_dataloader() for p in batch.points[batch.labelled == 1]]
    assert sorted(drawn.count(key) for key in set(drawn)) == [12, 12, 12]


def test_without_unlabelled_windows_the_steps_stay(folder):
    both, alone = module(folder, labelled=0.1), module(folder, labelled=0.1, unlabelled=False)
    assert torch.equal(both.labelled_items, alone.labelled_items)
    assert len(both.train_dataloader()) == len(alone.train_dataloader()) == 18
    assert all((batch.labelled == 1).all() for batch in alone.train_dataloader())


@pytest.fixture
def detections(folder):
    """A clip of 2D tracks, at twice the rate and of other joints, in which nothing is seen for a while."""
    tracks = walking_person(80, skeleton="coco17", fps=60).tracks
    points = tracks.points[:, :17].clone()
    points[40:44] = math.nan
    kt.save(kt.Tracks.from_arrays(points, skeleton="coco17", fps=60, units="px"), folder / "own" / "walk.npz")
    return folder


@pytest.mark.parametrize(("labelled", "unlabelled"), [(1.0, True), (0.5, True), (0.5, False)])
def test_own_tracks_stand_among_the_windows_without_truth(detections, labelled, unlabelled):
    data = module(detections, tracks="own/*.npz", labelled=labelled, unlabelled=unlabelled, batch_size=6)
    data.setup("fit")
    windows = data.detected
    assert windows.starts.tolist() == [0, 10, 30] and windows.tracks.shape == (40, 17, 2)
    names = data.skeleton.joints
    assert not windows.weights[0, names.index("spine")] and windows.weights[0, names.index("left_knee")] == 1
    every = windows.batch(torch.arange(3)).tracks
    filmed, own = 0, 0
    for _ in range(3):
        for batch in data.train_dataloader():
            assert batch.labelled.tolist() == [1.0] * 3 + [0.0] * 3
            assert not batch.points[3:].any() and not batch.pseudo[3:].any()
            for tracks in batch.tracks[3:]:
                mine = bool((every == tracks).all(-1).all(-1).all(-1).any())
                own, filmed = own + mine, filmed + (not mine)
    assert own and bool(filmed) == (labelled < 1 and unlabelled)


def test_own_tracks_may_be_all_that_is_trained_on(detections):
    data = module(detections, tracks=["own/*"], labelled=0, unlabelled=False, batch_size=2, steps_per_epoch=3)
    data.setup("fit")
    drawn = torch.cat([batch.tracks for batch in data.train_dataloader()])
    assert len(drawn.unique(dim=0)) == 3


def test_own_tracks_are_read_as_is_asked(folder):
    """MediaPipe's files without the image's size, and VideoPose3D's, which are pickles."""
    points = walking_person(20, skeleton="mediapipe33").tracks.points[:, :33]
    shares = (points - points.amin((0, 1))) / (points.amax((0, 1)) - points.amin((0, 1)))
    frames = [{"pose_landmarks": [{"x": x, "y": y, "visibility": 0.9} for x, y in frame]} for frame in shares.tolist()]
    (folder / "shares.json").write_text(json.dumps(frames))
    pixels = walking_person(20, skeleton="h36m17").tracks.points[:, :17].numpy() / 10 + 500
    np.savez(folder / "pickled.npz", positions_2d={"S1": {"Walk": [pixels]}})
    for tracks, reading in (("shares.json", {"image_size": [1920, 1080]}), ("pickled.npz", {"trust": True})):
        with pytest.raises(FormatError, match=tracks):
            TracksDataModule(folder=folder, tracks=tracks, window=5, skeleton="h36m17").setup("fit")
        data = TracksDataModule(folder=folder, tracks=tracks, reading=reading, window=5, skeleton="h36m17")
        data.setup("fit")
        assert len(data.detected)
    with pytest.raises(OptionError, match="unknown reading option 'imagesize': did you mean 'image_size'"):
        TracksDataModule(reading={"imagesize": (1, 1)})
    with pytest.raises(OptionError, match="data: reading: expected options of load_tracks"):
        TracksDataModule(reading="trust")


def test_own_tracks_that_do_not_fit_are_told(detections):
    def told(error, match, **options):
        with pytest.raises(error, match=match):
            module(detections, **{"tracks": "own/*.npz", **options}).setup("fit")

    told(OptionError, "expected files of 2D tracks that match none", tracks="none")
    told(ShapeError, r"walk\.npz: expected at least a window of 41 frames, got 40", window=41)
    told(FormatError, r"walk\.npz: none of its windows of 30 frames has half of the joints", window=30)
    told(OptionError, "batch_size: expected at least 2", batch_size=1)


def test_validation_and_test_show_everything_once_to_the_end(folder):
    data = module(folder, ["s[12]_*.npz"], val="s3_*.npz", test="s4_*.npz", window=25, labelled=0.1, noise=3.0)
    for loader in (data.val_dataloader(), data.test_dataloader()):
        batches = list(loader)
        again = list(loader)
        assert all(same(a, b) for a, b in zip(batches, again, strict=True))
        assert sum(len(b.tracks) for b in batches) == 2 * 3 * 3  # two clips, windows from 0, 25 and 35, three views
        assert all((b.labelled == 1).all() for b in batches) and len(batches) == len(loader) == 3
    last = data.sets["val"]
    assert last.starts.tolist() == [0, 25, 35, 60, 85, 95]
    assert data.sets["train"].starts.tolist() == [60 * c + s for c in range(4) for s in (0, 25)]
    sources = {split: {c.source for c in data.sets[split].clips} for split in ("train", "val", "test")}
    assert not sources["train"] & sources["val"] and not sources["test"] & (sources["train"] | sources["val"])


def test_splits_do_not_share_files(folder):
    data = module(folder, ["s1_*.npz"], test=["*.npz"])
    with pytest.raises(OptionError, match=r"s1_a\.npz is in train and in test"):
        data.setup("fit")


@pytest.mark.parametrize("spelled", ["{folder}/s1_a.npz", "../{folder.name}/s1_a.npz", "link/s1_a.npz"])
def test_splits_do_not_share_files_by_other_paths(folder, spelled):
    (folder / "link").symlink_to(folder)
    pattern = spelled.format(folder=folder)
    with pytest.raises(OptionError, match=r"s1_a\.npz is in train and in val"):
        module(folder, ["*.npz"], val=pattern).setup("fit")
    data = module(folder, ["*.npz", f"!{pattern}"], val=pattern)
    data.setup("fit")
    assert len(data.sets["train"].clips) == 7 and len(data.sets["val"].clips) == 1


def test_own_tracks_are_of_no_clip_that_is_measured_on(folder):
    """A file of a result holds both."""
    clip = walking_person(30, skeleton="coco17", turn=60)
    kt.reconstruct(clip.tracks, method="kcs").scaled(units="mm", factor=1.0).save(folder / "both.npz")
    for split in ("val", "test"):
        data = TracksDataModule(tracks="both.npz", **{split: "both.npz"}, folder=folder, skeleton="coco17", window=5)
        with pytest.raises(OptionError, match=rf"both\.npz is in {split} and in tracks"):
            data.setup("fit")
    TracksDataModule("both.npz", tracks="both.npz", folder=folder, skeleton="coco17", window=5).setup("fit")


def test_setup_reads_what_a_stage_needs(folder):
    data = module(folder, ["s1_*.npz"], val="s2_*.npz", test="s3_*.npz", skeleton="h36m17")
    data.setup("test")
    assert set(data.sets) == {"test"}
    data.setup("fit")
    before = data.sets["train"]
    data.setup(None)
    assert set(data.sets) == {"train", "val", "test"} and data.sets["train"] is before
    assert module(folder).val_dataloader() == []


def test_made_up_motion_needs_no_files():
    data = TracksDataModule(clips=2, window=27, batch_size=16, skeleton="coco17", noise=2.0)
    data.setup()
    batch = next(iter(data.train_dataloader()))
    assert batch.tracks.shape == (16, 27, 19, 2) and data.skeleton.name == "coco17"
    body = batch.points.flatten(1, 2)
    tall = body[..., 1].amax(1) - body[..., 1].amin(1)
    assert tall.min() > 800 and tall.max() < 4500  # mm
    assert len(data.val_dataloader()) and len(data.test_dataloader())
    splits = [data.sets[s].clips[0].points for s in ("train", "val", "test")]
    assert not torch.equal(splits[0], splits[1]) and not torch.equal(splits[1], splits[2])
    assert TracksDataModule(clips=2, units="m", window=9).train_dataloader().make(0, 0).points.abs().max() < 5


def test_windows_without_truth_are_left_out(tmp_path):
    whole = motion(60)
    points = whole.points.clone()
    points[22, 3] = math.nan
    kt.Motion.from_arrays(points, skeleton="h36m17", fps=30, units="mm").save(tmp_path / "a.npz")
    data = module(tmp_path)
    data.setup("fit")
    assert data.sets["train"].starts.tolist() == [0, 10, 30, 40, 50]
    with pytest.raises(FormatError, match=r"none of its windows of 45 frames has all joints; gaps in left_hip|right_"):
        module(tmp_path, window=45).setup("fit")


def test_what_files_may_not_be(folder, tmp_path):
    with pytest.raises(OptionError, match=r"match none\*\.npz"):
        module(folder, ["none*.npz"]).setup("fit")
    with pytest.raises(ShapeError, match=r"s1_a\.npz: expected at least a window of 61 frames, got 60.*!"):
        module(folder, window=61).setup("fit")
    with pytest.raises(SkeletonError, match="h36m71"):
        module(folder, skeleton="h36m71").setup("fit")
    with pytest.raises(SkeletonError, match="hand21"):
        module(folder, skeleton="hand21").setup("fit")
    other = tmp_path / "other"
    motion(60, skeleton="hand21").save(other / "a.npz")
    motion(60).save(other / "b.npz")
    with pytest.raises(SkeletonError, match=r"b\.npz: expected the joints of .*a\.npz"):
        module(other).setup("fit")
    (other / "c.npz").write_bytes(b"no motion at all")
    with pytest.raises(FormatError, match=r"c\.npz"):
        module(other, ["c.npz"]).setup("fit")
    silent = motion(60)
    kt.Motion.from_arrays(silent.points, skeleton="h36m17", units="mm").save(other / "d.npz")
    with pytest.raises(FormatError, match=r"d\.npz: its frame rate is unknown: give file_fps=.*, or fps=None"):
        module(other, ["d.npz"]).setup("fit")
    module(other, ["d.npz"], fps=None).setup("fit")
    half = module(other, ["d.npz"], file_fps=60.0)
    half.setup("fit")
    assert len(half.sets["train"].points) == 30


@pytest.mark.parametrize("options", [
    {"window": 0}, {"stride": 0}, {"views": 0}, {"noise": -1.0}, {"noise": math.nan}, {"occlusion": 1.0},
    {"labelled": 1.5}, {"labelled": -0.1}, {"labelled_per_batch": 2.0}, {"pitch": (20, 0)}, {"fps": 0.0},
    {"pitch": (20,)}, {"pitch": (0, "b")},
    {"batch_size": 0}, {"steps_per_epoch": 0}, {"pseudo_trust": 0.0}, {"clips": 0},
    {"labelled": 0.5, "batch_size": 1}, {"labelled": 0.0, "unlabelled": False},
    {"pseudo": "pck"}, {"pseudo": "pkc", "fresh_cameras": True},
], ids=str)  # fmt: skip
def test_options_out_of_range(options):
    with pytest.raises(OptionError, match=next(iter(reversed(options)))):
        TracksDataModule(**options)


@pytest.mark.parametrize("value", ["a", [1], math.nan, True, 1.5], ids=str)
@pytest.mark.parametrize("name", ["window", "stride", "views", "batch_size", "steps_per_epoch", "clips", "seed"])
def test_what_is_no_whole_number_is_told_by_its_name(name, value):
    with pytest.raises(OptionError, match=rf"data: {name}: expected a whole number.*, got {re.escape(repr(value))}"):
        TracksDataModule(**{name: value})


@pytest.mark.parametrize("value", ["a", [1], math.nan, True], ids=str)
@pytest.mark.parametrize("name", ["fps", "noise", "occlusion", "labelled", "labelled_per_batch", "pseudo_trust"])
def test_what_is_no_number_is_told_by_its_name(name, value):
    with pytest.raises(OptionError, match=rf"data: {name}: expected a .*, got {re.escape(repr(value))}"):
        TracksDataModule(**{name: value})


def test_what_is_no_method_makes_no_pseudo_labels():
    with pytest.raises(OptionError, match="data: pseudo: expected a method, its name or None, got 5"):
        TracksDataModule(pseudo=5)


class Counting(lightning.LightningModule):
    """A linear network that notes which batches it saw."""

    def __init__(self, joints=17):
        super().__init__()
        self.layer = torch.nn.Linear(2, 1)
        self.seen = []

    def training_step(self, batch, index):
        self.seen.append(float(batch.tracks.double().sum()))
        size = batch.tracks.abs().amax()
        return ((self.layer(batch.tracks / size)[..., 0] - batch.points[..., 2] / size).square()).mean()

    def validation_step(self, batch, index):
        self.log("val", batch.points.std())

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=0.1)


def trainer(folder, **options):
    quiet = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False, "accelerator": "cpu"}
    return lightning.Trainer(default_root_dir=folder, **quiet, **options)


@pytest.mark.filterwarnings("ignore:.*does not have many workers", "ignore:.*LeafSpec", "ignore:.*exists and is not")
@pytest.mark.parametrize("every", [3, 5, 6], ids=["within an epoch", "within the second", "at its end"])
def test_training_goes_on_from_a_checkpoint_as_if_it_had_not_stopped(folder, tmp_path, every):
    make = lambda: module(folder, ["s[1-3]*"], val="s4*", noise=5.0, labelled=0.5, batch_size=18)  # noqa: E731
    torch.manual_seed(0)
    whole, part = Counting(), Counting()
    part.load_state_dict(whole.state_dict())
    trainer(tmp_path, max_steps=14, enable_checkpointing=False).fit(whole, datamodule=make())
    saver = lambda: lightning.pytorch.callbacks.ModelCheckpoint(  # noqa: E731
        tmp_path / "kept", "{step}", every_n_train_steps=every, save_top_k=-1
    )
    trainer(tmp_path, max_steps=every, callbacks=[saver()]).fit(part, datamodule=make())
    resumed = Counting()
    (path,) = (tmp_path / "kept").glob("*.ckpt")
    trainer(tmp_path, max_steps=14, callbacks=[saver()]).fit(resumed, datamodule=make(), ckpt_path=path)
    assert part.seen == whole.seen[:every] and resumed.seen == whole.seen[every:]
    assert torch.equal(resumed.layer.weight, whole.layer.weight)
    assert len(set(whole.seen)) == 14


@pytest.mark.filterwarnings("ignore:.*does not have many workers", "ignore:.*LeafSpec", "ignore:You requested to over")
@pytest.mark.parametrize("fresh", [False, True])
def test_overfitting_shows_the_same_batches_in_every_epoch(folder, tmp_path, fresh):
    network = Counting()
    data = module(folder, ["s[1-3]*"], val="s4*", labelled=0.5, fresh_cameras=fresh)
    trainer(tmp_path, max_epochs=3, overfit_batches=2, enable_checkpointing=False).fit(network, datamodule=data)
    assert network.seen == network.seen[:2] * 3 and network.seen[0] != network.seen[1]
