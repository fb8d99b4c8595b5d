"""Distances of poses: by hand, against the metrics and Psi itself, with gradients where poses coincide."""

import pytest
import torch
from numerics import BODY, FLOATS, HALVES, finite, gradcheck, leaves_arguments_alone, normal, rotations, same_as_loop
from torch.testing import assert_close

from kcs_torch.errors import NotFiniteError, OptionError, ShapeError
from kcs_torch.functional import bone_vectors, kcs_matrix
from kcs_torch.metrics import ALIGNMENTS, mpjpe
from kcs_torch.nn import JointDistance, KCSDistance, KCSMatrix

BONES = BODY.bone_index()
each_alignment = pytest.mark.parametrize("how", ALIGNMENTS)
KINDS = {
    "squared": KCSDistance(BODY),
    "absolute": KCSDistance(BODY, squared=False),
    "scale free": KCSDistance(BODY, scale_free=True),
    "absolute, scale free": KCSDistance(BODY, squared=False, scale_free=True),
}
each_kind = pytest.mark.parametrize("name", KINDS)


def pair(*batch, frames=5, dtype=torch.float64):
    return normal(*batch, frames, 7, 3, dtype=dtype), normal(*batch, frames, 7, 3, seed=1, dtype=dtype)


# ---------------------------------------------------------------------- joints


@each_alignment
@pytest.mark.parametrize("root", [None, 2])
def test_joint_distance_is_the_metric_of_each_frame(how, root):
    points, target = pair(3)
    weights = torch.rand(3, 5, 7, generator=torch.Generator().manual_seed(0)).double()
    loss = JointDistance(how, root=root)
    assert_close(loss(points, target).mean(-1), mpjpe(points, target, align=how, root=root))
    each = loss(points, target, weights)
    total = weights.sum(-1)
    whole = (each * total).sum(-1) / total.sum(-1)
    assert_close(whole, mpjpe(points, target, align=how, weights=weights, root=root))


@each_alignment
def test_points_that_are_nan_do_not_pass_for_near(how):
    """Divided by the size of the body, NaN became 0, and the distance that of a body of no size."""
    points, target = pair()
    points[1, 2] = torch.nan
    if how in ("rigid", "similarity", "sequence"):
        with pytest.raises(NotFiniteError, match=r"finite numbers.*weights of 0"):
            JointDistance(how)(points, target)
    else:
        distance = JointDistance(how)(points, target)
        assert distance[1].isnan() and distance[[0, 2, 3, 4]].isfinite().all()


@each_alignment
@pytest.mark.parametrize("weighted", [True, False])
def test_targets_that_are_nan_are_unknown(how, weighted):
    """As tracks are: no label, no value, and no gradient."""
    points, target = pair(3)
    weights = torch.rand(3, 5, 7, generator=torch.Generator().manual_seed(0)).double() if weighted else None
    some = torch.ones(3, 5, 7).double() if weights is None else weights.clone()
    target[0, 1, 2] = target[2, 3] = torch.nan
    some[0, 1, 2] = some[2, 3] = 0
    filled = target.nan_to_num(7.0)
    for loss in (JointDistance(how), KCSDistance(BODY), KCSDistance(BODY, scale_free=True, squared=False)):
        leaf = points.clone().requires_grad_()
        value = loss(leaf, target, weights)
        assert_close(value, loss(points, filled, some))
        assert value[2, 3] == 0
        value.sum().backward()
        assert leaf.grad.isfinite().all() and (leaf.grad[2, 3] == 0).all() and (leaf.grad[0, 1, 2] == 0).all()


@each_alignment
def test_joint_distance_gradient(how):
    points, target = pair(frames=3)
    weights = torch.rand(3, 7, generator=torch.Generator().manual_seed(0)).double() + 0.1
    assert gradcheck(JointDistance(how, root=1), points, target, weights, fast=True)
    assert gradcheck(JointDistance(how), points, target, fast=True)


@each_alignment
@pytest.mark.parametrize("dtype", FLOATS)
@pytest.mark.parametrize("kind", ["same", "one joint on it", "static", "zero"])
def test_joint_distance_is_finite_where_poses_coincide(how, dtype, kind):
    points, target = pair(dtype=dtype)
    if kind == "same":
        target = points.clone()
    if kind == "one joint on it":
        target[:, 3] = points[:, 3]
    if kind == "static":
        points = points[:1].expand(5, 7, 3).clone()
    if kind == "zero":
        points = torch.zeros_like(points)
    finite(JointDistance(how), points, target)
    if kind == "same" and how == "none":
        leaf = points.requires_grad_()
        (grad,) = torch.autograd.grad(JointDistance(how)(leaf, target).sum(), leaf)
        assert not grad.any()


