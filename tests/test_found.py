"""Skeletons found from motion."""

import warnings
from dataclasses import replace

import pytest
import torch
from test_procrustean import BONES, swinging_body

from kcs_torch.data import walking_person
from kcs_torch.errors import KcsWarning, OptionError, ShapeError
from kcs_torch.methods import PKC
from kcs_torch.methods.found_skeleton import find_skeleton
from kcs_torch.reconstruct import reconstruct
from kcs_torch.types import Tracks


def test_finds_the_bones_of_a_moving_body():
    points, _ = swinging_body()
    body = find_skeleton(points)
    assert {frozenset(b) for b in body.bones} == {frozenset(b) for b in BONES.tolist()}
    assert body.flexible == () and body.is_tree and body.name == "found"
    assert body.proportions is not None and len(body.proportions) == 5
    mirrored = find_skeleton(points * torch.tensor([1.0, 1.0, -1.0]), joints=list("abcdef"))
    assert mirrored.bones == body.bones and mirrored.joints == tuple("abcdef")


def test_unseen_joints_do_not_spoil_it():
    points, _ = swinging_body()
    weights = torch.ones(60, 6, dtype=torch.float64)
    broken = points.clone()
    broken[10:30, 3] = 100.0
    weights[10:30, 3] = 0
    assert find_skeleton(broken, weights=weights).bones == find_skeleton(points).bones
    weights[:, 5] = 0
    body = find_skeleton(broken, weights=weights)
    assert body.is_tree and [body.bones[i][1] for i in body.flexible] == [5]  # whose length nobody knows


def test_unseen_frames_say_nothing_of_lengths_nor_of_rest():
    points, _ = swinging_body()
    weights = torch.ones(60, 6, dtype=torch.float64)
    weights[10:50] = 0
    broken = points.clone()
    broken[10:50, 3:] += 100 * torch.arange(1.0, 4)[:, None]
    assert find_skeleton(broken, weights=weights) == find_skeleton(points[weights[:, 0] > 0])
    resting = points[:1].repeat(60, 1, 1)
    resting[10:50] = points[10:50]
    with pytest.warns(KcsWarning, match="a body at rest"):
        find_skeleton(resting, weights=weights)


@pytest.mark.parametrize("weight", [-1.0, float("nan"), float("inf")])
def test_weights_that_are_none_are_refused(weight):
    points, _ = swinging_body()
    with pytest.raises(ShapeError, match="expected finite weights of 0 or more"):
        find_skeleton(points, weights=torch.full((60, 6), weight))


def test_takes_tracks_and_results():
    points, _ = swinging_body()
    tracks = Tracks.from_arrays(points[..., :2], joint_names=list("abcdef"))
    body = find_skeleton(tracks)
    assert body.joints == tuple("abcdef") and body.num_bones == 5


@pytest.mark.parametrize("joints", [2, 3, 6, 12])
def test_points_that_are_no_body_have_no_bones(joints):
    """Links pull them together, as any depths can be; SfAM's depths show that nothing keeps its distance."""
    draw = torch.Generator().manual_seed(0)
    speed, width = (
        1 + 3 * torch.rand(joints, 2, 4, generator=draw).double(),
        torch.randn(joints, 2, 4, generator=draw).double(),
    )
    time = torch.linspace(0, 6.0, 80).double()[:, None, None, None]
    tracks = Tracks.from_arrays((width * (speed * time + 3 * width).sin()).sum(-1))
    with pytest.warns(KcsWarning, match="no two joints keep their distance"):
        body = find_skeleton(tracks)
    assert len(body.flexible) == joints - 1


def test_noisy_tracks_show_their_bones():
    """Those that SfAM's depths show are half of them wrong, and depths three times as far off."""
    clip = walking_person(60, turn=150.0)
    tracks = clip.tracks.points
    noise = torch.randn(tracks.shape, generator=torch.Generator().manual_seed(1), dtype=tracks.dtype)
    size = (tracks - tracks.mean(1, keepdim=True)).square().sum(-1).mean().sqrt()
    noisy = Tracks.from_arrays(tracks + 0.01 * size * noise, joint_names=clip.tracks.skeleton.joints)
    body = find_skeleton(noisy)
    true = {frozenset(bone) for bone in clip.tracks.skeleton.bones}
    assert len(true & {frozenset(bone) for bone in body.bones}) >= 11 and len(body.flexible) <= 1
    found = PKC()(replace(noisy, skeleton=body))
    deep, depth = (x[..., 2] - x[..., 2].mean(1, keepdim=True) for x in (clip.points, found.points))
    off = torch.minimum((depth - deep).square().mean(), (depth + deep).square().mean()).sqrt()
    assert off < 0.03 * size


