"""The metrics against the measuring protocol, scipy and closed forms; with batches, gaps and mirrors."""

import numpy as np
import pytest
import torch
from numerics import rotations
from scipy.spatial import procrustes as scipy_procrustes
from scipy.spatial.transform import Rotation

from kcs_torch.errors import OptionError, ShapeError
from kcs_torch.functional import superpose
from kcs_torch.metrics import ALIGNMENTS, align, bone_deviation, coverage, e3d, mpjpe, pck
from kcs_torch.skeleton import SKELETONS

BONES = [(0, 1), (1, 2), (2, 3), (0, 4)]


def clip(*batch, frames=12, joints=6, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*batch, frames, joints, 3, generator=generator, dtype=torch.float64)


def moved(points, seed=1):
    """Turned, shifted and scaled differently in every frame."""
    generator = torch.Generator().manual_seed(seed)
    frames = points.shape[-3]
    turns = torch.from_numpy(Rotation.random(frames, rng=np.random.default_rng(seed)).as_matrix())
    size = 0.5 + torch.rand(frames, 1, 1, generator=generator, dtype=torch.float64)
    shift = torch.randn(frames, 1, 3, generator=generator, dtype=torch.float64)
    return size * (points @ turns) + shift, turns, size, shift


@pytest.mark.parametrize("how", ALIGNMENTS)
def test_each_alignment_undoes_what_it_names_and_no_more(how):
    truth = clip()
    both, turns, size, shift = moved(truth)
    one = 1.7 * (truth @ turns[:1])
    undone = {
        "root": truth + shift,
        "scale": size * truth + shift,
        "rigid": truth @ turns + shift,
        "similarity": both,
        "sequence": one + shift,
    }
    rank = {"none": (), "root": ("root",), "scale": ("root", "scale"), "rigid": ("root", "rigid")}
    able = {**rank, "similarity": tuple(undone), "sequence": ("root", "sequence")}
    for name, pred in undone.items():
        error = mpjpe(pred, truth, align=how)
        assert (float(error) < 1e-9) == (name in able[how]), name


def test_mirrors_are_not_undone():
    truth = clip()
    mirrored = truth * torch.tensor([1.0, 1.0, -1.0])
    assert all(float(mpjpe(mirrored, truth, align=how)) > 0.1 for how in ALIGNMENTS)
    assert float(e3d(mirrored, truth)) < 1e-9  # which papers allow


@pytest.mark.parametrize("root", [None, 0])
def test_what_only_a_negative_scale_would_bring_nearer_shrinks_to_the_root(root):
    truth = clip()
    middle = truth.mean(-2, keepdim=True) if root is None else truth[..., root, None, :]
    assert torch.allclose(align(-truth, truth, "scale", root=root), middle.expand_as(truth))
    assert float(mpjpe(-truth, truth, align="scale", root=root)) == pytest.approx(
        float((truth - middle).norm(dim=-1).mean())
    )


@pytest.mark.parametrize("batch", [(), (2,), (2, 3)])
def test_batches_are_many_clips(batch):
    truth, pred = clip(*batch), clip(*batch, seed=1)
    weights = (clip(*batch, seed=2)[..., 0] > -1).double()
    flat = lambda x: x.reshape(-1, *x.shape[len(batch) :])  # noqa: E731
    for how in ALIGNMENTS:
        for figure in (
            lambda p, t, w, how=how: mpjpe(p, t, align=how, weights=w, root=1),
            lambda p, t, w, how=how: pck(p, t, 1.0, align=how, weights=w),
            lambda p, t, w: e3d(p, t, weights=w),
            lambda p, t, w: bone_deviation(p, BONES, weights=w),
            lambda p, t, w: coverage(p, w + 0.5, t, weights=w),
        ):
            together = figure(pred, truth, weights)
            assert together.shape == batch
            alone = [figure(*one) for one in zip(flat(pred), flat(truth), flat(weights), strict=True)]
            assert torch.allclose(together.reshape(-1), torch.stack(alone))


