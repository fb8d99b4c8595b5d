"""Layers: each is its function, knows its skeleton, and learns where it says so."""

import pytest
import torch
from numerics import (
    BODY,
    DEVICES,
    FLOATS,
    HALVES,
    finite,
    gradcheck,
    leaves_arguments_alone,
    normal,
    rotations,
    same_as_loop,
)
from torch.func import functional_call
from torch.testing import assert_close

from kcs_torch.errors import OptionError, ShapeError
from kcs_torch.functional import bone_lengths, bone_vectors, kcs_matrix, svt
from kcs_torch.functional.precision import narrow
from kcs_torch.nn import (
    SVT,
    BoneLengthEnergy,
    BoneLengths,
    BoneVectors,
    JointDistance,
    KCSCritic,
    KCSDistance,
    KCSMatrix,
    LowRankEnergy,
    MLPLifter,
    PerspectiveEnergy,
    PostureEnergy,
    ReprojectionEnergy,
    SmoothnessEnergy,
    SymmetryEnergy,
    UnrolledSfAM,
)
from kcs_torch.nn.layers import inverse_softplus
from kcs_torch.skeleton import SKELETONS

BONES = BODY.bone_index()
LAYERS = {
    "vectors": BoneVectors(BODY),
    "lengths": BoneLengths(BODY),
    "matrix": KCSMatrix(BODY),
    "normalised": KCSMatrix(BODY, normalise=True),
}
each_layer = pytest.mark.parametrize("layer", LAYERS.values(), ids=LAYERS.keys())


def test_layers_are_their_functions():
    points = normal(2, 7, 3)
    assert_close(BoneVectors(BODY)(points), bone_vectors(points, BONES))
    assert_close(BoneLengths(BODY)(points), bone_lengths(points, BONES))
    assert_close(KCSMatrix(BODY)(points), kcs_matrix(bone_vectors(points, BONES)))


@pytest.mark.parametrize("name", sorted(SKELETONS))
def test_every_built_in_skeleton_has_layers(name):
    body = SKELETONS[name]
    points = normal(2, body.num_joints, 3)
    assert KCSMatrix(name)(points).shape == (2, body.num_bones, body.num_bones)
    assert_close(BoneLengths(name)(points).square(), KCSMatrix(name)(points).diagonal(dim1=-2, dim2=-1))


def test_normalised_matrix_is_free_of_scale_and_rotation():
    points = normal(4, 7, 3)
    layer = KCSMatrix(BODY, normalise=True)
    psi = layer(points)
    assert_close(psi.diagonal(dim1=-2, dim2=-1).mean(-1), torch.ones(4).double())
    assert_close(layer(0.01 * points @ rotations(4) + 3), psi)
    assert torch.equal(layer(torch.zeros(2, 7, 3)), torch.zeros(2, 6, 6))


@each_layer
def test_layer_gradient(layer):
    assert gradcheck(layer, normal(2, 7, 3))


@each_layer
@pytest.mark.parametrize("dtype", FLOATS)
@pytest.mark.parametrize("scale", [0.0, 1e-6, 1e6])
def test_layers_are_finite(layer, dtype, scale):
    points = scale * normal(2, 7, 3, dtype=dtype)
    points[0, 1] = points[0, 0]
    finite(layer, points)


@each_layer
def test_batches_equal_loops(layer):
    same_as_loop(layer, (7, 3))
    same_as_loop(layer, (5, 7, 2))


@each_layer
@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", FLOATS + HALVES)
def test_results_follow_dtype_and_device(layer, dtype, device):
    value = leaves_arguments_alone(layer.to(device), normal(2, 7, 3, dtype=dtype, device=device))
    layer.to("cpu")
    assert (value.dtype, value.device.type) == (dtype, device)


@each_layer
@pytest.mark.parametrize("shape", [(6, 3), (2, 8, 3), (7,)])
def test_wrong_joint_count_names_the_skeleton(layer, shape):
    with pytest.raises(ShapeError, match=r"\(\.\.\., 7, 3\) for skeleton 'body7', got"):
        layer(torch.zeros(shape))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("module", "told"),
    [
        (SVT(0.3, learnable=True), "SVT(threshold=0.3, relative=False)"),
        (KCSMatrix(BODY, normalise=True), "KCSMatrix(skeleton='body7', normalise=True)"),
        (KCSDistance(BODY), "KCSDistance(skeleton='body7', squared=True, scale_free=False)"),
        (JointDistance("similarity"), "JointDistance(align='similarity', root=None)"),
        (LowRankEnergy("log_det"), "LowRankEnergy(kind='log_det', eps=0.001)"),
        (SmoothnessEnergy(3), "SmoothnessEnergy(order=3)"),
        (ReprojectionEnergy(huber=2.0), "ReprojectionEnergy(translation=True, huber=2.0)"),
        (PerspectiveEnergy(), "PerspectiveEnergy(translation=True, huber=None, nearest=0.15)"),
    ],
)
def test_modules_tell_their_settings(module, told):
    assert repr(module) == told


