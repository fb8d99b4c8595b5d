"""Training as it is configured: what a run leaves, that it can be repeated and resumed."""

import json
import math
from pathlib import Path

import pytest
import torch

import kcs_torch as kt

pytest.importorskip("lightning", reason="training needs the extra: pip install -e '.[train]'")
hydra = pytest.importorskip("hydra")

from training_runs import SMALL, called, composed, logged, rows, same, weights  # noqa: E402

from kcs_torch.training import LiftingModule, load_lifter  # noqa: E402
from kcs_torch.training.run import configs, train  # noqa: E402


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """One short run, and its folder."""
    folder = tmp_path_factory.mktemp("run")
    return train(composed("trainer.max_epochs=4"), folder), folder


def told_by(lifter):
    """The configuration that a lifter's file holds."""
    data = lifter.read_bytes()
    header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])["__metadata__"]["kcs_torch"]
    return json.loads(header)["notes"]["config"]


class TestARun:
    def test_logs_to_csv(self, run):
        _, folder = run
        assert len(logged(folder, "val/mpjpe")) == 4
        assert len(logged(folder, "train/loss")) == 12
        assert len(logged(folder, "test/mpjpe")) == 1

    def test_logs_to_tensorboard(self, run):
        from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

        _, folder = run
        events = EventAccumulator(str(folder / "tensorboard"))
        events.Reload()
        values = [event.value for event in events.Scalars("val/mpjpe")]
        assert values == pytest.approx(logged(folder, "val/mpjpe"))

    def test_its_value_is_the_best_that_was_logged(self, run):
        outcome, folder = run
        assert outcome.value == min(logged(folder, "val/mpjpe"))
        assert outcome.metrics["test/mpjpe"] == pytest.approx(logged(folder, "test/mpjpe")[0])

    def test_the_lifter_has_the_weights_of_the_best_epoch(self, run):
        outcome, folder = run
        lifter = load_lifter(outcome.lifter)
        best = torch.load(folder / "checkpoints" / "best.ckpt", weights_only=True)
        for name, value in lifter.network.state_dict().items():
            assert torch.equal(value, best["state_dict"][f"network.{name}"])
        assert lifter.fps == 30
        tracks = kt.data.walking_person(12, skeleton="cmu21").tracks
        assert kt.reconstruct(tracks, method=lifter).points.isfinite().all()

    def test_checkpoint_and_lifter_tell_the_configuration(self, run):
        outcome, folder = run
        config = torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)["config"]
        assert config["trainer"]["max_epochs"] == 4 and config["model"]["channels"] == 8
        assert told_by(outcome.lifter) == config

    def test_a_solver_behind_the_network_is_a_part_of_the_lifter(self, tmp_path):
        outcome = train(composed("solver=sfam", "solver.num_steps=2", "trainer.max_epochs=1"), tmp_path / "first")
        network = load_lifter(outcome.lifter).network
        assert isinstance(network, kt.nn.RefinedLifter) and network.solver.num_steps == 2
        assert network.solver.corner == math.inf and told_by(outcome.lifter)["solver"]["corner"] == ".inf"
        with pytest.warns(kt.KcsWarning), pytest.raises(kt.OptionError, match="resume=.*does not fit.*parameter group"):
            constants = "solver.num_steps=2", "+solver.learnable=false"
            train(composed("solver=sfam", *constants, f"resume={tmp_path / 'first'}"), tmp_path / "second")

    def test_the_same_seed_gives_the_same_run(self, run, tmp_path):
        outcome, folder = run
        again = train(composed("trainer.max_epochs=4"), tmp_path)
        assert (again.value, again.metrics) == (outcome.value, outcome.metrics)
        assert same(weights(folder), weights(tmp_path))
        assert rows(tmp_path / "csv" / "metrics.csv") == rows(folder / "csv" / "metrics.csv")

    def test_another_seed_gives_another_run(self, run, tmp_path):
        train(composed("trainer.max_epochs=1", "seed=1"), tmp_path)
        assert not same(weights(run[1]), weights(tmp_path))