def test_unknown_joints_count_nothing():
    truth, pred = clip(), clip(seed=1)
    weights = torch.ones(12, 6, dtype=torch.float64)
    weights[:, 5] = 0
    weights[3, 2] = 0
    spoilt = torch.where(weights[..., None] > 0, truth, torch.full_like(truth, 1e3))
    for how in ALIGNMENTS:
        assert torch.allclose(
            mpjpe(pred, truth, align=how, weights=weights), mpjpe(pred, spoilt, align=how, weights=weights)
        )
    assert torch.allclose(e3d(pred, truth, weights=weights), e3d(pred, spoilt, weights=weights))
    whole = weights.clone()
    whole[3] = 0
    kept = [t for t in range(12) if t != 3]
    for how in ALIGNMENTS:
        assert torch.allclose(
            mpjpe(pred, truth, align=how, weights=whole), mpjpe(pred[kept][:, :5], truth[kept][:, :5], align=how)
        )


def test_frames_without_the_root_count_nothing():
    truth, pred = clip(), clip(seed=1)
    weights = torch.ones(12, 6, dtype=torch.float64)
    weights[4, 0] = 0
    kept = [t for t in range(12) if t != 4]
    assert torch.allclose(mpjpe(pred, truth, weights=weights, root=0), mpjpe(pred[kept], truth[kept], root=0))


def test_similarity_against_scipy():
    truth, pred = clip(), clip(seed=1)
    for t in range(3):
        target = (truth[t] - truth[t].mean(0)).numpy()
        turn, _ = Rotation.align_vectors(target, (pred[t] - pred[t].mean(0)).numpy())
        expected = turn.apply((pred[t] - pred[t].mean(0)).numpy()) + truth[t].mean(0).numpy()
        assert np.allclose(align(pred[t : t + 1], truth[t : t + 1], "rigid")[0].numpy(), expected)
    near = truth + 0.05 * pred  # so near that scipy's best turn is no mirror
    _, _, disparity = scipy_procrustes(truth[0].numpy(), near[0].numpy())
    ours = align(near[:1], truth[:1], "similarity")
    target = truth[0] - truth[0].mean(0)
    assert float((ours - truth[:1]).square().sum() / target.square().sum()) == pytest.approx(disparity)


def test_against_the_protocol(protocol):
    generator = torch.Generator().manual_seed(3)
    truth = 300 * clip(frames=40, joints=8)
    gaps = torch.rand(40, 8, generator=generator) < 0.1
    pred = truth @ rotations(seed=3) * 1.1 + 40 * clip(frames=40, joints=8, seed=5)
    weights = (~gaps).double()
    theirs = protocol.score(
        pred.numpy(), np.where(gaps[..., None].numpy(), np.nan, truth.numpy()), np.array([(0, 1), (1, 2), (2, 7)])
    )
    ours = {
        "rigid": mpjpe(pred, truth, align="rigid", weights=weights),
        "pa": mpjpe(pred, truth, align="similarity", weights=weights),
        "seq_pa": mpjpe(pred, truth, align="sequence", weights=weights),
        "e3d": e3d(pred, truth, weights=weights),
    }
    for name, figure in ours.items():
        assert float(figure) == pytest.approx(theirs[name], rel=1e-6), name


def test_coverage_of_true_deviations_is_that_of_the_normal_distribution():
    generator = torch.Generator().manual_seed(0)
    truth = clip(frames=500, joints=17)
    deviation = (0.1 + torch.rand(500, 1, generator=generator, dtype=torch.float64)).expand(500, 17)
    pred = truth.clone()
    pred[..., 2] += deviation * torch.randn(500, 17, generator=generator, dtype=torch.float64)
    assert float(coverage(pred, deviation, truth)) == pytest.approx(0.683, abs=0.03)
    assert float(coverage(pred, 2 * deviation, truth)) == pytest.approx(0.954, abs=0.02)
    mirrored, moved = pred * torch.tensor([1.0, 1.0, -1.0]), pred + 7
    for other in (mirrored, moved):
        assert torch.equal(coverage(other, deviation, truth), coverage(pred, deviation, truth))
    assert coverage(9 * pred, 9 * deviation, truth, scale=True) == pytest.approx(0.683, abs=0.03)
    assert coverage(9 * pred, 9 * deviation, truth) < 0.5


def test_figures_of_no_frames_are_nan():
    none = torch.zeros(2, 0, 6, 3)
    for value in (mpjpe(none, none), e3d(none, none), coverage(none, none[..., 0], none), bone_deviation(none, BONES)):
        assert value.shape == (2,) and value.isnan().all()


