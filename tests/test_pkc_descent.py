"""The objective's gradient written out, against autograd through the objective's terms, term by term and padded."""

import itertools
from dataclasses import replace

import pytest
import torch
from numerics import count_operations, normal
from objective_walks import lengths_of, objective, walk
from test_pkc_refinement import several
from torch.testing import assert_close

from kcs_torch.functional import bone_lengths, bone_vectors
from kcs_torch.methods.pkc.descent import ObjectiveGradient
from kcs_torch.methods.pkc.objective import Objective
from kcs_torch.methods.pkc.unknowns import Unknowns
from kcs_torch.methods.pkc.weights import Weights
from kcs_torch.skeleton import SKELETONS


def by_autograd(goal, unknowns, state):
    state = state.clone().requires_grad_()
    value = goal(*unknowns(state))
    return value.detach(), *torch.autograd.grad(value.sum(), state)


def agree(goal, depth, lengths, size=2.0, rtol=1e-9):
    """Both at a random state, of which some rows are far."""
    unknowns = Unknowns(goal, depth, lengths)
    state = size * normal(*unknowns.scale.shape)
    for one, other in zip(ObjectiveGradient(goal, unknowns)(state), by_autograd(goal, unknowns, state), strict=True):
        assert torch.isfinite(other).all()
        assert_close(one, other, rtol=rtol, atol=rtol * float(other.abs().amax()))


@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize("frames", [1, 2, 3, 12])
@pytest.mark.parametrize("skeleton", ["h36m17", "coco17", "mediapipe33", "body25"])
def test_as_autograd(skeleton, frames, noise):
    """Bodies with virtual joints, with ankles that are hinges; alone and with lengths that are held."""
    points = walk(frames, skeleton)
    lengths = bone_lengths(points, SKELETONS[skeleton].bone_index()).mean(0)
    depth = torch.stack([points[..., 2], -0.5 * points[..., 2]])
    for anchor in (None, 1.02 * lengths):
        found = objective(points, skeleton, noise=noise, anchor=anchor)
        agree(found, depth, lengths * torch.tensor([[1.0], [1.1]]))


def test_noise_that_changes_in_time_and_lengths_below_the_image():
    points = walk(8)
    noise = 0.02 * normal(8, 17, seed=3).abs()
    noise[2:4] = 0
    found = objective(points, noise=noise)
    agree(found, points[None, ..., 2], 0.7 * lengths_of(found, points)[None])


@pytest.mark.parametrize("skeleton", ["h36m17", "body25"])
def test_limbs_that_reach_across_the_body(skeleton):
    """Bodies whose hinges are all of such limbs, and others."""
    points = walk(8, skeleton, yaw=90.0)
    found = objective(points, skeleton)
    elbow = found.adduction.joints[-1, 1]
    points[..., elbow, 2] -= torch.linspace(-0.4, 0.4, 8)  # seen from the side, across is away
    depth, lengths = points[None, ..., 2], lengths_of(found, points)[None]
    assert found.terms(depth, lengths)["adduction"] > 1
    agree(found, depth, lengths, 0.1)


@pytest.mark.parametrize("flexible", [(), (0, 3), tuple(range(16))])
def test_flexible_bones(flexible):
    points = walk(8)
    found = Objective(replace(SKELETONS["h36m17"], flexible=flexible), points[..., :2], Weights(), torch.zeros(8, 17))
    agree(found, points[None, ..., 2], lengths_of(found, points)[None])


@pytest.mark.parametrize("frames", [3, 12, 80])
def test_bodies_without_twins_and_long_clips(frames):
    """One block of directions, and more frames than directions."""
    points = walk(frames)
    for body in (replace(SKELETONS["h36m17"], mirror=()), SKELETONS["h36m17"]):
        found = Objective(body, points[..., :2], Weights(), torch.zeros(frames, 17).double())
        agree(found, points[None, ..., 2], lengths_of(found, points)[None], 0.5)


def test_without_hinges():
    points = walk(8)
    body = replace(SKELETONS["h36m17"], hinges=())
    found = Objective(body, points[..., :2], Weights(), torch.zeros(8, 17).double())
    agree(found, points[None, ..., 2], lengths_of(found, points)[None])


def test_flat_and_empty_images():
    """Bones that vanish in the image or have no depth."""
    flat = walk(5) * torch.tensor([1.0, 1.0, 0.0])
    found = objective(flat)
    agree(found, flat[None, ..., 2], found.posture.rest_lengths[None])
    found = objective(0 * flat)
    agree(found, walk(5)[None, ..., 2], found.posture.rest_lengths[None], rtol=1e-6)  # a trunk in one line has no frame
    unknowns = Unknowns(found, 0 * flat[None, ..., 2], found.posture.rest_lengths[None])
    value, slope = ObjectiveGradient(found, unknowns)(torch.zeros_like(unknowns.scale))
    assert torch.isfinite(value).all() and torch.isfinite(slope).all()


def test_padded_clips_as_autograd_and_frames_that_pad_have_no_slope():
    tasks = several()
    counts = [len(task.depth) for task in tasks]
    joined = Objective.joined([task.objective for task in tasks], counts)
    pad = lambda z: torch.nn.functional.pad(z, (0, 0, 0, 33 - z.shape[1]))  # noqa: E731
    depth, lengths = torch.cat([pad(task.depth) for task in tasks]), torch.cat([task.lengths for task in tasks])
    agree(joined, depth, lengths, 0.5)
    unknowns = Unknowns(joined, depth, lengths)
    slope = ObjectiveGradient(joined, unknowns)(0.5 * normal(*unknowns.scale.shape))[1][:, :-16].view(-1, 16, 33)
    assert (slope[:2, :, 20:] == 0).all() and (slope[:2, :, :20] != 0).any(-1).all()


