from dataclasses import dataclass, replace
from typing import ClassVar

import pytest
import torch

import kcs_torch as kt
from kcs_torch.data import random_motion
from kcs_torch.errors import KcsWarning, OptionError
from kcs_torch.methods.base import Estimate
from kcs_torch.training import Lifter, TracksDataModule

CALLS: list[tuple[str, int]] = []


@dataclass(frozen=True)
class Slanted(kt.Method):
    """Depth is a share of x; its uncertainty is the joint's number, in per cent of the body's size."""

    name: ClassVar[str] = "slanted"
    slope: float = 0.5
    certain: bool = False
    fails: bool = False

    def solve(self, tracks, cameras):
        CALLS.append((tracks.source, tracks.num_frames))
        if self.fails and "view 1" in tracks.source:
            raise OptionError("slanted: cannot")
        points = torch.cat([tracks.points, 3 + self.slope * tracks.points[..., :1]], -1)
        rows = torch.eye(3, dtype=points.dtype)[:2].expand(len(points), 2, 3)
        joint = torch.arange(points.shape[1], dtype=points.dtype) / 100
        spread = None if self.certain else joint.expand(points.shape[:2])
        return Estimate(points, rows, torch.ones_like(points[:, 0, 0]), True, 1, deviation=spread)


@pytest.fixture
def folder(tmp_path):
    CALLS.clear()
    for i in range(3):
        clip = random_motion("h36m17", 40, generator=torch.Generator().manual_seed(i), size=4000.0)
        kt.Motion.from_arrays(clip.points, up="-y", skeleton="h36m17", fps=30, units="mm").save(tmp_path / f"{i}.npz")
    return tmp_path


def module(folder, **options):
    options = {"labelled": 0.2, "pseudo": Slanted(), "window": 10, "views": 2, "batch_size": 12, "up": "y", **options}
    return TracksDataModule("*.npz", folder=folder, **options)


def batch_of(data):
    data.setup("fit")
    return next(iter(data.train_dataloader()))


def test_unlabelled_windows_have_what_the_method_makes_of_whole_clips(folder):
    data = module(folder, noise=4.0)
    batch = batch_of(data)
    assert sorted(CALLS) == sorted((f"{folder / f'{c}.npz'}, view {v}", 40) for c in range(3) for v in range(2))
    blind = batch.labelled == 0
    assert blind.sum() == 6
    # x, y are those of the tracks, noise and all; depth is half of x, from the mean of each frame.
    points, tracks = batch.points[blind], batch.tracks[blind]
    torch.testing.assert_close(points[..., :2], tracks, atol=0.05, rtol=1e-4)
    depth = 0.5 * tracks[..., 0]
    torch.testing.assert_close(points[..., 2], depth - depth.mean(-1, keepdim=True), atol=0.05, rtol=1e-4)


def test_labelled_windows_have_their_truth_and_no_pseudo_label(folder):
    plain, both = batch_of(module(folder, pseudo=None)), batch_of(module(folder))
    seen = both.labelled == 1
    for a, b in ((plain.tracks, both.tracks), (plain.labelled, both.labelled), (plain.weights, both.weights)):
        assert torch.equal(a, b)  # the rest does not depend on it
    assert torch.equal(plain.points[seen], both.points[seen]) and (both.pseudo[seen] == 0).all()
    assert (plain.points[~seen] == 0).all() and (plain.pseudo == 0).all()
    assert (both.pseudo[~seen] > 0).all() and (both.pseudo <= 1).all()


def test_weights_fall_with_uncertainty(folder):
    data = module(folder, pseudo_trust=0.08)
    batch = batch_of(data)
    joint = torch.arange(17) / 100
    expected = 1 / (1 + (joint / 0.08) ** 2)  # a half at the joint whose uncertainty is 8 per cent
    for weights in batch.pseudo[batch.labelled == 0]:
        torch.testing.assert_close(weights, expected.expand(10, 17), atol=2e-3, rtol=0)
    sure = batch_of(module(folder, pseudo=Slanted(certain=True)))
    assert (sure.pseudo[sure.labelled == 0] == 1).all()


def test_the_truth_is_not_asked(folder):
    """Motion with another depth but the same tracks has the same pseudo-labels."""
    one, other = module(folder, labelled=0.0), module(folder, labelled=0.0)
    one.setup("fit")
    filmed = other._set("train")
    filmed.points = filmed.points + 1000 * torch.randn_like(filmed.points)
    other.setup("fit")
    assert torch.equal(one.sets["train"].pseudo_points, other.sets["train"].pseudo_points)
    assert torch.equal(one.sets["train"].pseudo_weights, other.sets["train"].pseudo_weights)