def test_coverage_counts_what_is_known_of_the_truth():
    truth, pred = clip(), clip(seed=1)
    deviation = torch.ones(12, 6, dtype=torch.float64)
    weights = deviation.clone()
    weights[:, 5] = 0
    spoilt = torch.where(weights[..., None] > 0, truth, torch.nan)
    some = coverage(pred, deviation, spoilt, weights=weights)
    assert torch.equal(some, coverage(pred[:, :5], deviation[:, :5], truth[:, :5])) and 0 < some < 1
    assert coverage(pred, deviation, truth, weights=0 * weights).isnan()
    with pytest.raises(ShapeError, match=r"coverage: deviation: expected shape \(\.\.\., 12, 6\), got \(6,\)"):
        coverage(pred, torch.ones(6), truth)


@pytest.mark.parametrize("value", [torch.nan, torch.inf, -1.0])
def test_deviations_that_are_none_are_refused_where_they_count(value):
    truth, deviation, weights = clip(2), torch.ones(2, 12, 6).double(), torch.ones(2, 12, 6).double()
    deviation[1, 7, 2] = value
    with pytest.raises(ShapeError, match=r"deviation: expected .* >= 0, got .* at frame 7, joint 2 of clip 1$"):
        coverage(truth, deviation, truth)
    weights[1, 7, 2] = 0
    assert (coverage(truth, deviation, truth, weights=weights) == 1).all()


def test_bone_deviation_is_the_protocols_figure():
    points = clip(frames=30)
    length = np.linalg.norm(points[:, [a for a, _ in BONES]] - points[:, [b for _, b in BONES]], axis=-1)
    expected = np.sort(length.std(0) / length.mean(0))
    assert float(bone_deviation(points, BONES)) in (pytest.approx(expected[1]), pytest.approx(expected[2]))
    assert float(bone_deviation(points[:1].expand(9, -1, -1), BONES)) < 1e-7


def test_bone_deviation_takes_the_rigid_bones_of_a_skeleton():
    body = SKELETONS["h36m17"]
    points = torch.randn(9, 17, 3, generator=torch.Generator().manual_seed(0))
    expected = bone_deviation(points, [body.bones[i] for i in body.rigid])
    assert bone_deviation(points, body) == bone_deviation(points, "h36m17") == expected


def test_pck_counts_joints():
    truth = torch.zeros(2, 4, 3)
    pred = truth.clone()
    pred[0, 0, 0], pred[1, 1, 1] = 3, 5
    assert float(pck(pred, truth, 2.9, align="none")) == 0.75
    assert float(pck(pred, truth, 3.0, align="none")) == 0.875
    assert float(pck(pred, truth, 5.0, align="none")) == 1


def test_what_is_wrong_is_said():
    with pytest.raises(OptionError, match="did you mean 'similarity'"):
        mpjpe(clip(), clip(), align="similarty")
    with pytest.raises(OptionError, match="root: expected a joint index below 6"):
        mpjpe(clip(), clip(), root=6)
    with pytest.raises(ShapeError, match="pred and truth of the same shape"):
        e3d(clip(), clip(joints=5))
    with pytest.raises(ShapeError, match="weights"):
        mpjpe(clip(), clip(), weights=torch.ones(12, 5))
    with pytest.raises(ShapeError, match="expected finite points"):
        mpjpe(clip(), torch.full_like(clip(), torch.nan))
    with pytest.raises(ShapeError, match="pairs of joints"):
        bone_deviation(clip(), [])


def test_where_points_do_not_fit_or_are_not_finite_is_said():
    truth = clip()
    with pytest.raises(ShapeError, match=r"got \(6, 3\) and \(6, 3\): of single poses pred\[None\]"):
        mpjpe(truth[0], truth[0])
    with pytest.raises(ShapeError, match=r"got \(12, 3, 6\) and .*: their last two axes are swapped"):
        mpjpe(truth.mT, truth.mT)
    with pytest.raises(ShapeError, match=r"got \(12, 5, 3\) and \(12, 6, 3\): take the joints that both have"):
        mpjpe(truth[:, :5], truth)
    holed = truth.clone()
    holed[7, 2, 1] = torch.nan
    with pytest.raises(ShapeError, match=r"^truth: expected finite points, got \[.*nan.*\] at frame 7, joint 2: where"):
        mpjpe(truth, holed)
    with pytest.raises(ShapeError, match=r"^pred: expected .* at frame 7, joint 2 of clip 1: where .* its weight$"):
        mpjpe(torch.stack([truth, holed]), torch.stack([truth, truth]))


