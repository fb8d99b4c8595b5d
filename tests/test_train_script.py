"""Training as it is configured: what a run leaves, that it can be repeated and resumed; sweeps by the launchers."""

import csv
import importlib.util
import json
import math
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import kcs_torch as kt

lightning = pytest.importorskip("lightning", reason="training needs the extra: pip install -e '.[train]'")
hydra = pytest.importorskip("hydra")

from omegaconf import DictConfig, OmegaConf  # noqa: E402

from kcs_torch.training import LiftingModule, load_lifter  # noqa: E402
from kcs_torch.training.run import configs, main, train  # noqa: E402
from kcs_torch.training.sweep import RESULT, tabulate  # noqa: E402

SMALL = ("experiment=smoke", "+model.channels=8")


def composed(*overrides: str):
    with hydra.initialize_config_dir(version_base="1.3", config_dir=str(configs())):
        return hydra.compose("train", overrides=[*SMALL, *overrides])


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def logged(folder: Path, name: str) -> list[float]:
    return [float(row[name]) for row in rows(folder / "csv" / "metrics.csv") if row.get(name)]


def weights(path: Path) -> dict[str, torch.Tensor]:
    return torch.load(path / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]


def same(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> bool:
    return one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)


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


class Broken(torch.nn.Module):
    """A loss that is no number."""

    def forward(self, points):
        return points.mean((-1, -2)) * math.nan


class Root(torch.nn.Module):
    """A loss of 0, with no slope there."""

    def forward(self, points):
        return (points - points).square().sum((-1, -2)).sqrt()


def called(capsys, *arguments: str) -> tuple[int, str, str]:
    """Exit code, output and errors of a command line, in this process."""
    code = 0
    try:
        main(arguments)
    except SystemExit as end:
        code = end.code
    out, err = capsys.readouterr()
    return code, out, err


