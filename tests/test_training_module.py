"""Training: what each loss is given, what one step does, and that it is the same whenever it is done."""

import copy
import json
import math
import re

import lightning
import pytest
import torch
from lightning.pytorch.plugins import MixedPrecision
from torch import nn

import kcs_torch as kt
from kcs_torch.functional import centre
from kcs_torch.metrics import mpjpe
from kcs_torch.training import (
    Batch,
    CycleConsistency,
    LiftingModule,
    LossTerm,
    TracksDataModule,
    load_lifter,
    save_lifter,
)
from kcs_torch.training.augment import mirrored, turned, unit_size
from kcs_torch.training.batch import check_batch
from kcs_torch.training.module import step_share

BODY = kt.SKELETONS["h36m17"]
QUIET = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False, "enable_model_summary": False}
pytestmark = [
    pytest.mark.filterwarnings("ignore:.*does not have many workers"),
    pytest.mark.filterwarnings("ignore:.*smaller than the logging interval"),
    pytest.mark.filterwarnings("ignore:.*LeafSpec"),
    pytest.mark.filterwarnings("ignore:.*Checkpoint directory"),
]


def batch_of(count=6, frames=5, labelled=2, pseudo=2, seed=0):
    """Clips of which the first have labels, the next pseudo-labels, and the rest nothing."""
    draw = torch.Generator().manual_seed(seed)
    points = 100 * torch.randn(count, frames, 17, 3, generator=draw)
    points = centre(points)[0]
    weights = (torch.rand(count, frames, 17, generator=draw) < 0.8).float()
    tracks = (points[..., :2] + 3 * torch.randn(count, frames, 17, 2, generator=draw)) * weights[..., None]
    number = torch.arange(count)
    trusted = ((number >= labelled) & (number < labelled + pseudo)).float()[:, None, None]
    share = torch.rand(count, frames, 17, generator=draw) * trusted
    blind = number >= labelled + pseudo
    return Batch(tracks, weights, points * ~blind[:, None, None, None], (number < labelled).float(), share)


class Asks(nn.Module):
    """A loss that remembers what it was given."""

    def __init__(self, value):
        super().__init__()
        self.result = value


class AsksForTracks(Asks):
    def forward(self, points, tracks, weights):
        self.given = (points, tracks, weights)
        return self.result


class AsksForTarget(Asks):
    def forward(self, points, target, weights=None):
        self.given = (points, target, weights)
        return self.result


class AsksForPoints(Asks):
    def forward(self, points, weights=None):
        self.given = (points, weights)
        return self.result


def test_losses_are_given_what_they_ask_for():
    batch, points = batch_of(), torch.randn(6, 5, 17, 3)
    value = torch.arange(30.0).reshape(6, 5)
    loss = AsksForTracks(value)
    assert LossTerm(loss).value(points, batch, nn.Identity()) == pytest.approx(value.mean().item())
    assert loss.given[1] is batch.tracks and loss.given[2] is batch.weights
    loss = AsksForPoints(value)
    assert LossTerm(loss, clips="unlabelled").value(points, batch, nn.Identity()) == pytest.approx(
        value[2:].mean().item()
    )
    assert loss.given[1] is None  # a network places joints that are unseen: they count
    loss = AsksForTarget(value)
    found = LossTerm(loss).value(points, batch, nn.Identity())
    weights = batch.pseudo.clone()
    weights[:2] = 1
    torch.testing.assert_close(loss.given[2], weights)
    share = weights.mean(-1)
    torch.testing.assert_close(found, (value * share).sum() / share.sum())
    clips = AsksForTarget(value[:, 0])
    found = LossTerm(clips, clips="labelled").value(points, batch, nn.Identity())
    torch.testing.assert_close(found, value[:2, 0].mean())