@each_layer
def test_layers_know_their_skeleton_and_save_no_state(layer):
    assert "body7" in repr(layer)
    assert not layer.state_dict() and not list(layer.parameters())


# ---------------------------------------------------------------------- SVT


def test_svt_layer_is_svt():
    matrix = normal(3, 6, 4)
    assert torch.equal(SVT(0.7)(matrix), svt(matrix, 0.7))
    assert torch.equal(SVT(0.0)(matrix), svt(matrix, 0.0))
    assert_close(SVT(0.7, learnable=True)(matrix), svt(matrix, 0.7), rtol=1e-5, atol=1e-5)
    size = torch.linalg.matrix_norm(matrix)
    assert_close(SVT(0.1, relative=True)(matrix), svt(matrix, 0.1 * size))


def test_relative_threshold_in_half_precision():
    """The norm of many millimetres leaves its range."""
    matrix = (1000 * normal(100, 51)).half().requires_grad_()
    found = SVT(0.05, relative=True)(matrix)
    (slope,) = torch.autograd.grad(found.float().sum(), matrix)
    assert slope.isfinite().all() and found.abs().max() > 1000
    everything = normal(4, 3).requires_grad_()
    (slope,) = torch.autograd.grad(svt(everything, torch.inf).sum(), everything)
    assert (slope == 0).all()


def test_relative_threshold_is_free_of_scale():
    matrix = normal(3, 6, 4)
    layer = SVT(0.1, relative=True)
    assert_close(layer(1e3 * matrix), 1e3 * layer(matrix))
    assert torch.equal(layer(torch.zeros(6, 4)), torch.zeros(6, 4))
    finite(layer, torch.zeros(6, 4))


@pytest.mark.parametrize("relative", [False, True])
@pytest.mark.parametrize("learnable", [False, True])
def test_svt_layer_gradient(relative, learnable):
    """In the matrix, also through the norm that a relative threshold scales with, and in what is learned."""
    layer = SVT(0.2, learnable=learnable, relative=relative).double()
    names = [name for name, _ in layer.named_parameters()]
    assert names == (["raw"] if learnable else [])

    def run(matrix, *values):
        return functional_call(layer, dict(zip(names, values, strict=True)), (matrix,))

    assert gradcheck(run, normal(2, 6, 4), *[p.detach() for p in layer.parameters()])
    assert gradcheck(run, normal(1, 5).expand(4, 5), *[p.detach() for p in layer.parameters()])  # static


def test_learned_threshold_finds_a_rank_and_stays_positive():
    """The rest of this matrix is noise; the threshold learns to cut it away."""
    clean = 3 * normal(20, 2) @ normal(2, 10)
    noisy = clean + 0.1 * normal(20, 10, seed=1)
    layer = SVT(1e-3, learnable=True).double()
    optimizer = torch.optim.Adam(layer.parameters(), lr=0.2)
    for _ in range(60):
        optimizer.zero_grad()
        loss = (layer(noisy) - clean).square().mean()
        loss.backward()
        optimizer.step()
        assert layer.threshold > 0
    assert torch.linalg.matrix_rank(layer(noisy).detach(), tol=1e-6) < 10
    assert loss < 0.5 * (noisy - clean).square().mean()


def test_svt_layer_takes_what_precision_comes():
    for dtype in FLOATS + HALVES:
        for layer in (SVT(0.3), SVT(0.3, learnable=True), SVT(0.05, relative=True)):
            assert layer(normal(6, 4, dtype=dtype)).dtype == dtype


def test_svt_layer_state():
    layer, other = SVT(0.3, learnable=True), SVT(2.0, learnable=True)
    other.load_state_dict(layer.state_dict())
    assert other.threshold == layer.threshold
    assert not SVT(0.3).state_dict()


@pytest.mark.parametrize("matrix", [torch.ones(3, 4).long(), torch.ones(3, 4).numpy(), None])
def test_svt_takes_numbers_in_floating_point_alone(matrix):
    """Whole numbers came back cut off to whole numbers; an array ended in an AttributeError."""
    with pytest.raises(ShapeError, match="SVT: expected (a tensor of matrices|matrices in floating point), got"):
        SVT(0.3)(matrix)


def test_a_relative_threshold_takes_matrices_alone():
    for relative in (False, True):
        with pytest.raises(ShapeError, match=r"SVT: matrix: expected shape \(\.\.\., M, N\), got \(5,\)"):
            SVT(0.3, relative=relative)(torch.ones(5))


@pytest.mark.parametrize("threshold", [-0.1, float("nan"), float("inf")])
@pytest.mark.parametrize("learnable", [False, True])
def test_svt_layer_thresholds_out_of_range(threshold, learnable):
    with pytest.raises(OptionError, match="threshold"):
        SVT(threshold, learnable=learnable)