@each_alignment
@pytest.mark.parametrize("dtype", FLOATS)
def test_joint_distance_of_poses_that_are_one_point_has_a_bounded_derivative(how, dtype):
    """What centring leaves of them is rounding, and was taken for a pose of size 1."""
    target = normal(4, 7, 3, seed=1, dtype=dtype)
    weights = torch.full((4, 7), 0.3, dtype=dtype)
    for far in (0.3, 1.0, 3000.0):
        points = (far * normal(4, 1, 3, dtype=dtype)).expand(4, 7, 3).clone().requires_grad_()
        for one, other in ((points, target), (target, points)):
            (grad,) = torch.autograd.grad(JointDistance(how)(one, other, weights).sum(), points)
            assert grad.abs().max() < 2, far


def test_joint_distance_lowers_and_needs_no_mirror():
    points, target = pair()
    mirrored = target * torch.tensor([1.0, 1.0, -1.0])
    assert all(JointDistance(how)(mirrored, target).mean() > 0.1 for how in ALIGNMENTS)
    points.requires_grad_()
    optimiser = torch.optim.Adam([points], 0.05)
    loss = JointDistance("similarity")
    first = loss(points, target).mean().item()
    for _ in range(60):
        optimiser.zero_grad()
        loss(points, target).mean().backward()
        optimiser.step()
    assert loss(points, target).mean() < 0.3 * first


def test_joint_distance_in_half_precision_and_batches():
    for dtype in HALVES:
        points, target = (500 * x.to(dtype) for x in pair())
        value = leaves_arguments_alone(JointDistance("root"), points, target)
        assert value.dtype == dtype
        assert_close(
            value.double(), JointDistance("root")(points.double(), target.double()).double(), rtol=0.01, atol=0
        )
    same_as_loop(JointDistance("sequence"), (5, 7, 3), (5, 7, 3))
    same_as_loop(lambda x, y, w: JointDistance("scale")(x, y, w.abs()), (5, 7, 3), (5, 7, 3), (5, 7))


def test_joint_distance_that_does_not_fit():
    points, target = pair()
    with pytest.raises(OptionError, match="did you mean 'similarity'"):
        JointDistance("similarty")
    with pytest.raises(OptionError, match="root: expected a joint index below 7, got 7"):
        JointDistance("root", root=7)(points, target)
    for wrong in (target[:4], target[..., :2], target[:, :6]):
        with pytest.raises(ShapeError, match=r"target \(\.\.\., 5, 7, 3\)"):
            JointDistance()(points, wrong)
    with pytest.raises(ShapeError, match="weights"):
        JointDistance()(points, target, torch.ones(5, 6))
    with pytest.raises(ShapeError, match=r"\(\.\.\., T, N, D\)"):
        JointDistance()(points[0], target[0])


# ---------------------------------------------------------------------- KCS matrices


def test_kcs_distance_by_hand():
    points, target = pair()
    ours, theirs = (kcs_matrix(bone_vectors(x, BONES)) for x in (points, target))
    assert_close(KINDS["squared"](points, target), 0.5 * (ours - theirs).square().sum((-2, -1)))
    assert_close(KINDS["absolute"](points, target), (ours - theirs).abs().sum((-2, -1)))
    free = KCSMatrix(BODY, normalise=True)
    apart = free(points) - free(target)
    assert_close(KINDS["scale free"](points, target), 0.5 * apart.square().sum((-2, -1)))
    weights = torch.rand(5, 7, generator=torch.Generator().manual_seed(0)).double()
    share = torch.minimum(weights[:, BONES[:, 0]], weights[:, BONES[:, 1]])
    both = torch.minimum(share[:, :, None], share[:, None, :])
    assert_close(KINDS["squared"](points, target, weights), 0.5 * (both * (ours - theirs).square()).sum((-2, -1)))


def test_kcs_distance_of_single_poses():
    points, target = pair()
    assert_close(KINDS["squared"](points[2], target[2]), KINDS["squared"](points, target)[2])


@each_kind
def test_kcs_distance_does_not_see_turn_place_or_mirror(name):
    points, target = pair()
    moved = points @ rotations(5) * torch.tensor([1.0, 1.0, -1.0]) + normal(5, 1, 3, seed=4)
    assert_close(KINDS[name](moved, target), KINDS[name](points, target))
    assert (KINDS[name](points, moved) < 1e-9).all()
    if "free" in name:
        assert_close(KINDS[name](0.01 * points, target), KINDS[name](points, target))