def test_a_loss_over_nothing_is_0():
    batch = batch_of(labelled=0, pseudo=0)
    points = torch.randn(6, 5, 17, 3, requires_grad=True)
    for chosen in ("all", "labelled"):
        value = LossTerm(kt.nn.JointDistance(), clips=chosen).value(points, batch, nn.Identity())
        assert value == 0
        assert torch.isfinite(torch.autograd.grad(value, points)[0]).all()


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: LossTerm(nn.MSELoss()), "MSELoss needs input"),
        (lambda: LossTerm(kt.nn.JointDistance(), clips="some"), "expected one of all, labelled, unlabelled"),
        (lambda: LossTerm("JointDistance"), "expected a torch.nn.Module, got str"),
        (lambda: LossTerm(kt.nn.JointDistance(), -1), "LossTerm: weight: expected a number not below 0, got -1"),
        (lambda: LossTerm(kt.nn.KCSCritic(BODY, width=4)), r"got KCSCritic.*LiftingModule\(critic="),
        (lambda: LossTerm(torch.compile(kt.nn.KCSCritic(BODY, width=4), backend="eager")), "got KCSCritic"),
        (lambda: LiftingModule(kt.nn.MLPLifter(BODY), {}), "losses: expected a mapping"),
        (lambda: LiftingModule(kt.nn.MLPLifter(BODY), {"a": kt.nn.JointDistance()}), "losses: expected a mapping"),
        (lambda: LiftingModule(kt.nn.MLPLifter(BODY), [LossTerm(CycleConsistency())]), "losses: expected a mapping"),
        (lambda: LiftingModule(kt.nn.MLPLifter(BODY), {"loss": LossTerm(CycleConsistency())}), "names of losses"),
        (lambda: LiftingModule(kt.nn.MLPLifter(BODY), {"a.b": LossTerm(CycleConsistency())}), "names of losses"),
        (lambda: LiftingModule(nn.Identity(), {"a": LossTerm(CycleConsistency())}), "flip: expected a network"),
        (lambda: LiftingModule(kt.nn.MLPLifter(BODY), {"a": LossTerm(CycleConsistency())}, lr=0), "lr: expected"),
    ],
)
def test_wrong_options(make, words):
    with pytest.raises(kt.OptionError, match=words):
        make()


@pytest.mark.parametrize("name", ["critic_weight", "flip", "turn", "lr", "weight_decay", "clip", "seed"])
@pytest.mark.parametrize("value", ["a", None, [1], math.nan, True])
def test_what_is_no_number_is_told_by_its_name(name, value):
    with pytest.raises(kt.OptionError, match=rf"LiftingModule: {name}: expected a .*, got {re.escape(repr(value))}"):
        LiftingModule(kt.nn.MLPLifter(BODY), {"a": LossTerm(CycleConsistency())}, **{name: value})


@pytest.mark.parametrize("shape", [(), (6, 5, 17), (5, 6)], ids=str)
def test_a_loss_of_another_shape_is_told(shape):
    with pytest.raises(kt.ShapeError, match="AsksForPoints to return a number for every clip"):
        LossTerm(AsksForPoints(torch.ones(shape))).value(torch.randn(6, 5, 17, 3), batch_of(), nn.Identity())


@pytest.mark.parametrize(
    ("network", "loss"), [("h36m17", "cmu17"), ("cmu17", "h36m17"), ("cmu17", "cmu17")], ids=lambda name: name
)
def test_other_skeletons_of_as_many_joints_are_told(network, loss):
    module = LiftingModule(kt.nn.MLPLifter(network, width=8), {"bones": LossTerm(kt.nn.BoneLengthEnergy(loss))}, seed=0)
    trainer = lightning.Trainer(max_epochs=1, accelerator="cpu", **QUIET)
    with pytest.raises(kt.SkeletonError, match="the data has 'h36m17'|has skeleton 'cmu17'"):
        trainer.fit(module, datamodule=data_of())


@pytest.mark.parametrize(("clips", "labelled"), [("labelled", 0.0), ("unlabelled", 1.0)])
def test_training_on_nothing_is_told(clips, labelled):
    module = LiftingModule(kt.nn.MLPLifter(BODY, width=8), {"a": LossTerm(kt.nn.SmoothnessEnergy(), clips=clips)})
    trainer = lightning.Trainer(max_epochs=1, accelerator="cpu", **QUIET)
    with pytest.raises(kt.OptionError, match="no clip of a whole epoch counted"):
        trainer.fit(module, datamodule=data_of(labelled=labelled))


def test_half_precision_trains_and_predicts():
    module = module_of()
    trainer = lightning.Trainer(max_epochs=1, accelerator="cpu", precision="bf16-mixed", **QUIET)
    data = data_of()
    trainer.fit(module, datamodule=data)
    assert torch.isfinite(trainer.callback_metrics["val/pa_mpjpe"])
    points = trainer.predict(module, dataloaders=data.val_dataloader())
    assert points[0].shape[1:] == (9, 17, 3) and torch.isfinite(points[0].float()).all()


def test_a_body_without_twins_is_not_mirrored():
    hand = kt.SKELETONS["hand21"]
    points = torch.randn(3, 4, 21, 3)
    batch = Batch(points[..., :2], torch.ones(3, 4, 21), points, torch.ones(3), torch.zeros(3, 4, 21))
    assert mirrored(batch, hand, 1.0) is batch