def test_a_learned_threshold_starts_above_zero():
    with pytest.raises(OptionError, match="positive"):
        SVT(0.0, learnable=True)


@pytest.mark.parametrize("value", [1e-8, 1e-3, 1.0, 30.0, 1e4])
@pytest.mark.parametrize("dtype", FLOATS)
def test_inverse_softplus(value, dtype):
    raw = inverse_softplus(torch.tensor(value, dtype=dtype))
    assert_close(torch.nn.functional.softplus(raw), torch.tensor(value, dtype=dtype), rtol=1e-5, atol=0)


def test_points_without_the_virtual_joints_are_told_how_to_get_them():
    body = SKELETONS["coco17"]
    points = torch.randn(2, 17, 3)
    with pytest.raises(ShapeError, match=r"without its virtual joints pelvis, neck, which skeleton\.complete"):
        KCSMatrix(body)(points)
    assert KCSMatrix(body)(body.complete(points)[0]).shape == (2, body.num_bones, body.num_bones)
    with pytest.raises(ShapeError, match="expected a tensor of points, got ndarray"):
        KCSMatrix(body)(points.numpy())


def test_swapped_axes_and_flat_points_are_told_how_to_put_right():
    body = SKELETONS["coco17"]
    layer, points = KCSMatrix(body), torch.randn(2, body.num_joints, 3)
    with pytest.raises(ShapeError, match=r"got \(2, 3, 19\): their last two axes are swapped, \.mT puts"):
        layer(points.mT)
    with pytest.raises(ShapeError, match=r"got \(2, 57\): flat, unflatten\(-1, \(19, 3\)\) gives"):
        layer(points.flatten(1))
    with pytest.raises(ShapeError, match=r"got \(2, 51\): flat, unflatten\(-1, \(17, 3\)\) gives"):
        layer(points[:, :17].flatten(1))


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16], ids=["half", "bfloat"])
def test_the_kcs_matrix_of_millimetres_is_finite_in_half_precision(dtype):
    points = 500 * torch.randn(6, 17, 3, generator=torch.Generator().manual_seed(0))
    layer, level = KCSMatrix("h36m17"), KCSMatrix("h36m17", normalise=True)
    exact = layer(points)
    with torch.autocast("cpu", dtype=dtype):
        assert_close(layer(points), exact)
    assert torch.isfinite(layer(points.to(dtype))).all() and exact.max() > torch.finfo(torch.float16).max
    assert_close(level(points.to(dtype)).float(), level(points), rtol=0.05, atol=0.05)


@pytest.mark.parametrize("dtype", HALVES)
def test_what_no_precision_holds_is_the_largest_number(dtype):
    top = torch.finfo(dtype).max
    wide = torch.tensor([torch.inf, -torch.inf, 3e38, 1.5, torch.nan], requires_grad=True)
    value = narrow(wide, torch.zeros((), dtype=dtype))
    assert value[:2].tolist() == [top, -top] and value[3] == 1.5 and value[4].isnan()
    (grad,) = torch.autograd.grad(value[:4].sum(), wide)
    assert grad[2:4].tolist() == [1, 1] and grad.isfinite().all()


@pytest.mark.parametrize("make", [BoneLengths, KCSMatrix, PostureEnergy, KCSCritic, MLPLifter, UnrolledSfAM])
def test_a_module_elsewhere_is_told_to_move(make):
    """Some moved their indices silently in each call, others failed inside torch."""
    module, points = make("h36m17").to("meta"), torch.randn(4, 17, 3)
    given = (points[..., :2], torch.eye(3)[:2].expand(4, 2, 3)) if make is UnrolledSfAM else (points,)
    with pytest.raises(ShapeError, match=rf"{make.__name__}: .* module, meta, got cpu: .*module.to\(points.device\)"):
        module(*given)


def test_confidences_are_no_coordinate():
    points = torch.rand(2, 5, 17, 4)
    modules = (KCSMatrix, BoneVectors, BoneLengths, BoneLengthEnergy, SymmetryEnergy)
    for module in (*(kind("h36m17") for kind in modules), SmoothnessEnergy(), LowRankEnergy()):
        with pytest.raises(ShapeError, match=r"expected points of 2 or 3 coordinates, got \(2, 5, 17, 4\)"):
            module(points)
        assert bool(module(points[..., :3]).isfinite().all())


@pytest.mark.parametrize("module", [BoneLengths("h36m17"), BoneLengthEnergy("h36m17"), LowRankEnergy("log_det")])
def test_points_without_coordinates_are_refused(module):
    with pytest.raises(ShapeError, match=r"points of 2 or 3 coordinates, got \(5, 17, 0\)"):
        module(torch.ones(5, 17, 0))


def test_a_threshold_that_requires_a_gradient_is_told_of_parameters():
    with pytest.raises(OptionError, match="threshold: expected a number, got a tensor that requires a gradient"):
        SVT(torch.tensor(0.5, requires_grad=True))
    assert SVT(torch.tensor(0.5)).threshold == 0.5