def test_figures_have_gradients():
    pred = clip(seed=1).requires_grad_()
    for how in ALIGNMENTS:
        (grad,) = torch.autograd.grad(mpjpe(pred, clip(), align=how), pred)
        assert torch.isfinite(grad).all()
        assert grad.abs().sum() > 0


@pytest.mark.parametrize("given", [torch.float64, torch.bfloat16, torch.float16])
@pytest.mark.parametrize("known", [torch.float32, torch.float16])
def test_e3d_of_any_precision(given, known):
    pred, truth = clip().to(given), clip(seed=1).to(known)
    exact = e3d(pred.double(), truth.double())
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.allclose(e3d(pred, truth).double(), exact, rtol=1e-5)


@pytest.mark.parametrize("value", [0.0, 3.0, 1 / 3])
def test_e3d_of_a_truth_that_is_a_point(value):
    """Its size is 0, or rounding."""
    pred, point = torch.randn(4, 7, 3), torch.full((4, 7, 3), value)
    assert e3d(pred, point).isnan() and e3d(point, point).isnan()
    clips = e3d(torch.stack([pred, pred]), torch.stack([point, 2 * pred]))
    assert clips.isnan().tolist() == [True, False]
    assert e3d(torch.zeros(0, 7, 3), torch.zeros(0, 7, 3)).isnan()