def test_mirrored_clips_are_clips_of_a_mirrored_body():
    batch = batch_of()
    torch.manual_seed(0)
    every = mirrored(batch, BODY, 1.0)
    torch.testing.assert_close(mirrored(every, BODY, 1.0), batch)
    a, b = BODY.mirror[0]
    torch.testing.assert_close(every.points[:, :, a], batch.points[:, :, b] * torch.tensor([-1.0, 1, 1]))
    torch.testing.assert_close(every.weights[:, :, b], batch.weights[:, :, a])
    for row, (x, y) in zip(every.pseudo, zip(batch.pseudo, batch.weights, strict=True), strict=True):
        assert row.shape == x.shape == y.shape
    bones = kt.nn.BoneLengths(BODY)
    left, right = zip(*BODY.mirror_bones, strict=True)
    torch.testing.assert_close(bones(every.points)[..., list(left)], bones(batch.points)[..., list(right)])
    some = mirrored(batch, BODY, 0.5).points[:, 0, 0, 0] == batch.points[:, 0, 0, 0]
    assert some.any() and not some.all()


def test_turned_clips_show_the_same_body_with_the_same_noise():
    batch = batch_of()
    torch.manual_seed(0)
    other = turned(batch, 1.0)
    known = 4
    torch.testing.assert_close(other.tracks[known:], batch.tracks[known:])
    seen = batch.weights[..., None] > 0
    was = torch.where(seen, batch.tracks - batch.points[..., :2], torch.zeros(()))
    now = torch.where(seen, other.tracks - other.points[..., :2], torch.zeros(()))
    torch.testing.assert_close(now[:known], was[:known], atol=1e-3, rtol=1e-4)
    assert (other.tracks[~(batch.weights > 0)] == 0).all()
    psi = kt.nn.KCSMatrix(BODY)
    torch.testing.assert_close(psi(other.points), psi(batch.points), rtol=1e-4, atol=1.0)
    assert ((other.points - batch.points)[:known].abs().amax((1, 2, 3)) > 1).all()
    torch.testing.assert_close(other.points[..., 1], batch.points[..., 1], atol=1e-3, rtol=1e-4)


def test_turned_clips_stay_where_they_are():
    """Points are in the place of the tracks, as a loss that moves neither takes them to be."""
    batch = batch_of()
    place = torch.cat([900 + 100 * torch.randn(6, 5, 1, 2), torch.zeros(6, 5, 1, 1)], -1)
    tracks = batch.tracks + place[..., :2] * batch.weights[..., None]
    torch.manual_seed(0)
    near = turned(batch, 1.0)
    torch.manual_seed(0)
    far = turned(batch._replace(tracks=tracks, points=batch.points + place), 1.0)
    torch.testing.assert_close(far.points, near.points + place, atol=1e-3, rtol=1e-5)
    torch.testing.assert_close(far.tracks - tracks, near.tracks - batch.tracks, atol=1e-3, rtol=1e-5)


def test_losses_see_clips_of_one_size():
    batch = batch_of()
    half = unit_size(Batch(*(20 * value.half() if value.ndim > 3 else value.half() for value in batch)))
    assert half.tracks.dtype == half.points.dtype == torch.float16
    torch.testing.assert_close(half.tracks.float(), unit_size(batch).tracks, atol=2e-3, rtol=2e-3)
    torch.testing.assert_close(half.points.float(), unit_size(batch).points, atol=2e-3, rtol=2e-3)
    small, large = unit_size(batch), unit_size(batch._replace(tracks=50 * batch.tracks, points=50 * batch.points))
    torch.testing.assert_close(small.tracks, large.tracks)
    torch.testing.assert_close(small.points, large.points)
    blank = unit_size(batch._replace(tracks=0 * batch.tracks, weights=0 * batch.weights))
    assert torch.isfinite(blank.points).all()