class TestCommandLine:
    def test_one_run(self, tmp_path, capsys):
        code, out, err = called(capsys, *SMALL, "trainer.max_epochs=1", f"hydra.run.dir={tmp_path}")
        assert code == 0 and "val/mpjpe" in out and "test/mpjpe" in out, err
        assert out.splitlines()[-1] == str(tmp_path / "lifter.safetensors")
        assert "Traceback" not in err and "Warning" not in err
        assert json.loads((tmp_path / "result.json").read_text())["val/mpjpe"] == logged(tmp_path, "val/mpjpe")[0]

    def test_a_fast_run_for_debugging_is_not_tested(self, tmp_path, capsys):
        code, out, err = called(capsys, *SMALL, "+trainer.fast_dev_run=true", f"hydra.run.dir={tmp_path}")
        assert code == 0 and "val/mpjpe" in out and "test/" not in out, err
        assert json.loads((tmp_path / "result.json").read_text())["val/mpjpe"] > 0
        assert not (tmp_path / "lifter.safetensors").exists()

    @pytest.mark.parametrize(
        ("argument", "told"),
        [
            ("model=transformer", "mlp\n\ttemporal"),
            ("--experiment=smoke", "--experiment=smoke: settings have no dashes: experiment=smoke"),
            ("modle=mlp", "unknown setting 'modle': did you mean .*choices: .*experiment, .*model, "),
            ("+modul.lr=1", "unknown setting 'modul': did you mean 'module' or 'model'"),
            ("hydr/launcher=joblib", "unknown setting 'hydr': did you mean 'hydra'"),
            (
                "model.chanels=3",
                r"unknown field of model \(.*TemporalLifter\) 'chanels': did you mean 'channels'",
            ),
            (
                "data.windo=3",
                r"unknown field of data \(.*TracksDataModule\) 'windo': did you mean 'window'.*choices: batch",
            ),
            ("+loss.joints.clip=labelled", r"unknown field of loss.joints \(.*LossTerm\) 'clip': did you mean 'clips'"),
            ("loss.joint.weight=2", "unknown loss 'joint': did you mean 'joints'"),
            ("+trainer.gradient_clip_val=1", r"gradient_clip_val: .*\+module\.clip"),
            ("+trainer.accumulate_grad_batches=2", r"accumulate_grad_batches: .*data\.batch_size"),
            ("+data.noisy=1", "unknown field of data .*'noisy': did you mean 'noise'"),
            ("+module.lr=-1", "lr: expected a positive number"),
            ("+module.lr=abc", "error: module.lr: expected a finite number, got 'abc'"),
            ("trainer.max_epochs=hello", "error: trainer.max_epochs: expected a whole number or none, got 'hello'"),
            ("data.fresh_cameras=maybe", "error: data.fresh_cameras: expected true or false, got 'maybe'"),
            ("keep=no", "error: keep: expected true or false, got 'no'"),
            ("optimise=???", "error: optimise: expected a value, got none: add optimise="),
            ("+trainer.acelerator=cpu", "unknown field of trainer .*'acelerator': did you mean 'accelerator'"),
            ("trainer.accelerator=abacus", "abacus"),
            ("data=cmu shared=/nowhere", "/nowhere/data/cmu, found none"),
            ("resume=/nowhere", "resume=/nowhere: expected a run's folder"),
            ("model._target_=kcs_torch.nn.Nothing", "kcs_torch.nn.Nothing"),
            (
                "model._target_=mine.Net",
                "network._target_=mine.Net: cannot be imported: No module .*'mine'.* PYTHONPATH",
            ),
            ("skeleton=dragon loss=bones", "unknown skeleton 'dragon'"),
        ],
    )
    def test_wrong_arguments(self, tmp_path, capsys, argument, told):
        code, _, err = called(capsys, *SMALL, *argument.split(), f"hydra.run.dir={tmp_path}")
        assert code == 2 and re.search(told, err), err
        assert "Traceback" not in err

    def test_a_wrong_setting_touches_nothing_of_an_earlier_run(self, tmp_path, capsys):
        words = [*SMALL, "trainer.max_epochs=1", f"hydra.run.dir={tmp_path}"]
        assert called(capsys, *words)[0] == 0

        def files():
            own = (
                p for p in tmp_path.rglob("*") if p.is_file() and p.suffix in (".csv", ".json", ".ckpt", ".safetensors")
            )
            return {path: path.read_bytes() for path in own}

        before = files()
        for wrong in ("optimise=val/foo", "+module.lr=-1", "+data.labelled=2"):
            assert called(capsys, *words, wrong)[0] == 2
            assert files() == before

    @pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
    @pytest.mark.parametrize("sweep", [(), ("-m",)])
    def test_a_signal_is_told_as_shells_tell_it(self, tmp_path, capsys, monkeypatch, number, code, sweep):
        step = LiftingModule.training_step

        def stopped(self, batch, batch_idx):
            step(self, batch, batch_idx)
            if int(self.step) == 5:
                os.kill(os.getpid(), number)

        monkeypatch.setattr(LiftingModule, "training_step", stopped)
        folders = f"hydra.run.dir={tmp_path}", f"hydra.sweep.dir={tmp_path}"
        before = signal.signal(signal.SIGINT, signal.default_int_handler)  # which shells ignore in the background
        try:
            got, _, err = called(capsys, *sweep, *SMALL, *folders, "trainer.max_epochs=5", "seed=3")
        finally:
            signal.signal(signal.SIGINT, before)
        assert got == code and f"stopped: resume={tmp_path / '0' if sweep else tmp_path} goes on" in err

    def test_settings_of_ones_own_may_be_added(self, capsys):
        code, out, err = called(capsys, "--cfg=job", "--resolve", SMALL[0], "+wide=9", "+model.channels=${wide}")
        assert code == 0 and "channels: 9" in out, err

    def test_errors_of_the_program_keep_their_traceback(self, tmp_path, capsys, monkeypatch):
        monkeypatch.setattr("kcs_torch.training.run.save_lifter", lambda *a, **k: 1 / 0)
        code, _, err = called(capsys, *SMALL, "trainer.max_epochs=1", f"hydra.run.dir={tmp_path}")
        assert code == 1 and "ZeroDivisionError" in err and "Traceback" in err

    def test_arguments_of_the_process_are_left_alone(self, capsys):
        before = list(sys.argv)
        assert called(capsys, "--help")[0] == 0
        assert sys.argv == before