def test_bones_that_were_found_do_not_vouch_for_depths():
    """They were chosen for keeping their length: who gives them as known is told smaller deviations."""
    clip = walking_person(40, turn=150.0)
    tracks = Tracks.from_arrays(clip.tracks.points)
    body = find_skeleton(clip.points, joints=tracks.skeleton.joints)
    assert body.found
    found, known = (PKC()(replace(tracks, skeleton=one)) for one in (body, replace(body, name="mine")))
    assert torch.equal(found.points, known.points)
    assert (found.uncertainty > 1.5 * known.uncertainty).all()


def test_the_depths_that_it_looks_at_are_not_doubted_aloud():
    """A camera that stands still spoils depths, and SfAM says so; who asks for bones sees neither."""
    points = walking_person(40, turn=0.0).tracks.points.clone()
    points[:, 4] = torch.nan
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        reconstruct(points, skeleton="auto")
    said = [str(warning.message) for warning in caught]
    assert len(said) == len(set(said)) and not any("sfam" in one for one in said)
    assert sum("never seen" in one for one in said) == 1


def test_joints_that_nothing_holds_together_are_warned_of():
    with pytest.warns(KcsWarning, match=r"no two joints keep their distance within 5 %.*give the skeleton"):
        body = find_skeleton(torch.randn(40, 5, 3, generator=torch.Generator().manual_seed(0)))
    assert not body.rigid and body.is_tree


@pytest.mark.parametrize("frames", [1, 30])
def test_bones_of_a_body_at_rest_are_warned_of(frames):
    """Any tree would do: lengths that do not vary say nothing there."""
    points = torch.randn(1, 5, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64).expand(frames, 5, 3)
    for source in (points, Tracks.from_arrays(points[..., :2])):
        with pytest.warns(KcsWarning, match=r"a body at rest: all joints keep their distances.*Give the skeleton"):
            find_skeleton(source)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        find_skeleton(points[:, :2])  # of two joints there is one bone
        find_skeleton(swinging_body()[0])


@pytest.mark.parametrize("source", [17, ["nose", "neck"], torch.zeros(5, 4, 3).numpy()])
def test_what_is_no_tensor_is_told(source):
    with pytest.raises(ShapeError, match="expected tracks, a result or a tensor of points, got .*SKELETONS"):
        find_skeleton(source)


def test_bad_input():
    with pytest.raises(ShapeError, match="at least 2 joints"):
        find_skeleton(torch.zeros(4, 1, 3))
    with pytest.raises(ShapeError, match="finite"):
        find_skeleton(torch.full((4, 3, 3), float("nan")))
    with pytest.raises(ShapeError, match="weights"):
        find_skeleton(torch.randn(4, 3, 3), weights=torch.ones(3, 3))
    with pytest.raises(ShapeError, match="joints: expected 3 names, got 2"):
        find_skeleton(torch.randn(4, 3, 3), joints=["a", "b"])
    for share in (-1.0, None):
        with pytest.raises(OptionError, match="rigid_below"):
            find_skeleton(torch.randn(4, 3, 3), rigid_below=share)
    nobody = walking_person(5).tracks
    with pytest.raises(ShapeError, match="find_skeleton: expected joints that are seen"):
        find_skeleton(replace(nobody, weights=0 * nobody.weights))


def test_weights_may_be_a_list():
    points, _ = swinging_body()
    assert find_skeleton(points, weights=[[1.0] * 6] * 60).bones == find_skeleton(points).bones


def test_bones_that_tracks_have_already_tell_nothing():
    clip = walking_person(90, skeleton="h36m17", turn=180, noise=3, generator=torch.Generator().manual_seed(0))
    names = [f"m{i}" for i in range(17)]
    chain = Tracks.from_arrays(clip.tracks.points, edges=[(i, i + 1) for i in range(16)], joint_names=names)
    assert find_skeleton(chain) == find_skeleton(Tracks.from_arrays(clip.tracks.points, joint_names=names))