class Own(torch.nn.Module):
    """A network of one's own."""

    def __init__(self, skeleton: str, width: int = 8) -> None:
        super().__init__()
        self.skeleton = kt.SKELETONS[skeleton]
        count = self.skeleton.num_joints
        self.layers = torch.nn.Sequential(torch.nn.Linear(2 * count, width), torch.nn.Linear(width, count))

    def forward(self, tracks, weights=None):
        return torch.cat([tracks, self.layers(tracks.flatten(-2))[..., None]], -1)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("own")
    words = [word for word in SMALL if "model" not in word]
    with hydra.initialize_config_dir(version_base="1.3", config_dir=str(configs())):
        config = hydra.compose("train", overrides=[*words, f"model._target_={__name__}.Own"])
    with pytest.warns(kt.KcsWarning, match=r"best\.ckpt.*load_lifter\(.*network="):
        assert train(config, folder).lifter is None
    return folder / "checkpoints" / "best.ckpt"


class TestANetworkOfOnesOwn:
    def test_is_used_from_its_checkpoint(self, trained):
        lifter = load_lifter(trained, network=Own("cmu21"))
        held = torch.load(trained, weights_only=True)["state_dict"]
        assert lifter.fps == 30 and not lifter.network.training
        assert same({f"network.{name}": value for name, value in lifter.network.state_dict().items()}, {
            name: value for name, value in held.items() if name.startswith("network.")
        })  # fmt: skip
        assert (
            kt.reconstruct(kt.data.walking_person(12, skeleton="coco17").tracks, method=lifter).points.isfinite().all()
        )

    def test_errors_say_how(self, trained, run):
        with pytest.raises(kt.FormatError, match=r"weights of a Own made as this one is, got others: layers\.0\.bias"):
            load_lifter(trained, network=Own("cmu21", width=9))
        with pytest.raises(kt.FormatError, match="expected a checkpoint of a LiftingModule"):
            load_lifter(run[1] / "lifter.safetensors", network=Own("cmu21"))
        with pytest.raises(kt.FormatError, match=r"lifter\.safetensors of the same run, or give .*network="):
            load_lifter(trained)
        with pytest.raises(kt.OptionError, match=r"expected network=\.\.\. and losses=.*load_lifter\(path, network="):
            LiftingModule.load_from_checkpoint(trained)
        tracks = kt.data.walking_person(12, skeleton="cmu21").tracks
        with pytest.raises(kt.OptionError, match=r"got the file .*load_lifter"):
            kt.reconstruct(tracks, method=str(trained))

    def test_lift_says_how(self, trained, tmp_path):
        from typer.testing import CliRunner

        from kcs_torch.cli import app

        kt.save(kt.data.walking_person(12, skeleton="cmu21").tracks, tmp_path / "in.npz")
        done = CliRunner().invoke(
            app, ["lift", str(tmp_path / "in.npz"), "-o", str(tmp_path / "a.csv"), "-m", str(trained)]
        )
        assert done.exit_code == 2 and "load_lifter(path, network=...)" in done.stderr


def test_callbacks_of_ones_own_join_in(tmp_path):
    stopping = "{_target_: lightning.pytorch.callbacks.EarlyStopping, monitor: val/mpjpe, patience: 1, min_delta: 1e9}"
    for given in (stopping, f"[{stopping}]"):
        folder = tmp_path / str(len(given))
        train(composed("trainer.max_epochs=9", f"+trainer.callbacks={given}"), folder)
        assert len(logged(folder, "val/mpjpe")) == 2  # the second epoch brings no 1e9 mm more


class Killed(RuntimeError):
    pass