def test_what_is_nan_is_unseen_or_not_labelled():
    """In the size of clips, in turns, and in losses of targets."""
    batch = batch_of()
    hidden = (batch.weights > 0)[..., None]
    size = unit_size(batch)
    for weights in (batch.weights, torch.ones_like(batch.weights)):
        got = unit_size(batch._replace(tracks=torch.where(hidden, batch.tracks, torch.nan), weights=weights))
        torch.testing.assert_close(got.points, size.points)
        torch.testing.assert_close(torch.where(hidden, got.tracks, 0), size.tracks)
    points = batch.points.clone()
    points[:2, :, 9] = points[1, 3] = torch.nan
    some = batch._replace(points=points)
    got = turned(some, 1.0)
    assert torch.equal(got.points.isnan(), points.isnan())
    assert not torch.equal(got.tracks[0], batch.tracks[0]) and torch.equal(got.tracks[1], batch.tracks[1])
    assert got.tracks.isfinite().all() and not got.weights[0, :, 9].any() and not got.tracks[0, :, 9].any()
    rest = [joint for joint in range(17) if joint != 9]
    assert torch.equal(got.weights[0][:, rest], batch.weights[0][:, rest])
    assert torch.equal(got.weights[1:], batch.weights[1:])
    noise = (tracks - p[..., :2] for tracks, p in ((got.tracks[0], got.points[0]), (batch.tracks[0], points[0])))
    seen = batch.weights[0][:, rest, None]
    torch.testing.assert_close(*(x[:, rest] * seen for x in noise), rtol=1e-4, atol=1e-3)
    half = batch._replace(points=torch.where(torch.arange(5)[:, None, None] < 2, batch.points, torch.nan))
    loss = lambda at: LossTerm(kt.nn.JointDistance(), clips="labelled").value(  # noqa: E731
        at.points.nan_to_num() + torch.arange(3), at, nn.Identity()
    )
    assert float(loss(half)) == pytest.approx(float(loss(batch)), rel=1e-5)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda b: tuple(b), r"batch: expected a kcs_torch.training.Batch\(tracks, .*\), got tuple"),
        (lambda b: b._replace(pseudo=None), "batch.pseudo: expected a tensor, got NoneType"),
        (lambda b: b._replace(points=b.points.int()), "batch.points: expected numbers in floating point"),
        (
            lambda b: Batch(*(x[:, :, :17] if x.ndim > 1 else x for x in b)),
            r"batch.tracks: expected \(B, T, 19, 2\) .* got \(4, 5, 17, 2\): without its virtual joints pelvis, neck",
        ),
        (lambda b: Batch(*(torch.stack([x, x]) for x in b)), "batches were stacked, .*batch_size=None"),
        (lambda b: Batch(*(x[0] for x in b)), "a single clip has B = 1"),
        (lambda b: b._replace(weights=b.weights[..., None]), r"batch.weights: expected \(4, 5, 19\) for tracks"),
        (
            lambda b: b._replace(points=b.points[..., :2]),
            r"batch.points: expected \(4, 5, 19, 3\) .*, got",
        ),
        (lambda b: b._replace(labelled=b.labelled[:, None]), r"batch.labelled: expected \(4,\) .* got \(4, 1\)"),
        (lambda b: b._replace(pseudo=b.pseudo[:, 0]), r"batch.pseudo: expected \(4, 5, 19\) .* got \(4, 19\)"),
    ],
)
def test_a_batch_that_is_none_is_told(change, told):
    points, weights = torch.randn(4, 5, 19, 3), torch.ones(4, 5, 19)
    batch = Batch(points[..., :2], weights, points, torch.ones(4), torch.zeros_like(weights))
    module = LiftingModule(kt.nn.MLPLifter("coco17", width=4), {"joints": LossTerm(kt.nn.JointDistance())})
    for step in (module.training_step, module.validation_step, module.test_step, module.predict_step):
        with pytest.raises(kt.ShapeError, match=told):
            step(change(batch), 0)


def test_labels_may_be_true_or_false():
    batch = batch_of()
    got = check_batch(batch._replace(labelled=batch.labelled > 0, weights=batch.weights.int()), BODY)
    assert all(torch.equal(one, other) and one.dtype == other.dtype for one, other in zip(got, batch, strict=True))


def test_cycle_consistency_is_0_for_a_network_that_is_right():
    truth = centre(torch.randn(4, 3, 17, 3, dtype=torch.float64))[0]
    loss = CycleConsistency()
    seen = []

    class Oracle(nn.Module):
        """Knows the depth of what was turned, as it saw how."""

        def forward(self, tracks, weights):
            seen.append(tracks)
            return self.answer

    oracle = Oracle()
    torch.manual_seed(3)
    from kcs_torch.functional import orbit

    yaw = 360 * torch.rand(4, dtype=torch.float64)
    oracle.answer = truth @ orbit(yaw).mT[:, None] + 5
    torch.manual_seed(3)
    assert loss(truth, oracle).abs().max() < 1e-6
    torch.testing.assert_close(seen[0] + 5, oracle.answer[..., :2])
    oracle.answer = oracle.answer * torch.tensor([1.0, 1, -1])
    torch.manual_seed(3)
    assert loss(truth, oracle).min() > 0.3


TERMS = {
    "joints": lambda: LossTerm(kt.nn.JointDistance(align="root")),
    "bones": lambda: LossTerm(kt.nn.BoneLengthEnergy(BODY), 0.1),
    "tracks": lambda: LossTerm(kt.nn.ReprojectionEnergy(), 0.1),
    "cycle": lambda: LossTerm(CycleConsistency(), 0.1, clips="unlabelled"),
}