def test_slopes_are_differences():
    """Against no derivative at all."""
    points = walk(6)
    found = objective(points, noise=0.01)
    unknowns = Unknowns(found, points[None, ..., 2], 1.02 * lengths_of(found, points)[None])
    state, step = 0.3 * normal(*unknowns.scale.shape), 1e-5
    slope = ObjectiveGradient(found, unknowns)(state)[1][0]
    for i in range(0, len(slope), 7):
        ahead = torch.zeros_like(state)
        ahead[0, i] = step
        rise = [float(found(*unknowns(state + sign * ahead))) for sign in (1, -1)]
        assert_close((rise[0] - rise[1]) / (2 * step), float(slope[i]), rtol=1e-5, atol=1e-5)


def test_far_states_give_no_numbers_rather_than_errors():
    points = walk(4)
    found = objective(points)
    unknowns = Unknowns(found, points[None, ..., 2], lengths_of(found, points)[None])
    value, _ = ObjectiveGradient(found, unknowns)(torch.full_like(unknowns.scale, torch.nan))
    assert value.isnan().all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_follows_dtype_and_leaves_its_arguments_alone(dtype):
    points = walk(6).to(dtype)
    found = Objective(
        SKELETONS["coco17"], walk(6, "coco17")[..., :2].to(dtype), Weights(), torch.zeros(6, 19).to(dtype)
    )
    unknowns = Unknowns(found, walk(6, "coco17")[None, ..., 2].to(dtype), found.posture.rest_lengths[None].to(dtype))
    state = 0.1 * normal(*unknowns.scale.shape, dtype=dtype)
    before = state.clone()
    descent = ObjectiveGradient(found, unknowns)
    first, again = descent(state), descent(state)
    assert all(x.dtype == dtype for x in first) and points.dtype == dtype
    assert torch.equal(state, before)
    assert all(torch.equal(a, b) for a, b in itertools.zip_longest(first, again))


def test_fewer_operations_than_autograd_takes():
    """Counts, which no busy machine changes: of operations, which cost microseconds each, and of numbers written."""
    points = walk(60)
    for noise, most in ((0.0, 340), (0.01, 385)):
        found = objective(points, noise=noise)
        unknowns = Unknowns(found, points[None, ..., 2], lengths_of(found, points)[None])
        state, descent = torch.zeros_like(unknowns.scale), ObjectiveGradient(found, unknowns)
        ours = count_operations(lambda d=descent, s=state: d(s))
        naive = count_operations(lambda f=found, u=unknowns, s=state: by_autograd(f, u, s))
        assert ours.total < most and ours.total < naive.total / 1.7
        assert ours.elements < naive.elements / 2.9


@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize("frames", [1, 3, 12, 80])
@pytest.mark.parametrize("skeleton", ["h36m17", "coco17", "body25"])
def test_with_an_image_that_goes_with_the_depths(skeleton, frames, noise):
    """As autograd through the terms, of two images at once, in depths, lengths, image and rays; arms reach across."""
    points = walk(frames, skeleton, yaw=90.0)
    found = objective(points, skeleton, noise=noise)
    points[..., found.adduction.joints[-1, 1], 2] -= torch.linspace(-0.4, 0.4, frames)
    two = torch.stack([points, 0.9 * points]) + 0.02 * normal(2, *points.shape)
    two = found.skeleton.complete(two[:, :, : found.skeleton.num_observed])[0]
    lengths = lengths_of(found, points) * torch.tensor([[1.0], [1.1]])
    ends = found.bones.T
    inside = [(two[:, :, ends[1]] - two[:, :, ends[0]]).detach().permute(0, 3, 2, 1).contiguous(), lengths.log()]
    inside.append(torch.zeros(2).double())  # logarithms of the rays' size
    rays = 0.2 * normal(1, 2, len(ends[0]), frames, seed=5)
    tree = found.tree[: found.skeleton.num_observed]

    def value(bones, logs, wide):
        """Of bones (H, 3, B, T), the image's taken as they are."""
        joints = (tree @ bones[:, 2]).mT @ found.complete
        flat = (tree @ bones[:, :2]).permute(0, 3, 2, 1)
        flat = torch.cat([flat, torch.zeros_like(flat[..., :1])], -1)
        image = found.skeleton.complete(flat)[0][..., :2]
        terms = found.terms(joints, logs.exp(), image)
        own, flat = bone_vectors(joints[..., None], found.bones)[..., 0], bone_vectors(image, found.bones)
        deep = own + wide.exp()[:, None, None] * (flat.permute(0, 3, 2, 1) * rays).sum(1).mT
        terms["foreshortening"] = found.foreshortening.each(deep, logs.exp(), found.clear, found.noise).sum((1, 2))
        return sum(terms.values())

    leaves = [x.clone().requires_grad_() for x in inside]
    expected = value(*leaves)
    drawn, grown, turned = torch.autograd.grad(expected.sum(), leaves)
    mixed = found.complete.mT @ tree @ inside[0][:, :2]  # virtual joints among them
    image = mixed[:, :, ends[1]] - mixed[:, :, ends[0]]
    energy, slope, growth, pull, wider = ObjectiveGradient(found).with_image(inside[0][:, 2], lengths, image, rays)
    assert_close(energy, expected)
    back = torch.zeros(2, 2, *mixed.shape[2:]).double().index_add_(2, ends[1], pull).index_add_(2, ends[0], -pull)
    pull = (found.complete.mT @ tree).mT @ back
    for one, other in ((slope, drawn[:, 2]), (growth, grown), (pull, drawn[:, :2]), (wider, turned)):
        assert_close(one, other, rtol=1e-8, atol=1e-8 * float(other.abs().amax()))