@each_kind
def test_kcs_distance_gradient(name):
    points, target = pair(frames=2)
    weights = torch.rand(2, 7, generator=torch.Generator().manual_seed(0)).double() + 0.1
    assert gradcheck(KINDS[name], points, target, weights, fast=True)
    still = points[:, :1].expand(2, 7, 3)  # all joints at one point
    finite(KINDS[name], points, points)
    finite(KINDS[name], still, target)
    finite(KINDS[name], 0 * points, 0 * target, torch.zeros(2, 7).double())


@each_kind
@pytest.mark.parametrize("dtype", FLOATS + HALVES)
def test_kcs_distance_dtypes_and_batches(name, dtype):
    points, target = (0.3 * x for x in pair(dtype=dtype))
    value = leaves_arguments_alone(KINDS[name], points, target)
    assert value.dtype == dtype and value.shape == (5,)
    assert_close(value.double(), KINDS[name](points.double(), target.double()), rtol=0.03, atol=1e-3)
    same_as_loop(lambda x, y, w: KINDS[name](x, y, w.abs()), (7, 3), (7, 3), (7,))


@pytest.mark.parametrize("dtype", FLOATS)
@pytest.mark.parametrize("size", [1e-30, 1e-20, 1e-12, 1e-8, 1e12])
def test_poses_that_are_nearly_a_point_have_a_bounded_derivative(size, dtype):
    """An inverse of a squared length left the range of single precision here, beside joints that are not seen."""
    points, target = pair(dtype=dtype)
    weights = torch.ones(5, 7, dtype=dtype)
    weights[:, 5] = 0
    for far in (size * points, 1 + size * points):
        for name in ("scale free", "absolute, scale free"):
            finite(lambda x, n=name: KINDS[n](x, target, weights), far)
        for how in ALIGNMENTS:
            finite(lambda x, h=how: JointDistance(h)(x, target, weights), far)
            finite(lambda x, h=how: JointDistance(h, root=2)(target, x, weights), far)
    assert_close(KINDS["scale free"](1e12 * points, target), KINDS["scale free"](points, target), rtol=1e-4, atol=0)
    assert KINDS["scale free"](0 * points, target).isfinite().all()


def test_kcs_distance_that_does_not_fit():
    points, target = pair()
    with pytest.raises(ShapeError, match="skeleton 'body7'"):
        KINDS["squared"](points[:, :6], target)
    with pytest.raises(ShapeError, match="skeleton 'body7'"):
        KINDS["squared"](points, target[:, :6])
    for wrong in ((5, 6), (4, 7)):
        with pytest.raises(ShapeError, match=r"KCSDistance: expected weights \(5, 7\)"):
            KINDS["squared"](points, target, torch.ones(wrong))


def test_targets_that_do_not_fit_the_poses():
    points, target = pair(3)
    for wrong in (target[:2], target[:, :4], target[..., :2]):
        with pytest.raises(ShapeError, match=r"points \(\.\.\., N, 3\) and a target like it"):
            KCSDistance(BODY)(points, wrong)
    with pytest.raises(ShapeError, match=r"and target \(\.\.\., 5, 7, 3\)"):
        JointDistance()(points, target[:2])
    for loss in (JointDistance(), KCSDistance(BODY)):
        assert_close(loss(points, target[0]), loss(points, target[:1].expand(3, -1, -1, -1)))
        with pytest.raises(ShapeError, match="expected a tensor of target, got ndarray"):
            loss(points, target.numpy())


@each_alignment
def test_points_and_target_of_different_precision(how):
    points, target = pair()
    root = 2 if how in ("root", "scale") else None
    expected = JointDistance(how, root=root)(points, target)
    for one, other in ((points.float(), target), (points, target.float())):
        value = JointDistance(how, root=root)(one, other)
        assert value.dtype == one.dtype
        assert_close(value, expected.to(one), rtol=1e-5, atol=1e-5)


def test_a_target_without_coordinates_is_refused():
    with pytest.raises(ShapeError, match=r"a target like it, got \(5, 7, 3\) and \(\)"):
        KCSDistance(BODY)(pair()[0], torch.tensor(1.0))


def test_what_half_precision_cannot_hold_is_its_largest_number():
    """Of values a million times larger it used to be 0: the difference of both was lost to rounding."""
    points, target = (300 * x for x in pair(3, dtype=torch.float32))
    leaf = points.half().requires_grad_()
    value = KCSDistance(BODY)(leaf, target.half())
    assert KCSDistance(BODY)(points, target).min() > 1e10
    assert (value == torch.finfo(torch.float16).max).all()
    (1e-6 * value.float()).sum().backward()
    assert leaf.grad.abs().max() > 0