def module_of(seed=0, **options):
    torch.manual_seed(seed)
    network = kt.nn.TemporalLifter(BODY, channels=16, dilations=(1, 2))
    return LiftingModule(network, {name: make() for name, make in TERMS.items()}, seed=seed, **options)


def data_of(**options):
    defaults = {"clips": 2, "window": 9, "views": 2, "batch_size": 8, "labelled": 0.25, "seed": 0, "noise": 2.0}
    return TracksDataModule(**{**defaults, "occlusion": 0.1, "skeleton": "h36m17", "steps_per_epoch": 4, **options})


def fit(module, epochs, **options):
    trainer = lightning.Trainer(
        max_epochs=epochs, accelerator="cpu", **{**QUIET, **{k: v for k, v in options.items() if k != "ckpt_path"}}
    )
    trainer.fit(module, datamodule=data_of(), ckpt_path=options.get("ckpt_path"), weights_only=True)
    return trainer


@pytest.mark.parametrize("scaled", [False, True], ids=["single", "half"])
def test_gradients_are_cut_after_their_scale_is_undone(scaled, monkeypatch):
    """In half precision a scaler multiplies the loss by 65536: gradients that are cut before have no length left."""
    norms, taken = [], torch.optim.AdamW.step

    def step(self, *rest, **more):
        out = taken(self, *rest, **more)  # which cuts them first
        grads = [p.grad for group in self.param_groups for p in group["params"] if p.grad is not None]
        norms.append(float(torch.linalg.vector_norm(torch.stack([g.norm() for g in grads]))))
        return out

    monkeypatch.setattr(torch.optim.AdamW, "step", step)
    plugins = [MixedPrecision("16-mixed", "cpu", torch.amp.GradScaler("cpu"))] if scaled else []
    fit(module_of(clip=0.05), 2, plugins=plugins)
    assert len(norms) > 3 and min(norms) > 0.04 and max(norms) < 0.051


@pytest.mark.parametrize("options", [{}, {"critic": True}, {"refine": True}], ids=["plain", "critic", "refine"])
def test_the_same_seed_gives_the_same_weights(options):
    def train():
        made = {}
        torch.manual_seed(1)
        if "critic" in options:
            made["critic"] = kt.nn.KCSCritic(BODY, width=8)
        if "refine" in options:
            made["refine"] = kt.nn.UnrolledSfAM(BODY, num_steps=2)
        module = module_of(**made)
        before = copy.deepcopy(module.state_dict())
        fit(module, 2)
        torch.rand(7)  # what the caller draws in between does not matter
        return before, module.state_dict()

    (before, first), (_, second) = train(), train()
    assert all(torch.equal(first[name], second[name]) for name in first)
    moved = [name for name in first if not torch.equal(first[name], before[name])]
    assert any(name.startswith("network.") for name in moved) and first["step"] == 8
    for part in options:
        inside = "network.solver." if part == "refine" else "critic."
        assert any(name.startswith(inside) for name in moved)


def test_a_run_that_is_resumed_ends_as_it_would_have(tmp_path):
    whole = module_of()
    fit(whole, 4)
    half = module_of()
    trainer = lightning.Trainer(max_epochs=4, accelerator="cpu", **QUIET)

    class Stop(lightning.Callback):
        def on_train_epoch_end(self, trainer, pl_module):
            if trainer.current_epoch == 1:
                trainer.save_checkpoint(tmp_path / "half.ckpt")
                trainer.should_stop = True

    trainer.callbacks = [Stop()]
    trainer.fit(half, datamodule=data_of())
    assert int(half.step) == 8
    taken = module_of(seed=5)
    taken.seed = 0
    fit(taken, 4, ckpt_path=tmp_path / "half.ckpt")
    end, other = whole.state_dict(), taken.state_dict()
    assert all(torch.equal(end[name], other[name]) for name in end if name.startswith("network."))


def sizes(module):
    """The size of each step that the module makes from here on."""
    seen, advance = [], module._advance

    def spy(optimiser, *rest, **more):
        advance(optimiser, *rest, **more)
        seen.extend(group["lr"] for group in optimiser.param_groups)

    module._advance = spy
    return seen


def test_steps_rise_and_fall_over_all_epochs():
    module = module_of(lr=0.1)
    seen = sizes(module)
    fit(module, 5)
    assert len(seen) == 20 and seen[0] == max(seen) == 0.1 and seen == sorted(seen, reverse=True)
    assert seen[-1] == 0.1 * step_share(19, 20) < 0.002
    long = [step_share(step, 100) for step in range(100)]
    assert long[:5] == [0.2, 0.4, 0.6, 0.8, 1.0] and long[5:] == sorted(long[5:], reverse=True)