SWEEP = ("-m", *SMALL, "trainer.max_epochs=1", "data.steps_per_epoch=2", "hydra.sweep.dir=sweep")


def swept(folder: Path) -> list[dict[str, str]]:
    """The table of a sweep, after a look at the folders of its runs."""
    table = rows(folder / "sweep" / "results.csv")
    assert [row["run"] for row in table] == [str(k) for k in range(len(table))]
    for row in table:
        run = folder / "sweep" / row["run"]
        assert float(row["val/mpjpe"]) == min(logged(run, "val/mpjpe"))
        assert load_lifter(run / "lifter.safetensors").network is not None
    return table


class TestSweeps:
    def test_basic(self, tmp_path, monkeypatch, capsys):
        monkeypatch.chdir(tmp_path)
        code, out, err = called(capsys, *SWEEP, "+module.lr=1e-3,1e-4", "seed=0,1")
        assert code == 0, err
        given = [(row["module.lr"], row["seed"]) for row in swept(tmp_path)]
        assert given == [("0.001", "0"), ("0.001", "1"), ("0.0001", "0"), ("0.0001", "1")]
        printed = out.splitlines()[-6:]
        assert printed[0].split()[:3] == ["run", "module.lr", "seed"] and printed[-1] == "sweep/results.csv"
        assert [line.split()[0] for line in printed[1:5]] == ["0", "1", "2", "3"]

    @pytest.mark.filterwarnings("ignore")  # of what the launchers are made of
    @pytest.mark.parametrize(
        ("launcher", "package"), [("joblib", "hydra_joblib_launcher"), ("submitit_local", "hydra_submitit_launcher")]
    )
    def test_processes_come_to_the_same_figures(self, tmp_path, monkeypatch, capsys, launcher, package):
        pytest.importorskip(f"hydra_plugins.{package}")
        for name, options in (("here", ()), ("there", (f"hydra/launcher={launcher}",))):
            (tmp_path / name).mkdir()
            monkeypatch.chdir(tmp_path / name)
            code, _, err = called(capsys, *SWEEP, "seed=0,1", *options)
            assert code == 0, err
        assert len(swept(tmp_path / "here")) == 2
        assert swept(tmp_path / "here") == swept(tmp_path / "there")

    @pytest.mark.filterwarnings("ignore")  # of what Optuna is made of
    def test_optuna(self, tmp_path, monkeypatch, capsys):
        pytest.importorskip("hydra_plugins.hydra_optuna_sweeper")
        monkeypatch.chdir(tmp_path)
        search = ("optuna", "n_trials=4", "n_jobs=1", "sampler.seed=0")
        options = [f"hydra{'.' if '=' in word else '/'}sweeper{'.' if '=' in word else '='}{word}" for word in search]
        code, _, err = called(capsys, *SWEEP, *options, "module.lr=tag(log,interval(1e-4,1e-2))")
        assert code == 0, err
        tried = {float(row["module.lr"]): float(row["val/mpjpe"]) for row in swept(tmp_path)}
        assert len(tried) == 4 and all(1e-4 <= lr <= 1e-2 for lr in tried)
        best = OmegaConf.load(tmp_path / "sweep" / "optimization_results.yaml")
        assert best.best_value == min(tried.values())
        assert tried[best.best_params["++module.lr"]] == best.best_value

    def test_a_run_that_fails_does_not_take_the_others_along(self, tmp_path, monkeypatch, capsys):
        monkeypatch.chdir(tmp_path)
        code, _, err = called(capsys, *SWEEP, "+module.lr=1e-3,-1,1e-4")
        assert code == 2 and "lr: expected a positive number" in err and "Traceback" not in err
        assert [row["run"] for row in rows(tmp_path / "sweep" / "results.csv")] == ["0", "2"]

    def test_what_had_ended_is_kept(self, tmp_path, monkeypatch, capsys):
        """A sweep that was stopped goes on: runs without a result are made again, and runs of other settings."""
        monkeypatch.chdir(tmp_path)
        assert called(capsys, *SWEEP, "seed=0,1", "+module.lr=1e-3")[0] == 0
        before = swept(tmp_path)
        (tmp_path / "sweep" / "1" / RESULT).unlink()
        times = {k: (tmp_path / "sweep" / k / "lifter.safetensors").stat().st_mtime_ns for k in "01"}
        code, out, err = called(capsys, *SWEEP, "seed=0,1", "+module.lr=1e-3", "keep=true")
        assert code == 0 and out.count("had ended, and is kept") == 1, err
        changed = [(tmp_path / "sweep" / k / "lifter.safetensors").stat().st_mtime_ns != times[k] for k in "01"]
        assert changed == [False, True]
        assert [row["val/mpjpe"] for row in swept(tmp_path)] == [row["val/mpjpe"] for row in before]
        code, out, err = called(capsys, *SWEEP, "seed=0,1", "+module.lr=1e-4", "keep=true")
        assert code == 0 and "is kept" not in out
        assert err.count("had ended with other settings, and is replaced") == 2

    def test_figures_of_other_settings_are_not_kept(self, tmp_path, capsys):
        """A debugging run leaves the checkpoints of the run before, but the figures are its own."""
        words = [*SMALL, "trainer.max_epochs=1", f"hydra.run.dir={tmp_path}"]
        assert called(capsys, *words)[0] == 0
        before = json.loads((tmp_path / RESULT).read_text())
        assert called(capsys, *words, "+trainer.fast_dev_run=true")[0] == 0
        assert json.loads((tmp_path / RESULT).read_text()) != before
        assert (tmp_path / "lifter.safetensors").is_file() and len(list(tmp_path.rglob("*.ckpt"))) == 2
        code, out, err = called(capsys, *words, "keep=true")
        assert code == 0 and "is kept" not in out and "is replaced" in err
        assert json.loads((tmp_path / RESULT).read_text()) == before
        code, out, err = called(capsys, *words, "keep=true")
        assert code == 0 and "had ended, and is kept" in out, err

    def test_a_run_that_diverges_leaves_no_network(self, tmp_path, capsys):
        words = [*SMALL, "trainer.max_epochs=1", f"hydra.run.dir={tmp_path}"]
        assert called(capsys, *words)[0] == 0 and (tmp_path / "lifter.safetensors").is_file()
        code, out, err = called(capsys, *words, "+module.lr=1e30")
        assert code == 1 and "inf" in out and "diverged" in err
        assert not list(tmp_path.rglob("*.ckpt")) and not (tmp_path / "lifter.safetensors").exists()
        code, out, err = called(capsys, *words, "+module.lr=1e30", "keep=true")
        assert code == 1 and "had ended, and is kept" in out, err

    def test_a_folder_that_cannot_be_made(self, tmp_path, capsys):
        (tmp_path / "file").write_text("")
        for name in ("hydra.run.dir", "hydra.sweep.dir"):
            code, out, err = called(capsys, *SMALL, f"{name}={tmp_path}/file/run")
            assert code == 2 and not out and err.startswith(f"error: {name}={tmp_path}/file/run: cannot be written to")
            assert len(err.splitlines()) == 1

    def test_figures_of_an_earlier_sweep_are_not_those_of_a_run_that_fails(self, tmp_path, monkeypatch, capsys):
        monkeypatch.chdir(tmp_path)
        assert called(capsys, *SWEEP, "+module.lr=1e-3,1e-4")[0] == 0
        assert called(capsys, *SWEEP, "+module.lr=-1,2e-4")[0] == 2
        assert [row["module.lr"] for row in rows(tmp_path / "sweep" / "results.csv")] == ["0.0002"]

    def test_the_table_is_that_of_all_who_have_ended(self, tmp_path):
        for number in (10, 2):
            run = tmp_path / str(number)
            (run / ".hydra").mkdir(parents=True)
            (run / ".hydra" / "overrides.yaml").write_text(f"- +module.lr={number}\n- model=mlp\n")
            (run / "result.json").write_text(json.dumps({"val/mpjpe": 7.5 if number == 2 else None}))
        tabulate(tmp_path)
        assert rows(tmp_path / "results.csv") == [
            {"run": "2", "module.lr": "2", "model": "mlp", "val/mpjpe": "7.5"},
            {"run": "10", "module.lr": "10", "model": "mlp", "val/mpjpe": ""},
        ]


