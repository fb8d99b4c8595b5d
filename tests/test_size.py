"""The apparent size of a body, and PKC on a body that comes nearer."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

import kcs_torch as kt
from kcs_torch.data.synthetic import walking_person
from kcs_torch.methods.clips.size import size_path, slow_waves, weak_perspective, weak_perspectives


def grown(clip, ratio):
    """Tracks of a clip whose image grows by a factor, evenly in its log, and the sizes (T,)."""
    size = torch.linspace(0, math.log(ratio), clip.tracks.num_frames, dtype=torch.float64).exp()
    return clip.points[..., :2] * size[:, None, None], size


def test_finds_how_a_walker_grows():
    clip = walking_person(90, turn=0, yaw=20)
    image, size = grown(clip, 1.8)
    path, gain = size_path(image, torch.ones(image.shape[:2], dtype=torch.bool), clip.skeleton, 30.0)
    torch.testing.assert_close(path, size / size.log().mean().exp(), rtol=0.02, atol=0)
    assert float(gain.median()) > 0.6


@pytest.mark.parametrize("turn", [0.0, 90.0])
@pytest.mark.parametrize("yaw", [0.0, 90.0])
def test_a_distant_camera_keeps_its_scale(yaw, turn):
    clip = walking_person(100, turn=turn, yaw=yaw, noise=5, generator=torch.Generator().manual_seed(0))
    assert not weak_perspective(clip.tracks.points, clip.tracks.seen, clip.skeleton, 30.0).sure


def test_fingers_that_look_shorter_together_do_not_change_the_size(shared, protocol):
    """A hand that turns before a distant camera."""
    data = protocol.load(shared / "data", "hand/manipnet_mug1_rightHand")
    joint = dict(zip(data["joint_names"].tolist(), data["points3d"][240:480:2].transpose(1, 0, 2), strict=True))
    parts = [joint["WRIST"], joint["THUMB_CMC_FE"]]
    for finger in ("THUMB", "INDEX", "MIDDLE", "RING", "PINKY"):
        names = ("MCP_FE", "IP_FE") if finger == "THUMB" else ("MCP", "PIP_FE", "DIP_FE")
        chain = [joint[f"{finger}_{name}"] for name in names]
        parts += [*chain, 1.9 * chain[-1] - 0.9 * chain[-2]]  # its tip
    points = torch.tensor(protocol.np.stack(parts, 1)).double() * torch.tensor([-1.0, 1, 1])  # a right hand's
    turn = torch.tensor(protocol.rotation(protocol.np.linspace(0, 90, 120), 0.0))
    truth = points @ turn.mT
    truth = truth - truth.mean(1, keepdim=True)
    spread = truth.square().sum(-1).mean().sqrt()
    noise = 0.01 * spread * torch.tensor(protocol.np.random.default_rng(5).standard_normal((120, 21, 2)))
    tracks = kt.Tracks.from_arrays(truth[..., :2] + noise, skeleton="hand21", fps=30, units="mm")
    size = weak_perspective(tracks.points, tracks.seen, tracks.skeleton, 30.0)
    assert size.range > 1.08 and not size.likely
    found = kt.reconstruct(tracks, intrinsics="parallel", detections=False)
    off = found.points - found.points.mean(1, keepdim=True) - truth
    assert float(off.square().sum(-1).mean().sqrt()) < 0.1 * float(spread)


def test_gaps_and_outliers_do_not_change_the_size():
    clip = walking_person(90, turn=0, yaw=20)
    image, size = grown(clip, 1.8)
    random = torch.Generator().manual_seed(0)
    seen = torch.rand(image.shape[:2], generator=random) > 0.2
    wrong = torch.rand(image.shape[:2], generator=random) < 0.03
    image = torch.where(seen[..., None], image, torch.zeros_like(image)) + 200 * wrong[..., None]
    found = weak_perspective(image, seen, clip.skeleton, 30.0)
    assert found.sure
    torch.testing.assert_close(found.path, size / size.mean(), rtol=0.03, atol=0)


def test_the_size_stays_where_nothing_is_seen_any_more_and_goes_straight_on_between():
    clip = walking_person(60, turn=0, yaw=20)
    image, _ = grown(clip, 1.5)
    seen = torch.ones(image.shape[:2], dtype=torch.bool)
    seen[15:25] = seen[40:] = False
    path, _ = size_path(image, seen, clip.skeleton, 5.0)
    torch.testing.assert_close(path[40:], path[39].expand(20))
    slope = path.log().diff()[14:25]
    torch.testing.assert_close(slope, slope.mean().expand(11))
    assert 1.15 < float(path.amax() / path.amin()) < 1.45  # of 1.32 in the frames that are seen


def test_clips_together_as_alone():
    """Of many lengths, rates and skeletons; one with a joint that is never seen, one that shows nobody, one frame."""
    clips = []
    for i, (frames, ratio, skeleton) in enumerate(
        [(90, 1.8, "h36m17"), (80, 1.0, "h36m17"), (70, 1.5, "h36m17"), (61, 1.7, "coco17"), (30, 1.4, "h36m17")]
    ):
        clip = walking_person(frames, turn=0, yaw=20 * i, skeleton=skeleton, fps=30.0 + 5 * i)
        clips.append(replace(clip.tracks, points=grown(clip, ratio)[0]))
    hidden = clips[0].weights.clone()
    hidden[:, 5] = 0
    clips += [replace(clips[0], weights=hidden), replace(clips[1], weights=0 * hidden[:80])]
    clips.append(replace(clips[4], points=clips[4].points[:1], weights=clips[4].weights[:1]))
    alone = [weak_perspective(one.points, one.seen, one.skeleton, one.fps) for one in clips]
    assert 2 < sum(other.sure for other in alone) < len(clips)
    for one, other in zip(weak_perspectives(clips), alone, strict=True):
        assert one.sure == other.sure
        assert one.range == float(one.path.amax() / one.path.amin())
        torch.testing.assert_close(one.path, other.path, rtol=1e-9, atol=0)


@pytest.mark.parametrize("frames", [1, 2, 3, 8])
def test_few_frames_and_points_in_one_place(frames):
    body = kt.SKELETONS["h36m17"]
    seen = torch.ones(frames, 17, dtype=torch.bool)
    path, gain = size_path(torch.zeros(frames, 17, 2), seen, body, 30.0)
    assert torch.equal(path, torch.ones(frames)) and bool(torch.isfinite(gain).all())
    path, gain = size_path(torch.randn(frames, 17, 2), seen & False, body, 30.0)
    assert torch.equal(path, torch.ones(frames))
    path, gain = size_path(torch.randn(frames, 17, 2), seen, body, 30.0)
    assert bool(torch.isfinite(path).all()) and bool(torch.isfinite(gain).all())


def test_slow_waves_know_the_frame_rate():
    like = torch.zeros(1)
    assert slow_waves(300, 30.0, like).shape == (300, 7)
    assert slow_waves(300, 120.0, like).shape == (300, 2)
    assert slow_waves(9000, 30.0, like).shape == (9000, 12)
    assert slow_waves(1, 30.0, like).shape == (1, 1)


def test_pkc_reconstructs_a_body_that_comes_nearer():
    clip = walking_person(60, turn=0, yaw=45)
    image, size = grown(clip, 1.6)
    given = kt.Tracks.from_arrays(image, skeleton=clip.skeleton, fps=30.0, units="mm")
    method = kt.METHODS["pkc"](viewpoint="fixed", rounds=0, alternatives=1)
    result, plain = method(given), method(clip.tracks)
    torch.testing.assert_close(result.scales, size / size.mean(), rtol=0.03, atol=0)
    assert torch.equal(plain.scales, torch.ones_like(plain.scales))
    assert all(torch.equal(other.scales, result.scales) for other in result.alternatives)
    assert any("weak perspective" in note for note in result.diagnostics.notes)
    assert result.diagnostics.reprojection_rms < 1.0

    def error(points):
        """Mean distance after the best rotation of each frame and one scale; the better of the two mirror images."""
        out = []
        for sign in (1.0, -1.0):
            a = points * points.new_tensor([1, 1, sign])
            a, b = a - a.mean(1, keepdim=True), clip.points - clip.points.mean(1, keepdim=True)
            turn = kt.functional.nearest_rotation((a.mT @ b).mT).mT
            a = a @ turn
            out.append(float((a * ((a * b).sum() / (a * a).sum()) - b).norm(dim=-1).mean()))
        return min(out)

    assert error(result.points) < error(plain.points) + 10
