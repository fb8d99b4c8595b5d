"""Training from the command line: mistakes in a line, sweeps by the launchers, and kcs-torch train."""

import importlib.util
import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("lightning", reason="training needs the extra: pip install -e '.[train]'")
pytest.importorskip("hydra")

from omegaconf import DictConfig, OmegaConf
from pools import end_pool
from training_runs import SMALL, called, logged, rows

from kcs_torch.training import LiftingModule, load_lifter
from kcs_torch.training.run import Outcome, configs
from kcs_torch.training.sweep import RESULT, tabulate


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
            ("+module.lr=abc", "error: module.lr: expected a number, got 'abc'"),
            ("trainer.max_epochs=hello", "error: trainer.max_epochs: expected a whole number or none, got 'hello'"),
            ("data.fresh_cameras=maybe", "error: data.fresh_cameras: expected true or false, got 'maybe'"),
            ("keep=no", "error: keep: expected true or false, got 'no'"),
            ("optimise=???", "error: optimise: expected a value, got none: add optimise="),
            ("+trainer.acelerator=cpu", "unknown field of trainer .*'acelerator': did you mean 'accelerator'"),
            ("trainer.accelerator=abacus", "abacus"),
            ("trainer.accelerator=tpu", "error: trainer: .*torch_xla"),
            ("data=cmu shared=/nowhere", "/nowhere/data/cmu, found none"),
            ("resume=/nowhere", "resume=/nowhere: expected a run's folder"),
            ("model._target_=kcs_torch.nn.Nothing", "kcs_torch.nn.Nothing"),
            (
                "model._target_=mine.Net",
                "network._target_=mine.Net: cannot be imported: No module .*'mine'.* PYTHONPATH",
            ),
            (
                "model._target_=kcs_torch.nn.MLPLiftr",
                "_target_=kcs_torch.nn.MLPLiftr: module 'kcs_torch.nn' has no 'MLPLiftr': did you mean MLPLifter",
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
            own = (p for p in tmp_path.rglob("*") if p.is_file() and ".hydra" not in p.parts and p.suffix != ".log")
            return {path: path.read_bytes() for path in own}

        before = files()
        assert any("tfevents" in path.name for path in before)
        for wrong in ("optimise=val/foo", "data=files data.folder=/absent", "+module.lr=-1", "+data.labelled=2"):
            assert called(capsys, *words, *wrong.split())[0] == 2
            assert files() == before

    @pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
    @pytest.mark.parametrize(
        ("sweep", "at", "told"),
        [
            ((), 5, ": resume={}"),
            (("-m",), 5, ": resume={}/0"),
            ((), 1, " before the first checkpoint: a new run begins anew"),
        ],
    )
    def test_a_signal_is_told_as_shells_tell_it(self, tmp_path, capsys, monkeypatch, number, code, sweep, at, told):
        step = LiftingModule.training_step

        def stopped(self, batch, batch_idx):
            step(self, batch, batch_idx)
            if int(self.step) == at:
                os.kill(os.getpid(), number)

        monkeypatch.setattr(LiftingModule, "training_step", stopped)
        folders = f"hydra.run.dir={tmp_path}", f"hydra.sweep.dir={tmp_path}"
        before = signal.signal(signal.SIGINT, signal.default_int_handler)  # which shells ignore in the background
        try:
            got, _, err = called(capsys, *sweep, *SMALL, *folders, "trainer.max_epochs=5", "seed=3")
        finally:
            signal.signal(signal.SIGINT, before)
        assert got == code and f"stopped{told.format(tmp_path)}" in err

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
        end_pool()
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
        """A sweep that was stopped goes on: runs without a result are made again."""
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

    def test_what_had_ended_is_kept_under_whatever_number(self, tmp_path, monkeypatch, capsys):
        """An option that is extended moves the numbers of the runs: none of those that ended is made again, or lost."""
        made = []

        def trained(config, folder):
            made.append(folder.name)
            return Outcome(config.seed + config.module.lr, {}, None)

        monkeypatch.setattr("kcs_torch.training.run.train", trained)
        monkeypatch.chdir(tmp_path)
        assert called(capsys, *SWEEP, "+module.lr=1,2", "seed=10,20")[0] == 0
        assert made == ["0", "1", "2", "3"]
        results = {path: path.read_bytes() for path in (tmp_path / "sweep").glob(f"*/{RESULT}")}
        code, out, err = called(capsys, *SWEEP, "+module.lr=1,2", "seed=10,20,30", "keep=true")
        assert code == 0 and out.count("had ended, and is kept") == 4, err
        assert made[4:] == ["2_1", "5"]
        assert len(results) == 4 and all(path.read_bytes() == result for path, result in results.items())
        table = [
            (r["run"], r["module.lr"], r["seed"], r["val/mpjpe"]) for r in rows(tmp_path / "sweep" / "results.csv")
        ]
        assert table == [
            *(("0", "1", "10", "11"), ("1", "1", "20", "21"), ("2", "2", "10", "12")),
            *(("2_1", "1", "30", "31"), ("3", "2", "20", "22"), ("5", "2", "30", "32")),
        ]
        code, out, err = called(capsys, *SWEEP, "+module.lr=2,1", "seed=30,10", "keep=true")
        assert code == 0 and out.count("had ended, and is kept") == 4 and len(made) == 6, err

    def test_figures_of_other_settings_are_not_kept(self, tmp_path, capsys):
        """A debugging run leaves the checkpoints of the run before, but the figures are its own."""
        words = [*SMALL, "trainer.max_epochs=1", f"hydra.run.dir={tmp_path}"]
        assert called(capsys, *words)[0] == 0
        before = json.loads((tmp_path / RESULT).read_text())
        assert called(capsys, *words, "+trainer.fast_dev_run=true")[0] == 0
        assert json.loads((tmp_path / RESULT).read_text()) != before
        assert (tmp_path / "lifter.safetensors").is_file() and len(list(tmp_path.rglob("*.ckpt"))) == 2
        code, out, err = called(capsys, *words, "keep=true")
        assert code == 2 and "a run of other settings had ended here" in err and "Traceback" not in err
        assert json.loads((tmp_path / RESULT).read_text()) != before
        assert called(capsys, *words)[0] == 0
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