def test_what_was_made_is_kept(folder, tmp_path):
    cache = tmp_path / "cache" / "deep"
    first = module(folder, cache=cache)
    first.setup("fit")
    made = len(CALLS)
    assert made == len(list(cache.iterdir())) == 6
    again = module(folder, cache=cache, labelled=0.1)  # other labels, same tracks
    again.setup("fit")
    assert len(CALLS) == made
    assert torch.equal(again.sets["train"].pseudo_points, first.sets["train"].pseudo_points)
    assert torch.equal(again.sets["train"].pseudo_weights, first.sets["train"].pseudo_weights)
    for other in (
        {"pseudo": Slanted(slope=0.6)},
        {"noise": 1.0},
        {"seed": 1},
        {"occlusion": 0.1},
    ):
        before = len(CALLS)
        module(folder, cache=cache, **other).setup("fit")
        assert len(CALLS) == before + 6, other


def test_damaged_files_are_made_again(folder, tmp_path):
    cache = tmp_path / "cache"
    first = module(folder, cache=cache)
    first.setup("fit")
    files = sorted(cache.iterdir())
    files[0].write_bytes(files[0].read_bytes()[:100])
    files[1].write_bytes(b"")
    files[2].write_bytes(files[3].read_bytes()[:-30] + b"\0" * 30)
    CALLS.clear()
    again = module(folder, cache=cache)
    again.setup("fit")
    made = len(CALLS)
    assert made in (4, 6)  # both views of a clip, two clips or all
    assert torch.equal(again.sets["train"].pseudo_points, first.sets["train"].pseudo_points)
    module(folder, cache=cache).setup("fit")
    assert len(CALLS) == made


@dataclass(frozen=True)
class Crowded(Slanted):
    """Depth depends on how many clips are reconstructed together."""

    name: ClassVar[str] = "crowded"

    def solve_all(self, tracks):
        return [replace(self, slope=float(len(tracks))).solve(one, None) for one in tracks]


def test_what_is_kept_already_changes_nothing(folder, tmp_path):
    cache = tmp_path / "cache"
    found = []
    for labelled in (0.9, 0.2, 0.2):
        data = module(folder, cache=cache, labelled=labelled, pseudo=Crowded())
        data.setup("fit")
        found.append(data.sets["train"].pseudo_points)
        next(cache.iterdir()).unlink()
    without = module(folder, pseudo=Crowded())
    without.setup("fit")
    assert torch.equal(found[1], without.sets["train"].pseudo_points) and torch.equal(found[1], found[2])
    shown = found[0] != 0
    assert bool(shown.any()) and torch.equal(found[0][shown], found[1][shown])


def test_clips_that_fail_have_none_and_are_told(folder):
    data = module(folder, labelled=0.0, pseudo=Slanted(fails=True))
    with pytest.warns(KcsWarning, match="pseudo-labels: 3 of 6 clips have none: slanted: cannot"):
        data.setup("fit")
    weights = data.sets["train"].pseudo_weights
    assert (weights[1] == 0).all() and (weights[0] > 0).all()


def test_only_what_is_needed_is_reconstructed(folder):
    module(folder, labelled=1.0).setup("fit")
    module(folder, unlabelled=False).setup("fit")
    module(folder).setup("test")
    assert not CALLS
    nearly = module(folder, labelled=0.95)  # one window is left, of two views
    nearly.setup("fit")
    assert len(nearly.unlabelled_items) == 2 and len(CALLS) == 2


def test_a_method_by_name(folder):
    data = module(folder, pseudo="kcs", views=1)
    batch = batch_of(data)
    blind = batch.labelled == 0
    assert batch.pseudo[blind].max() > 0 and torch.isfinite(batch.points).all()
    assert batch.points[blind][..., 2].std() > 10


def test_networks_of_other_weights_are_other_methods(folder, tmp_path):
    torch.manual_seed(0)
    network = kt.nn.MLPLifter("h36m17", width=8)
    cache = tmp_path / "cache"
    module(folder, cache=cache, pseudo=Lifter(network)).setup("fit")
    module(folder, cache=cache, pseudo=Lifter(network)).setup("fit")
    assert len(list(cache.iterdir())) == 6
    with torch.no_grad():
        network.leave.bias += 1
    module(folder, cache=cache, pseudo=Lifter(network)).setup("fit")
    assert len(list(cache.iterdir())) == 12
