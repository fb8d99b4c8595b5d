"""scripts/label_efficiency.py: a row for whatever was swept, over shares of labels and seeds."""

import csv

import pytest

pytest.importorskip("hydra")


@pytest.fixture(scope="module")
def script(import_script):
    return import_script("label_efficiency")


def write(folder, rows):
    folder.mkdir()
    with (folder / "results.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(dict.fromkeys(name for row in rows for name in row)))
        writer.writeheader()
        writer.writerows(rows)
    return folder


def run(number, figure, **settings):
    return {"run": number, **settings, "val/pa_mpjpe": 1.0, "test/pa_mpjpe": figure}


def test_what_was_swept_has_rows_of_its_own(script, tmp_path):
    settings = [("mlp", 0.1, 0), ("mlp", 0.1, 1), ("temporal", 0.1, 0), ("mlp", 1, 0)]
    rows = [
        run(k, 10.0 * k + seed, experiment="smoke", model=model, seed=seed, **{"data.labelled": share})
        for k, (model, share, seed) in enumerate(settings)
    ]
    found = script.runs_of([write(tmp_path / "sweep", rows)], "pa_mpjpe")
    assert {name: dict(shares) for name, shares in found.items()} == {
        "smoke model=mlp": {"0.1": {0: 0.0, 1: 11.0}, "1": {0: 30.0}},
        "smoke model=temporal": {"0.1": {0: 20.0}},
    }


def test_the_same_run_twice_is_refused(script, tmp_path):
    rows = [run(k, 1.0, experiment="labels", seed=0) for k in range(2)]
    with pytest.raises(SystemExit, match="expected one run of labels with seed 0"):
        script.runs_of([write(tmp_path / "sweep", rows)], "pa_mpjpe")


def test_a_run_that_diverged_is_named(script, tmp_path):
    rows = [run(k, "" if k else 1.0, experiment="labels", seed=k) for k in range(2)]
    with pytest.raises(SystemExit, match=r"results\.csv: run 1 has no test/pa_mpjpe: it diverged"):
        script.runs_of([write(tmp_path / "sweep", rows)], "pa_mpjpe")
    with pytest.raises(SystemExit, match="metric=mpjpe: expected one of pa_mpjpe"):
        script.runs_of([tmp_path / "sweep"], "mpjpe")


def test_a_table_without_runs_is_told(script, tmp_path):
    (tmp_path / "results.csv").write_text("run,test/pa_mpjpe\n")
    with pytest.raises(SystemExit, match=r"expected runs in results\.csv, found none"):
        script.main([str(tmp_path)])


def test_help_tells_the_options(script, capsys):
    with pytest.raises(SystemExit):
        script.main(["--help"])
    told = capsys.readouterr().out
    assert all(f"{name}=" in told for name in script.OPTIONS)


def test_methods_lift_the_test_data_of_the_runs(script, tmp_path, monkeypatch, capsys):
    asked = []
    monkeypatch.setattr(script, "untrained", lambda name, seed, experiment, *rest: asked.append(experiment) or 5.0)
    sweep = write(tmp_path / "sweep", [run(0, 7.0, experiment="smoke", seed=3)])
    script.main([str(sweep)])
    script.main([str(sweep), "experiment=labels"])
    assert asked == ["smoke", "labels"] and "| smoke | 7.0 |" in capsys.readouterr().out


def test_methods_lift_test_data_with_the_settings_of_the_runs(script, tmp_path):
    """The flat guess errs by as much as the tracks, which have the noise that the networks were tested with."""
    runs = [run(k, 7.0, experiment="smoke", seed=3, keep=True, **{"data.noise": 5 + k // 2}) for k in range(4)]
    runs[1]["seed"] = runs[3]["seed"] = 4
    sweep = write(tmp_path / "sweep", runs)
    assert script.tested_on([sweep]) == [("data.noise=5",), ("data.noise=6",)]
    assert list(script.runs_of([sweep], "pa_mpjpe")) == ["smoke data.noise=5", "smoke data.noise=6"]
    clean, noisy = (
        script.untrained("flat", 3, "smoke", "nowhere", "", "mpjpe", settings) for settings in ((), ("data.noise=300",))
    )
    assert noisy > clean + 50