@pytest.mark.parametrize("scaled", [False, True], ids=["single", "half"])
def test_steps_of_a_critic_are_none_of_max_steps(scaled):
    critic = kt.nn.KCSCritic(BODY, width=8)
    before = copy.deepcopy(critic.state_dict())
    module = module_of(critic=critic)
    seen = sizes(module)
    plugins = [MixedPrecision("16-mixed", "cpu", torch.amp.GradScaler("cpu"))] if scaled else []
    trainer = lightning.Trainer(max_steps=6, accelerator="cpu", plugins=plugins, **QUIET)
    trainer.fit(module, datamodule=data_of())
    assert int(module.step) == trainer.global_step == 6
    assert seen == [module.lr * step_share(step, 6) for step in range(6) for _ in range(2)]
    assert not all(torch.equal(before[name], value) for name, value in critic.state_dict().items())


def test_a_run_that_goes_on_for_longer_has_the_steps_of_a_longer_one(tmp_path):
    """A checkpoint does not bring the length of its own run along, nor its step size."""
    fit(module_of(), 2).save_checkpoint(tmp_path / "short.ckpt")
    taken = module_of(lr=0.01, weight_decay=0.5)
    seen = sizes(taken)
    trainer = fit(taken, 4, ckpt_path=tmp_path / "short.ckpt")
    assert seen == [0.01 * step_share(step, 16) for step in range(8, 16)]
    assert {group["weight_decay"] for group in trainer.optimizers[0].param_groups} == {0.5}


def test_a_module_trains_again_under_another_trainer_after_it_was_validated():
    """Lightning validates in inference mode, and what was made there may not be changed in training."""
    module = module_of()
    first = fit(module, 2)
    first.validate(module, datamodule=data_of(), verbose=False)
    seen = sizes(module)
    fit(module, 1)
    assert seen == [module.lr * step_share(step, 4) for step in range(4)] and int(module.step) == 4
    first.fit_loop.max_epochs = 3
    first.fit(module, datamodule=data_of())  # the trainer goes on where it was, and so do the steps
    assert int(module.step) == 12


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"gradient_clip_val": 1.0}, r"gradient_clip_val: expected None, got 1\.0: .*\(clip="),
        ({"accumulate_grad_batches": 4}, r"accumulate_grad_batches: expected 1, got 4: .*\(batch_size="),
        ({"max_epochs": -1}, "expected max_epochs or max_steps"),
    ],
)
def test_options_of_the_trainer_that_mean_nothing_here_are_told(options, told):
    module = module_of()
    trainer = lightning.Trainer(accelerator="cpu", **{**QUIET, "max_epochs": 1, **options})
    with pytest.raises(kt.OptionError, match=told):
        trainer.fit(module, datamodule=data_of())
    assert int(module.step) == 0


def test_network_and_critic_need_a_strategy_that_finds_unused_parameters():
    trainer = lambda name: lightning.Trainer(strategy=name, accelerator="cpu", devices=1, **QUIET)  # noqa: E731
    alone, both = module_of(), module_of(critic=kt.nn.KCSCritic(BODY, width=8))
    both.trainer = trainer("ddp")
    with pytest.raises(kt.OptionError, match="strategy: .*ddp_find_unused_parameters_true"):
        both.configure_callbacks()
    for module, name in ((both, "ddp_find_unused_parameters_true"), (both, "auto"), (alone, "ddp")):
        module.trainer = trainer(name)
        assert module.configure_callbacks() == []


def test_what_a_loss_has_to_learn_is_trained():
    class Sure(nn.Module):
        """Distances over their own deviation."""

        def __init__(self):
            super().__init__()
            self.log = nn.Parameter(torch.zeros(()))

        def forward(self, points, target, weights):
            return ((points - target).norm(dim=-1) * weights).mean(-1) / self.log.exp() + self.log

    module = LiftingModule(kt.nn.MLPLifter(BODY, width=16), {"joints": LossTerm(Sure(), clips="labelled")})
    fit(module, 1)
    assert module.terms["joints"].log.item() != 0


def test_training_brings_the_error_down():
    torch.manual_seed(0)
    network = kt.nn.TemporalLifter(BODY, channels=32, dilations=(1,), dropout=0.0)
    module = LiftingModule(network, {"joints": LossTerm(kt.nn.JointDistance())}, lr=1e-2)
    data = data_of(labelled=1.0, occlusion=0.0, steps_per_epoch=60, batch_size=32, clips=8, views=4)
    data.setup("validate")
    batches = list(data.val_dataloader())

    def error():
        network.eval()
        with torch.no_grad():
            each = [mpjpe(network(b.tracks, b.weights), b.points) for b in batches]
        network.train()
        return float(torch.cat(each).mean())

    before = error()
    trainer = lightning.Trainer(max_epochs=4, accelerator="cpu", **QUIET)
    trainer.fit(module, datamodule=data)
    after = error()
    assert after < 0.7 * before
    logged = trainer.callback_metrics
    assert float(logged["val/mpjpe"]) == pytest.approx(after, rel=1e-4)
    assert logged["val/pa_mpjpe"] <= logged["val/rigid"] <= logged["val/mpjpe"]
    assert 0 < logged["val/bone_deviation"] < 1