def test_weights_of_e3d_are_shares():
    truth, pred = clip(), clip(seed=1)
    weights = torch.rand(12, 6, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    assert torch.allclose(e3d(pred, truth, weights=0.01 * weights), e3d(pred, truth, weights=weights))
    assert torch.allclose(e3d(pred, truth, weights=torch.full_like(weights, 0.01)), e3d(pred, truth))


def test_bones_of_joints_that_are_nan_count_where_they_are_seen():
    points, weights = clip(), torch.ones(12, 6, dtype=torch.float64)
    weights[3, 1] = weights[5, 4] = 0
    gone = torch.where(weights[..., None] > 0, points, torch.nan)
    for bones in (BONES, BONES[:1]):
        assert torch.equal(bone_deviation(gone, bones, weights=weights), bone_deviation(points, bones, weights=weights))


def test_bones_that_count_are_finite():
    points, weights = clip(), torch.ones(12, 6, dtype=torch.float64)
    points[3, 4] = points[2, 5] = torch.nan  # an end of a bone, and of none
    with pytest.raises(ShapeError, match=r"^points: expected finite points, got \[nan.*\] at frame 3, joint 4: where"):
        bone_deviation(points, BONES)
    weights[3, 0] = 0  # the bone's other end
    assert bone_deviation(points, BONES, weights=weights).isfinite()


def test_what_weighs_nothing_may_be_nan():
    """The functions refused it, their classes did not."""
    truth, pred, weights = clip(), clip(seed=1), torch.ones(12, 6, dtype=torch.float64)
    weights[3, 1] = weights[5:7, 4] = 0
    gone, lost = (torch.where(weights[..., None] > 0, x, torch.nan) for x in (truth, pred))
    for figure in (mpjpe, e3d, lambda *a, **k: pck(*a, 1.0, **k)):
        leaf = lost.clone().requires_grad_()
        found = figure(leaf, gone, weights=weights)
        assert torch.equal(found, figure(pred, truth, weights=weights))
        if found.requires_grad:
            assert torch.autograd.grad(found, leaf)[0].isfinite().all()


@pytest.mark.parametrize("figure", [mpjpe, e3d, lambda p, t, weights: coverage(p, p[..., 0].abs(), t, weights=weights)])
def test_weights_below_zero_count_as_zero(figure):
    """A detector's -1 says that it has seen nothing."""
    pred, truth = clip(2), clip(2, seed=1)
    weights = (torch.rand(2, 12, 6, generator=torch.Generator().manual_seed(0)) > 0.3).double()
    found = figure(pred, truth, weights=weights - (weights == 0).double())
    torch.testing.assert_close(found, figure(pred, truth, weights=weights))


def test_deviation_of_bones_has_a_derivative_where_they_are_constant():
    """The root of a variance of 0 has none, and one such bone made that of the others NaN."""
    points = clip()
    points[:, 1] = points[:, 0] + torch.tensor([0.0, 2.0, 0.0])
    points[:, 3] = points[:, 2]  # no length
    weights = torch.ones(12, 6, dtype=torch.float64)
    weights[:, 5] = 0
    for frames in (12, 1):
        for mass in (None, weights[:frames]):
            leaf = points[:frames].clone().requires_grad_()
            value = bone_deviation(leaf, [(0, 1), (2, 3), (1, 4), (4, 5), (1, 2)], weights=mass)
            (grad,) = torch.autograd.grad(value, leaf)
            assert value.isfinite() and grad.isfinite().all()
    few = points.requires_grad_()
    assert torch.autograd.gradcheck(lambda x: bone_deviation(x, [(0, 1), (1, 2), (1, 4)]), few)
    flat = points.detach() * torch.tensor([1.0, 1.0, 0.0])
    truth = flat.clone().requires_grad_()
    (grad,) = torch.autograd.grad(e3d(clip(seed=1), truth), truth)
    assert grad.isfinite().all()


def test_bones_that_points_have_not_are_told():
    """Torch told of indices, or took the wrong joints of a skeleton without a word."""
    for bones, told in (
        ([(0, 6)], r"bones: expected joint indices 0..5, got \(0, 6\)"),
        ([(0.5, 1)], r"bones: expected shape \(B, 2\) of indices"),
        ([(0, 1, 2)], r"bones: expected shape \(B, 2\) of indices"),
        (torch.tensor([(0, 6)]), "bones: expected joint indices 0..5, got 0..6"),
        (torch.tensor([(-1, 3)]), "bones: expected joint indices 0..5, got -1..3"),
        (3, r"bones: expected shape \(B, 2\) of indices \(parent, child\), got 3"),
        ("h36m17", r"expected points of the 17 joints of skeleton 'h36m17', got 6 joints"),
    ):
        with pytest.raises(ShapeError, match=told):
            bone_deviation(clip(), bones)
    with pytest.raises(ShapeError, match=r"bone_deviation: weights: expected shape \(\.\.\., 12, 6\), got \(6,\)"):
        bone_deviation(clip(), BONES, weights=torch.ones(6))
    with pytest.raises(ShapeError, match=r"bone_deviation: points: expected shape \(\.\.\., T, N, 3\)"):
        bone_deviation(clip()[0], BONES)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_bone_deviation_of_half_precision_in_millimetres(dtype):
    points = (300 * clip(frames=1) + 10 * clip(frames=300, seed=1)).to(dtype)
    assert torch.allclose(bone_deviation(points, BONES).double(), bone_deviation(points.double(), BONES), rtol=1e-4)


def test_arrays_and_lists_are_told_what_to_become():
    points, ones = torch.rand(5, 7, 3), torch.ones(5, 7)
    for figure in (mpjpe, e3d, lambda *a, **k: pck(*a, 0.1, **k)):
        with pytest.raises(ShapeError, match=r"pred: expected a tensor, got ndarray: use torch.as_tensor\(pred\)"):
            figure(points.numpy(), points)
        with pytest.raises(ShapeError, match="weights: expected a tensor, got list"):
            figure(points, points, weights=ones.tolist())
    with pytest.raises(ShapeError, match="points: expected a tensor, got ndarray"):
        bone_deviation(points.numpy(), [(0, 1)])


@pytest.mark.parametrize("threshold", [-1.0, float("nan"), [50, 100, 150], "150", True, torch.ones(2)])
def test_no_joint_is_within_less_than_nothing(threshold):
    with pytest.raises(OptionError, match="pck: expected a threshold of at least 0, got"):
        pck(torch.rand(5, 7, 3), torch.rand(5, 7, 3), threshold)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.int64])
def test_figures_of_many_joints_are_not_rounded(dtype):
    """The sum of many weights in half precision was rounded, or infinite; so was the share of joints that are near."""
    truth = torch.zeros(5000, 17, 3, dtype=dtype)
    pred = truth.clone()
    pred[:3000, :, 0] = 1
    half = torch.ones(5000, 17, dtype=dtype)
    for weights in (None, half):
        assert mpjpe(pred, truth, align="none", weights=weights).item() == pytest.approx(0.6, abs=1e-6)
        assert pck(pred, truth, 0.5, align="none", weights=weights).item() == pytest.approx(0.4, abs=1e-6)


def test_superpose_knows_its_alignments():
    """Any other name was taken for "similarity"."""
    with pytest.raises(OptionError, match="did you mean 'similarity'"):
        superpose(torch.rand(5, 7, 3), torch.rand(5, 7, 3), "similarty")