def started(*arguments: str, folder: Path) -> subprocess.CompletedProcess:
    """``kcs-torch`` as a user's shell would start it, in a folder of theirs."""
    program = Path(sys.executable).with_name("kcs-torch")
    return subprocess.run([program, *arguments], cwd=folder, capture_output=True, text=True, timeout=300)


class TestKcsTorchTrain:
    def test_help_lists_groups_and_settings(self, tmp_path):
        done = started("train", "--help", folder=tmp_path)
        assert done.returncode == 0, done.stderr
        for word in ("data: cmu, files, synthetic", "model: mlp, temporal", "optimise: val/mpjpe", "data=cmu"):
            assert word in done.stdout
        assert "reconstruct_many" not in done.stdout
        groups = [entry for entry in OmegaConf.load(configs() / "train.yaml").defaults if isinstance(entry, DictConfig)]
        for group in (str(next(iter(entry))) for entry in groups):
            assert (
                f"\n{group}: {', '.join(sorted(p.stem for p in (configs() / group).glob('*.yaml')))}\n" in done.stdout
            )
        assert "method:" not in done.stdout

    def test_fields_that_are_not_shown_need_no_plus(self, capsys):
        code, out, err = called(capsys, "--cfg=job", SMALL[0], "module.lr=0.25", "+model.channels=8", "model.dropout=0")
        assert code == 0 and all(word in out for word in ("lr: 0.25", "channels: 8", "dropout: 0")), err

    def test_trains(self, tmp_path):
        words = (*SMALL, "trainer.max_epochs=1", "hydra.run.dir=out")
        done = started("train", *words, folder=tmp_path)
        assert done.returncode == 0, done.stderr
        assert done.stderr == ""
        assert load_lifter(tmp_path / "out" / "lifter.safetensors").fps == 30

    def test_several_devices(self, tmp_path):
        """Lightning starts the process of each further one by this process's own arguments."""
        words = (*SMALL, "trainer.max_epochs=1", "trainer.devices=2", "hydra.run.dir=out")
        done = started("train", *words, folder=tmp_path)
        assert done.returncode == 0, done.stderr
        assert load_lifter(tmp_path / "out" / "lifter.safetensors").fps == 30

    @pytest.mark.parametrize("missing", ["hydra", "lightning", "tensorboard", "safetensors"])
    def test_names_the_extra_that_is_missing(self, monkeypatch, missing):
        from typer.testing import CliRunner

        from kcs_torch.cli import app

        find = importlib.util.find_spec
        monkeypatch.setattr(
            importlib.util, "find_spec", lambda name, *rest: None if name == missing else find(name, *rest)
        )
        done = CliRunner().invoke(app, ["train", "trainer.max_epochs=1"])
        assert done.exit_code == 2
        assert done.stderr == f'error: train: {missing} is missing: pip install ".[train]" in a clone of kcs_torch\n'