def killed(monkeypatch, at: int, folder: Path, *overrides: str) -> None:
    """Train until a step, and die there."""
    step = LiftingModule.training_step

    def dies(self, batch, batch_idx):
        if int(self.step) == at:
            raise Killed
        step(self, batch, batch_idx)

    with monkeypatch.context() as patch:
        patch.setattr(LiftingModule, "training_step", dies)
        with pytest.raises(Killed):
            train(composed(*overrides), folder)


def test_tracks_of_ones_own_are_trained_on_without_labels(tmp_path):
    kt.save(kt.data.walking_person(40, skeleton="coco17").tracks, tmp_path / "walk.npz")
    words = "loss=hybrid", f"+data.folder={tmp_path}", "+data.tracks=*.npz", "skeleton=coco17", "trainer.max_epochs=1"
    outcome = train(composed(*words), tmp_path / "run")
    assert outcome.value < math.inf and outcome.lifter is not None
    alone = "+data.labelled=0", "+data.unlabelled=false", "loss=bones"
    assert train(composed(*words, *alone), tmp_path / "alone").value < math.inf


class TestResuming:
    @pytest.mark.parametrize("at", [6, 10])
    def test_a_killed_run_goes_on_as_if_nothing_had_happened(self, run, tmp_path, monkeypatch, at):
        outcome, folder = run
        killed(monkeypatch, at, tmp_path / "first", "trainer.max_epochs=4")
        again = train(composed("trainer.max_epochs=4", f"resume={tmp_path / 'first'}"), tmp_path / "second")
        assert (again.value, again.metrics) == (outcome.value, outcome.metrics)
        assert same(weights(folder), weights(tmp_path / "second"))
        epochs = at // 3
        assert logged(tmp_path / "second", "val/mpjpe") == logged(folder, "val/mpjpe")[epochs:]
        assert logged(tmp_path / "second", "train/loss") == logged(folder, "train/loss")[3 * epochs :]

    def test_a_run_that_had_ended_stays_as_it_is(self, run, tmp_path):
        outcome, folder = run
        again = train(composed("trainer.max_epochs=4", f"resume={folder / 'checkpoints' / 'last.ckpt'}"), tmp_path)
        assert (again.value, again.metrics) == (outcome.value, outcome.metrics)
        old, new = (load_lifter(one.lifter).network.state_dict() for one in (outcome, again))
        assert same(old, new)

    def test_what_was_best_before_stays_best_though_the_folder_has_moved(self, tmp_path, monkeypatch):
        options = ("trainer.max_epochs=3", "mode=max")  # the error falls: the first epoch is the "best"
        outcome = train(composed(*options), tmp_path / "whole")
        killed(monkeypatch, 6, tmp_path / "first", *options)
        moved = (tmp_path / "first").rename(tmp_path / "moved")
        again = train(composed(*options, f"resume={moved}"), tmp_path / "second")
        assert (
            again.value == outcome.value == logged(moved, "val/mpjpe")[0] > logged(tmp_path / "second", "val/mpjpe")[0]
        )
        assert again.metrics == outcome.metrics
        assert again.lifter.parent == tmp_path / "second"
        old, new = (load_lifter(one.lifter).network.state_dict() for one in (outcome, again))
        assert same(old, new)
        first = torch.load(tmp_path / "whole" / "checkpoints" / "best.ckpt", weights_only=True)["state_dict"]
        assert all(torch.equal(value, first[f"network.{name}"]) for name, value in old.items())
        assert not same(first, weights(tmp_path / "whole"))

    def test_in_its_own_folder_goes_on_in_its_log(self, run, tmp_path, monkeypatch):
        killed(monkeypatch, 7, tmp_path, "trainer.max_epochs=4")
        train(composed("trainer.max_epochs=4", f"resume={tmp_path}"), tmp_path)
        assert rows(tmp_path / "csv" / "metrics.csv") == rows(run[1] / "csv" / "metrics.csv")
        with pytest.warns(kt.KcsWarning, match="max_epochs was 4, is 5"):
            train(composed("trainer.max_epochs=5", f"resume={tmp_path}"), tmp_path)
        assert len(logged(tmp_path, "val/mpjpe")) == 5 and len(logged(tmp_path, "test/mpjpe")) == 1

    def test_the_best_checkpoint_is_missed(self, tmp_path, monkeypatch):
        killed(monkeypatch, 4, tmp_path / "first")
        (tmp_path / "first" / "checkpoints" / "best.ckpt").unlink()
        with pytest.raises(kt.OptionError, match=r"best checkpoint .*best\.ckpt"):
            train(composed(f"resume={tmp_path / 'first'}"), tmp_path / "second")

    def test_another_configuration_is_told(self, run, tmp_path):
        with pytest.warns(kt.KcsWarning, match=r"resume: data\.batch_size was 4, is 3"):
            train(composed(f"resume={run[1]}", "trainer.max_epochs=4", "data.batch_size=3"), tmp_path)

    @pytest.mark.parametrize("kind", ["absent", "empty", "text", "other"])
    def test_what_is_no_checkpoint_is_told(self, tmp_path, kind):
        path = tmp_path / "last.ckpt"
        if kind == "other":
            torch.save({"state_dict": {}}, path)
        elif kind != "absent":
            path.write_text("" if kind == "empty" else "nothing that torch reads")
        with pytest.raises(kt.OptionError, match=r"^resume="):
            train(composed(f"resume={path}"), tmp_path / "out")

    def test_a_network_of_another_size_is_told(self, run, tmp_path):
        with pytest.warns(kt.KcsWarning), pytest.raises(kt.OptionError, match="resume=.*does not fit"):
            train(composed(f"resume={run[1]}", "model.channels=4"), tmp_path)

    def test_another_network_is_told_in_a_line(self, run, tmp_path, capsys):
        """And what differs once, although the module has a copy of it."""
        words = ("experiment=smoke", "model=mlp", f"resume={run[1]}", f"hydra.run.dir={tmp_path}")
        code, _, err = called(capsys, *words, "trainer.max_epochs=4")
        assert code == 2
        told = [line for line in err.splitlines() if line.startswith(("warning: ", "error: "))]
        assert told == [
            "warning: resume: model._target_ was kcs_torch.nn.TemporalLifter, is kcs_torch.nn.MLPLifter",
            "warning: resume: model.channels was 8, is None",
            f"error: resume={run[1]}/checkpoints/last.ckpt: does not fit this configuration: it is of another network, "
            "solver or skeleton: set model, solver and skeleton as they were, or leave resume out",
        ]
        assert len(err.strip().splitlines()) <= 6


