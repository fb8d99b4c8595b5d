"""``kcs-torch doctor``: what it tells, and what it finds wrong."""

import functools
import json
import tomllib
from importlib import metadata

import pytest
from command_line import run as run_any

import kcs_torch as kt
from kcs_torch.cli import doctor

NEEDS = [
    "numpy>=1.26",
    "torch>=2.4",
    'h5py>=3.8; extra == "hdf5"',
    'nothing-of-that-name>=2; extra == "onnx"',
    "mediapipe==0.10.21; python_version < '3.13' and extra == 'detect'",
    'kcs-torch[hdf5]; extra == "test"',
]


run = functools.partial(run_any, "doctor")


@pytest.fixture
def needs(monkeypatch):
    """What the project needs, as this test says: the installed project may be older than the tree."""
    monkeypatch.setattr(doctor.metadata, "requires", lambda name: NEEDS)


def test_all_is_well(needs):
    facts = json.loads(run("--json").stdout)
    assert facts["problems"] == []
    assert facts["kcs_torch"] == kt.__version__
    assert facts["packages"] == {name: metadata.version(name) for name in ("numpy", "torch")}
    test = facts["self_test"]
    assert test["error"] < 0.6 * test["error_flat"] and test["units"] == "mm" and test["seconds"] > 0
    assert facts["device"]["cores"] >= 1 and facts["device"]["threads"] >= 1
    text = run().stdout
    for words in (f"kcs_torch {kt.__version__}", "self-test: 30 frames", "device: ", "all is well"):
        assert words in text


def test_the_cores_packages_load(root, monkeypatch):
    """Under whatever name they are imported, such as yaml of pyyaml."""
    project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    monkeypatch.setattr(doctor.metadata, "requires", lambda name: project["dependencies"])
    assert json.loads(run("--json").stdout)["problems"] == []


def test_extras_say_what_for_and_how(needs):
    extras = {e["name"]: e for e in json.loads(run("--json").stdout)["extras"]}
    assert extras["onnx"]["install"] == 'pip install "nothing-of-that-name>=2"'
    assert not extras["onnx"]["installed"]
    assert extras["detect"]["install"] == 'pip install "mediapipe==0.10.21"'
    assert extras["hdf5"]["packages"].keys() == {"h5py"}
    assert extras["hdf5"]["installed"] is (extras["hdf5"]["packages"]["h5py"] is not None)
    text = run().stdout
    assert 'not installed: pip install "nothing-of-that-name>=2"' in text


def test_every_extra_has_a_purpose(root):
    project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert sorted(doctor.PURPOSES) == sorted(project["optional-dependencies"])


PROBLEMS = {
    "missing": (["nothing-of-that-name>=2"], 'nothing-of-that-name: is not installed: pip install "nothing-of'),
    "old": (["numpy>=99.1"], f"numpy: is {metadata.version('numpy')}, expected numpy>=99.1: pip install"),
    "not installed": ([], "kcs-torch is not installed, only found"),
}


@pytest.mark.parametrize("name", PROBLEMS)
def test_what_is_wrong_is_told_and_the_exit_code_is_1(monkeypatch, name):
    core, message = PROBLEMS[name]
    monkeypatch.setattr(doctor.metadata, "requires", lambda _: core)
    done = run(code=1)
    assert f"problem: {message}" in done.stdout and "all is well" not in done.stdout
    assert message in json.loads(run("--json", code=1).stdout)["problems"][0]


def test_a_package_that_does_not_load(needs, monkeypatch):
    usual = doctor.importlib.import_module

    def broken(name):
        if name == "numpy":
            raise SystemError("built for another\nnumpy")
        return usual(name)

    monkeypatch.setattr(doctor.importlib, "import_module", broken)
    (problem,) = json.loads(run("--json", code=1).stdout)["problems"]
    assert problem == 'numpy: does not load (built for another numpy): pip install "numpy>=1.26" --force-reinstall'


def test_a_self_test_that_fails(needs, monkeypatch):
    def broken(*args, **options):
        raise RuntimeError("no kernel")

    monkeypatch.setattr(kt, "reconstruct", broken)
    facts = json.loads(run("--json", code=1).stdout)
    assert facts["self_test"] is None and facts["problems"] == ["self-test fails: RuntimeError: no kernel"]


def test_a_self_test_that_is_wrong(needs, monkeypatch):
    usual = kt.reconstruct

    def flat(tracks, **options):
        from dataclasses import replace

        result = usual(tracks, **options)
        return replace(result, points=result.points * result.points.new_tensor([1.0, 1.0, 0.0]))

    monkeypatch.setattr(kt, "reconstruct", flat)
    (problem,) = json.loads(run("--json", code=1).stdout)["problems"]
    assert problem.startswith("self-test: error ") and "expected well below" in problem