def test_the_critic_learns_from_labelled_clips_alone():
    module = module_of(critic=kt.nn.KCSCritic(BODY, width=8))
    before = copy.deepcopy(module.critic.state_dict())
    trainer = lightning.Trainer(max_epochs=1, accelerator="cpu", **QUIET)
    trainer.fit(module, datamodule=data_of(labelled=0.0))
    assert all(torch.equal(before[name], value) for name, value in module.critic.state_dict().items())


def test_clips_of_which_some_joints_have_labels_train_and_measure():
    """A critic sees whole poses alone; what is not labelled counts nowhere."""
    batch = batch_of(labelled=6, pseudo=0)
    points = batch.points.clone()
    points[:3, 1:, 9] = torch.nan
    batch = batch._replace(points=points, labelled=batch.labelled > 0)
    module = module_of(critic=kt.nn.KCSCritic(BODY, width=8))
    before = copy.deepcopy(module.critic.state_dict())
    trainer = lightning.Trainer(max_epochs=2, accelerator="cpu", num_sanity_val_steps=0, **QUIET)
    batches = torch.utils.data.DataLoader([batch], batch_size=None)
    trainer.fit(module, batches, batches)
    assert module.trouble is None
    assert all(math.isfinite(value) for value in trainer.callback_metrics.values())
    assert not all(torch.equal(before[name], value) for name, value in module.critic.state_dict().items())


class _OfMotion(torch.nn.Module):
    """A critic of clips."""

    def __init__(self):
        super().__init__()
        self.seen, self.layer = [], torch.nn.LazyLinear(1)

    def forward(self, points):
        self.seen.append(points.shape)
        return self.layer(points.flatten(1))


def test_a_critic_sees_clips_where_all_is_labelled():
    critic = _OfMotion()
    critic(torch.zeros(1, 5, 17, 3))
    batches = torch.utils.data.DataLoader([batch_of(labelled=6, pseudo=0)], batch_size=None)
    trainer = lightning.Trainer(max_epochs=1, accelerator="cpu", num_sanity_val_steps=0, **QUIET)
    trainer.fit(module_of(critic=critic, turn=0.0), batches, batches)
    assert critic.seen[1:] == [(6, 5, 17, 3)] * 3


def test_a_loss_without_weights_does_not_see_what_is_not_labelled():
    class Square(torch.nn.Module):
        def forward(self, points, target):
            return (points - target).square().mean((-1, -2))

    batch = batch_of(labelled=6, pseudo=0)
    points = batch.points.clone().requires_grad_()
    target = torch.where(torch.arange(17)[:, None] == 9, torch.nan, batch.points + 1)
    value = LossTerm(Square()).value(points, batch._replace(points=target), None)
    assert value.item() == pytest.approx(16 / 17)
    assert bool((torch.autograd.grad(value, points)[0][:, :, 9] == 0).all())


def test_a_refined_network_keeps_to_the_tracks_and_can_be_saved(tmp_path):
    torch.manual_seed(0)
    solver = kt.nn.UnrolledSfAM(BODY, num_steps=4, mu=0.01, articulate_from=0, learnable_lengths=True)
    network = kt.nn.RefinedLifter(kt.nn.TemporalLifter(BODY, channels=16), solver).eval()
    clip = kt.data.walking_person(30, skeleton=BODY, dtype=torch.float32, noise=1)
    tracks, weights = clip.tracks.points[None], clip.tracks.weights[None]
    points = network(tracks, weights)
    moved = network(2 * tracks + 70, weights)
    torch.testing.assert_close(moved[..., :2], 2 * points[..., :2] + 70, rtol=1e-3, atol=0.5)
    unseen = weights.clone()
    unseen[0, 4, 3] = unseen[0, 9] = 0
    hidden = torch.where(unseen[..., None] > 0, tracks, torch.nan)
    assert torch.equal(network(hidden), network(tracks, unseen))
    alone = network.network(tracks, weights)
    error, before = ((p[..., :2] - tracks).norm(dim=-1).mean() for p in (points, alone))
    assert error < 20 and torch.isfinite(points).all() and before > 0
    path = save_lifter(tmp_path / "refined.safetensors", network, fps=30)
    again = load_lifter(path)
    assert torch.equal(again.network.eval()(tracks, weights), points)
    assert kt.reconstruct(clip.tracks, method=again).points.shape == (30, 17, 3)
    hidden = torch.zeros_like(weights)
    blank = network(tracks * torch.nan, hidden)
    assert torch.isfinite(blank).all()
    with pytest.raises(kt.OptionError, match="solver to save"):
        save_lifter(tmp_path / "other.safetensors", kt.nn.RefinedLifter(network.network, nn.Identity()))