class Broken(torch.nn.Module):
    """A loss that is no number."""

    def forward(self, points):
        return points.mean((-1, -2)) * math.nan


class Root(torch.nn.Module):
    """A loss of 0, with no slope there."""

    def forward(self, points):
        return (points - points).square().sum((-1, -2)).sqrt()


class TestWrongConfigurations:
    """Each is told in a line, by what the user wrote."""

    @pytest.mark.parametrize(
        ("override", "told"),
        [
            ("optimise=val/mpje", "unknown metric for optimise 'val/mpje': did you mean 'val/mpjpe'"),
            ("optimise=test/mpjpe", "choices are val/|did you mean"),
            ("mode=least", "mode: expected min or max"),
            ("seed=-1", "seed: expected a whole number"),
            ("seed=one", "seed: expected a whole number"),
            ("threads=0", "threads: expected a whole number"),
            ("skeleton=dragon", "unknown skeleton 'dragon'"),
            ("data.window=0", "window: expected a whole number, at least 1"),
            ("trainer.max_epochs=0", "at least one epoch with validation"),
            ("+trainer.default_root_dir=elsewhere", "trainer: default_root_dir: expected none"),
            ("+solver.num_steps=8", "solver: there is none to set num_steps of: choose one first, as solver=sfam does"),
            (
                "+trainer.limit_train_batches=0",
                "at least one epoch with validation, got none: .*limit_train_batches is 0",
            ),
            ("+trainer.limit_val_batches=0", "at least one epoch with validation, got none: .*limit_val_batches is 0"),
            ("+trainer.check_val_every_n_epoch=9", "one epoch with validation, got none: .*n_epoch=9, .*max_epochs="),
            ("+trainer.max_steps=1", "at least one epoch with validation, got none: see the group trainer"),
        ],
    )
    def test_in_values(self, tmp_path, override, told):
        with pytest.raises(kt.KcsError, match=told):
            try:
                train(composed(override), tmp_path)
            except hydra.errors.InstantiationException as error:
                raise error.__cause__ from None

    def test_files_without_validation_are_told_before_anything_is_trained(self, tmp_path):
        points = kt.data.walking_person(20).points
        motion = kt.Motion.from_arrays(points, skeleton="h36m17", units="mm", up="-y", fps=30)
        kt.save(motion, tmp_path / "walk.npz")
        files = [f"data.{split}={names}" for split, names in {"train": "walk.npz", "val": "[]", "test": "[]"}.items()]
        with hydra.initialize_config_dir(version_base="1.3", config_dir=str(configs())):
            words = ["data=files", f"data.folder={tmp_path}", "skeleton=h36m17", "+data.window=9", *files]
            config = hydra.compose("train", overrides=words)
        with pytest.raises(kt.OptionError, match=r"got none: data\.val is empty"):
            train(config, tmp_path / "run")
        assert not list(tmp_path.glob("run/**/*.ckpt"))

    @pytest.mark.parametrize(
        ("kind", "told"),
        [
            ("Broken", r"the loss 'mine' \(Broken\) was NaN at step 0"),
            ("Root", "the losses were numbers at step 0, but their gradient was not"),
        ],
    )
    def test_a_loss_of_ones_own_that_is_no_number_is_named(self, tmp_path, kind, told):
        term = f"{{_target_: kcs_torch.training.LossTerm, loss: {{_target_: {__name__}.{kind}}}}}"
        with pytest.warns(kt.KcsWarning, match=f"diverged: {told}"):
            outcome = train(composed(f"+loss.mine={term}"), tmp_path)
        assert outcome.diverged

    @pytest.mark.parametrize("solver", ["none", "sfam"])
    def test_divergence_is_the_worst_value(self, tmp_path, solver):
        """A solver factorises matrices, and takes no NaN."""
        with pytest.warns(kt.KcsWarning, match=r"diverged: .*try a smaller module\.lr"):
            outcome = train(composed("+module.lr=1e30", f"solver={solver}"), tmp_path)
        assert outcome.diverged and outcome.value == float("inf") and outcome.lifter is None and not outcome.metrics

    def test_a_network_whose_weights_are_numbers_may_still_have_diverged(self, tmp_path):
        with pytest.warns(kt.KcsWarning, match="diverged"):
            outcome = train(composed("+module.lr=1e30", "+module.clip=1e30", "data.steps_per_epoch=1"), tmp_path)
        assert outcome.value == float("inf") and outcome.lifter is None

    def test_divergence_later_leaves_the_best_epoch(self, tmp_path, monkeypatch):
        step = LiftingModule.training_step

        def breaks(self, batch, batch_idx):
            step(self, batch, batch_idx)
            if int(self.step) == 5:
                next(self.network.parameters()).data.fill_(float("nan"))

        monkeypatch.setattr(LiftingModule, "training_step", breaks)
        with pytest.warns(kt.KcsWarning, match="diverged"):
            outcome = train(composed(), tmp_path)
        assert outcome.value == logged(tmp_path, "val/mpjpe")[0]
        assert load_lifter(outcome.lifter).network is not None
