"""The torchmetrics classes: the functions over all clips at once, whatever the batches and processes; scipy agrees."""

import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import procrustes
from scipy.spatial.transform import Rotation
from torch.testing import assert_close

import kcs_torch as kt
from kcs_torch.errors import OptionError, ShapeError
from kcs_torch.metrics import ALIGNMENTS, bone_deviation, e3d, mpjpe, pck

pytest.importorskip("torchmetrics", reason="torchmetrics comes with the extra 'train'")

ROOT = Path(__file__).resolve().parents[1]
BONES = [(0, 1), (1, 2), (2, 3), (0, 4)]


def clip(*shape, seed=0):
    return torch.randn(*shape, 12, 6, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


PRED, TRUTH = clip(7, seed=1), clip(7)
WEIGHTS = (torch.rand(7, 12, 6, generator=torch.Generator().manual_seed(2)) > 0.2).double()
WEIGHTS[3, 5] = 0


def fed(metric, *arguments, sizes=(3, 1, 3)):
    for parts in zip(*[a.split(sizes) for a in arguments], strict=True):
        metric.update(*parts)
    return metric


def over_all(figure):
    """A figure of one clip per row, weighted by how many joints count."""
    each, total = figure, WEIGHTS.sum((1, 2))
    return (each * total).sum() / total.sum()


@pytest.mark.parametrize("how", ALIGNMENTS)
def test_mpjpe_and_pck_are_the_functions_over_all_clips(how):
    metric, share = kt.metrics.MPJPE(how), kt.metrics.PCK(1.2, how)
    assert_close(fed(metric, PRED, TRUTH).compute().double(), mpjpe(PRED, TRUTH, align=how).mean(), rtol=1e-6, atol=0)
    assert_close(fed(share, PRED, TRUTH).compute().double(), pck(PRED, TRUTH, 1.2, align=how).mean(), rtol=1e-6, atol=0)
    metric.reset()
    share.reset()
    expected = over_all(mpjpe(PRED, TRUTH, align=how, weights=WEIGHTS))
    assert_close(fed(metric, PRED, TRUTH, WEIGHTS).compute().double(), expected, rtol=1e-6, atol=0)
    expected = over_all(pck(PRED, TRUTH, 1.2, align=how, weights=WEIGHTS))
    assert_close(fed(share, PRED, TRUTH, WEIGHTS).compute().double(), expected, rtol=1e-6, atol=0)


def test_metrics_tell_their_settings():
    assert repr(kt.metrics.MPJPE("scale", root=1)) == "MPJPE(align='scale', root=1)"
    assert repr(kt.metrics.PCK(150.0)) == "PCK(threshold=150, align='root', root=None)"


def test_metrics_reset_in_inference_mode_go_on_outside_of_it():
    metric = kt.metrics.MPJPE()
    with torch.inference_mode():
        metric.update(PRED[:3], TRUTH[:3])
        metric.reset()
        metric.update(PRED[:3], TRUTH[:3])
    metric.update(PRED[3:], TRUTH[3:])
    assert_close(metric.compute().double(), mpjpe(PRED, TRUTH, align="root").mean(), rtol=1e-6, atol=0)


def test_e3d_and_bone_deviation_are_means_over_clips():
    assert_close(fed(kt.metrics.E3D(), PRED, TRUTH).compute().double(), e3d(PRED, TRUTH).mean(), rtol=1e-6, atol=0)
    expected = e3d(PRED, TRUTH, weights=WEIGHTS).mean()
    assert_close(fed(kt.metrics.E3D(), PRED, TRUTH, WEIGHTS).compute().double(), expected, rtol=1e-6, atol=0)
    expected = bone_deviation(PRED, BONES).mean()
    assert_close(fed(kt.metrics.BoneDeviation(BONES), PRED).compute().double(), expected, rtol=1e-6, atol=0)
    expected = bone_deviation(PRED, BONES, weights=WEIGHTS).mean()
    assert_close(fed(kt.metrics.BoneDeviation(BONES), PRED, WEIGHTS).compute().double(), expected, rtol=1e-6, atol=0)
    body = kt.SKELETONS["coco17"]
    walk = kt.data.walking_person(20, skeleton=body).points[None]
    metric = fed(kt.metrics.BoneDeviation(body), walk, sizes=1)
    assert metric.compute().item() == pytest.approx(bone_deviation(walk[0], body.bone_index()).item())
    assert_close(fed(kt.metrics.BoneDeviation("coco17"), walk, sizes=1).compute(), metric.compute())


def test_against_scipy():
    """Per-frame similarity and rotation, and one rotation for a clip, by other people's code."""
    near = TRUTH + 0.05 * PRED  # so near that the best turn is no mirror
    residual, turned, whole = [], [], []
    for p, t in zip(near, TRUTH, strict=True):
        a, b = (x - x.mean(1, keepdim=True) for x in (p, t))
        for source, target in zip(a.numpy(), b.numpy(), strict=True):
            first, second, _ = procrustes(target, source)
            residual.append(np.linalg.norm(first - second, axis=1) * np.linalg.norm(target))
            turn, _ = Rotation.align_vectors(target, source)
            turned.append(np.linalg.norm(turn.apply(source) - target, axis=1))
        source, target = a.flatten(0, 1).numpy(), b.flatten(0, 1).numpy()
        turn, _ = Rotation.align_vectors(target, source)
        source = turn.apply(source)
        scale = (source * target).sum() / (source * source).sum()
        whole.append(np.linalg.norm(scale * source - target, axis=1))
    for how, theirs in (("similarity", residual), ("rigid", turned), ("sequence", whole)):
        ours = fed(kt.metrics.MPJPE(how), near, TRUTH).compute().item()
        assert ours == pytest.approx(np.mean(theirs), rel=1e-6), how
        share = fed(kt.metrics.PCK(0.1, how), near, TRUTH).compute().item()
        assert share == pytest.approx(np.mean(np.concatenate(theirs) <= 0.1), abs=1e-6), how


@pytest.mark.parametrize("how", ALIGNMENTS)
def test_mirrors_are_not_undone(how):
    assert fed(kt.metrics.MPJPE(how), TRUTH * torch.tensor([1.0, 1, -1]), TRUTH).compute() > 0.1


def test_unknown_joints_may_be_anything():
    gone = torch.where(WEIGHTS[..., None] > 0, TRUTH, torch.nan)
    lost = torch.where(WEIGHTS[..., None] > 0, PRED, torch.inf)
    for make in (kt.metrics.MPJPE, lambda: kt.metrics.MPJPE("similarity"), lambda: kt.metrics.PCK(1.0), kt.metrics.E3D):
        expected = fed(make(), PRED, TRUTH, WEIGHTS).compute()
        assert torch.isfinite(expected)
        assert torch.equal(fed(make(), lost, gone, WEIGHTS).compute(), expected)
    metric = kt.metrics.BoneDeviation(BONES)
    assert torch.equal(
        fed(metric, lost, WEIGHTS).compute(), fed(kt.metrics.BoneDeviation(BONES), PRED, WEIGHTS).compute()
    )


def test_a_prediction_that_is_nan_has_no_constant_bones():
    metric = fed(kt.metrics.BoneDeviation(BONES), PRED)
    with pytest.raises(kt.ShapeError, match="expected finite points"):
        metric.update(PRED * torch.nan)


def test_frames_without_their_root_do_not_count():
    weights = torch.ones(7, 12, 6).double()
    weights[:, 4, 2] = 0
    kept = [t for t in range(12) if t != 4]
    metric = fed(kt.metrics.MPJPE(root=2), PRED, TRUTH, weights)
    expected = mpjpe(PRED[:, kept], TRUTH[:, kept], root=2).mean()
    assert_close(metric.compute().double(), expected, rtol=1e-6, atol=0)


def test_clips_without_anything_known_do_not_count():
    weights = torch.ones(7, 12, 6).double()
    weights[2] = 0
    kept = [0, 1, 3, 4, 5, 6]
    for make in (kt.metrics.MPJPE, kt.metrics.E3D, lambda: kt.metrics.PCK(1.0)):
        expected = fed(make(), PRED[kept], TRUTH[kept], sizes=(3, 3)).compute()
        assert_close(fed(make(), PRED, TRUTH, weights).compute(), expected)
    expected = fed(kt.metrics.BoneDeviation(BONES), PRED[kept], sizes=(3, 3)).compute()
    assert_close(fed(kt.metrics.BoneDeviation(BONES), PRED, weights).compute(), expected)
    nothing = kt.metrics.MPJPE()
    nothing.update(PRED, TRUTH, 0 * weights)
    assert torch.isnan(nothing.compute())


def test_sums_do_not_lose_digits():
    """A million joints at 1 and some at 1000: in single precision the sum would stop growing evenly."""
    metric, truth = kt.metrics.MPJPE("none"), torch.zeros(1, 1000, 50, 3)
    for k in range(400):
        metric.update(truth + torch.tensor([1.0 + 0.001 * (k % 2), 0, 0]), truth)
    assert metric.compute().item() == pytest.approx(1.0005, abs=1e-6)
    assert metric.count.dtype == torch.float64 and metric.count.item() == 400 * 50_000


def test_forward_gives_the_batch_and_keeps_the_sum():
    metric = kt.metrics.MPJPE()
    first = metric(PRED[:3], TRUTH[:3])
    assert first.item() == pytest.approx(mpjpe(PRED[:3], TRUTH[:3]).mean().item())
    metric(PRED[3:], TRUTH[3:])
    assert metric.compute().item() == pytest.approx(mpjpe(PRED, TRUTH).mean().item())
    leaf = PRED.clone().requires_grad_()
    metric.update(leaf, TRUTH)
    assert not metric.total.requires_grad


def test_metrics_join_a_collection_and_are_saved():
    from torchmetrics import MetricCollection

    group = MetricCollection(
        {"mpjpe": kt.metrics.MPJPE(), "pa": kt.metrics.MPJPE("similarity"), "e3d": kt.metrics.E3D()}
    )
    group.update(PRED, TRUTH)
    values = group.compute()
    assert values["pa"] < values["mpjpe"]
    group.persistent(True)
    other = MetricCollection(
        {"mpjpe": kt.metrics.MPJPE(), "pa": kt.metrics.MPJPE("similarity"), "e3d": kt.metrics.E3D()}
    )
    other.load_state_dict(group.state_dict())
    assert other["pa"].total == group["pa"].total


def test_a_collection_takes_no_metric_for_another():
    """Even if the first batch tells none from the others: all joints are near, or none counts."""
    from torchmetrics import MetricCollection

    def made():
        shares = {f"pck{k}": kt.metrics.PCK(k / 100) for k in (5, 10, 20)}
        return shares | {a: kt.metrics.MPJPE(a) for a in ("root", "none")} | {"mid": kt.metrics.MPJPE(root=0)}

    for first in (torch.ones(7, 12, 6), torch.zeros(7, 12, 6)):
        group, alone = MetricCollection(made()), made()
        group.update(TRUTH, TRUTH, first)
        group.update(PRED, TRUTH, torch.ones(7, 12, 6))
        for name, metric in alone.items():
            metric.update(TRUTH, TRUTH, first)
            metric.update(PRED, TRUTH, torch.ones(7, 12, 6))
            assert_close(group.compute()[name], metric.compute())
        assert len(group.compute_groups) == len(alone)
    same = MetricCollection({"a": kt.metrics.MPJPE(), "b": kt.metrics.MPJPE()})
    same.update(PRED, TRUTH)
    assert len(same.compute_groups) == 1


TWO = """
    import sys, torch, kcs_torch as kt
    import torch.distributed as dist
    rank = int(sys.argv[1])
    dist.init_process_group("gloo", init_method="file://" + sys.argv[2], rank=rank, world_size=2)
    draw = torch.Generator().manual_seed(0)
    pred, truth = torch.randn(2, 5, 12, 6, 3, generator=draw, dtype=torch.float64)
    weights = (torch.rand(5, 12, 6, generator=draw) > 0.3).double()
    mine = [slice(0, 4), slice(4, 5)][rank]
    made = [kt.metrics.MPJPE("similarity"), kt.metrics.PCK(1.0), kt.metrics.E3D()]
    for metric in made:
        metric.update(pred[mine], truth[mine], weights[mine])
        print(float(metric.compute()))
    bones = kt.metrics.BoneDeviation([(0, 1), (1, 2)])
    bones.update(pred[mine], weights[mine])
    print(float(bones.compute()))
    dist.destroy_process_group()
"""


def test_processes_add_up(tmp_path):
    """Two processes with unequal shares print what one would."""
    code = textwrap.dedent(TWO)
    running = [
        subprocess.Popen(
            [sys.executable, "-c", code, str(rank), str(tmp_path / "meet")],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=ROOT,
        )
        for rank in range(2)
    ]
    out = [process.communicate(timeout=120) for process in running]
    assert [process.returncode for process in running] == [0, 0], out
    values = [[float(x) for x in text.split()] for text, _ in out]
    draw = torch.Generator().manual_seed(0)
    pred, truth = torch.randn(2, 5, 12, 6, 3, generator=draw, dtype=torch.float64)
    weights = (torch.rand(5, 12, 6, generator=draw) > 0.3).double()
    alone = [kt.metrics.MPJPE("similarity"), kt.metrics.PCK(1.0), kt.metrics.E3D()]
    for metric in alone:
        metric.update(pred, truth, weights)
    bones = kt.metrics.BoneDeviation([(0, 1), (1, 2)])
    bones.update(pred, weights)
    expected = [float(m.compute()) for m in (*alone, bones)]
    assert values[0] == values[1] == pytest.approx(expected, rel=1e-6)


def test_what_is_wrong_is_said():
    with pytest.raises(OptionError, match="did you mean 'similarity'"):
        kt.metrics.MPJPE("similarty")
    with pytest.raises(OptionError, match="threshold of at least 0"):
        kt.metrics.PCK(-1.0)
    with pytest.raises(OptionError, match="root: expected a joint index below 6"):
        kt.metrics.MPJPE(root=6).update(PRED, TRUTH)
    with pytest.raises(ShapeError, match="pairs of joints"):
        kt.metrics.BoneDeviation([])
    with pytest.raises(ShapeError, match="weights"):
        kt.metrics.MPJPE().update(PRED, TRUTH, WEIGHTS[:2])
    with pytest.raises(ShapeError, match="pred and truth of the same shape"):
        kt.metrics.E3D().update(PRED, TRUTH[:, :3])
    with pytest.raises(ShapeError, match="expected finite points"):
        kt.metrics.MPJPE().update(torch.full_like(PRED, torch.nan), TRUTH)
    with pytest.raises(AttributeError, match="no_such"):
        _ = kt.metrics.no_such


def test_metrics_wait_for_torchmetrics_until_they_are_used():
    code = textwrap.dedent("""
        import sys
        sys.modules["torchmetrics"] = None  # as where it is not installed
        import kcs_torch as kt
        kt.metrics.mpjpe
        from kcs_torch.metrics import *
        try:
            kt.metrics.MPJPE
        except ModuleNotFoundError as error:
            print(error)
    """)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert "pip install torchmetrics" in done.stdout and "mpjpe" in done.stdout
    code = "import sys, kcs_torch as kt\nkt.metrics.mpjpe\nassert 'torchmetrics' not in sys.modules\nkt.metrics.MPJPE"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


@pytest.mark.parametrize("align", sorted(kt.metrics.ALIGNMENTS))
def test_points_in_half_precision(align):
    points = torch.randn(2, 5, 17, 3, generator=torch.Generator().manual_seed(0))
    truth = points + 0.1
    metric, exact = kt.metrics.MPJPE(align), kt.metrics.MPJPE(align)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        metric.update(points.bfloat16(), truth)
    exact.update(points.bfloat16().float(), truth)
    torch.testing.assert_close(metric.compute(), exact.compute())


def plain(align, root):
    return mpjpe(torch.zeros(1, 2, 3), torch.zeros(1, 2, 3), align=align, root=root)


@pytest.mark.parametrize("kind", [kt.metrics.MPJPE, kt.nn.JointDistance, plain], ids=["metric", "loss", "plain"])
def test_a_root_is_an_index(kind):
    with pytest.raises(kt.OptionError, match="root: expected the index of a joint"):
        kind("root", root="pelvis")


def test_metrics_in_one_collection():
    from torchmetrics import MetricCollection

    both = MetricCollection({"error": kt.metrics.MPJPE(), "bones": kt.metrics.BoneDeviation(BONES)})
    both.update(pred=PRED, truth=TRUTH)
    assert both.compute()["bones"] == pytest.approx(float(fed(kt.metrics.BoneDeviation(BONES), PRED).compute()))