@pytest.mark.parametrize("gradient", ["unrolled", "implicit", kt.solvers.Implicit(7, 1e-3, 5, 0.1)], ids=str)
@pytest.mark.parametrize("solver", ["UnrolledFPC", "UnrolledSfAM", "UnrolledPKC"])
def test_files_tell_how_a_solver_is_differentiated(tmp_path, solver, gradient):
    """An implicit gradient is that of a fixed point, which the solver goes on to."""
    torch.manual_seed(0)
    options = {"num_steps": 3, "gradient": gradient}
    if solver == "UnrolledPKC":
        options |= {"eps": 0.3, "realign_from": 0.3, "learnable_lengths": True}
    own = kt.nn.UnrolledFPC(**options) if solver == "UnrolledFPC" else getattr(kt.nn, solver)(BODY, **options)
    network = kt.nn.RefinedLifter(kt.nn.TemporalLifter(BODY, channels=8), own).eval()
    again = load_lifter(save_lifter(tmp_path / "a.safetensors", network)).network.eval()
    assert again.solver.implicit == own.implicit
    tracks = 300 * torch.randn(1, 9, 17, 2)
    assert torch.equal(again(tracks), network(tracks))


@pytest.mark.parametrize("corner", [0.3, math.inf])
@pytest.mark.parametrize("solver", ["UnrolledFPC", "UnrolledSfAM"])
def test_files_from_before_corners_were_learned(tmp_path, corner, solver):
    """A file says which corner its solver was made with, or is from before there were any; it has no more."""
    from safetensors.torch import load, save

    torch.manual_seed(0)
    options = {"num_steps": 3, "mu": 0.1, "corner": corner}
    own = kt.nn.UnrolledFPC(**options) if solver == "UnrolledFPC" else kt.nn.UnrolledSfAM(BODY, **options)
    network = kt.nn.RefinedLifter(kt.nn.TemporalLifter(BODY, channels=8), own).eval()
    tracks = torch.randn(2, 9, 17, 2)
    path, old = save_lifter(tmp_path / "new.safetensors", network), tmp_path / "old.safetensors"
    data = path.read_bytes()
    facts = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])["__metadata__"]
    assert ("corner" in json.loads(facts["kcs_torch"])["solver_options"]) == math.isfinite(corner)
    tensors = load(data)
    assert (tensors.pop("solver.raw_corner", None) is not None) == math.isfinite(corner)
    old.write_bytes(save(tensors, facts))
    for file in (path, old):
        assert torch.equal(load_lifter(file).network.eval()(tracks), network(tracks))
    del tensors["solver.raw_step"]
    old.write_bytes(save(tensors, facts))
    with pytest.raises(kt.FormatError, match=r"do not fit its options: solver\.raw_step"):
        load_lifter(old)


def test_a_network_of_ones_own_trains_and_is_told_that_it_has_no_file(tmp_path):
    from hydra import compose, initialize_config_dir

    from kcs_torch.training.run import configs, train

    with initialize_config_dir(version_base="1.3", config_dir=str(configs())):
        config = compose(
            "train",
            overrides=[
                "experiment=smoke",
                "solver=sfam",
                "solver._target_=kcs_torch.nn.UnrolledKCS",
                "solver.num_steps=1",
                "~solver.articulate_from",
                "~solver.corner",
                "+trainer.logger=false",
            ],
        )
    with pytest.warns(kt.KcsWarning, match="no lifter.safetensors, .* takes: unknown solver to save"):
        outcome = train(config, tmp_path)
    assert outcome.lifter is None and outcome.metrics["test/mpjpe"] > 0


def test_losses_that_are_compiled_or_take_anything():
    class Anything(nn.Module):
        def forward(self, points, *more, **options):
            return points.square().mean((-3, -2, -1))

    batch, points = batch_of(), torch.randn(6, 5, 17, 3)
    energy = kt.nn.BoneLengthEnergy(BODY)
    compiled = LossTerm(torch.compile(energy, backend="eager")).value(points, batch, nn.Identity())
    assert compiled == pytest.approx(LossTerm(energy).value(points, batch, nn.Identity()))
    assert LossTerm(Anything()).value(points, batch, nn.Identity()) == pytest.approx(points.square().mean().item())
