"""Every configuration composes and makes what it names."""

import dataclasses

import pytest
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from omegaconf import OmegaConf

import kcs_torch as kt


@pytest.fixture
def composed(root):
    with initialize_config_dir(version_base="1.3", config_dir=str(root / "configs")):
        yield lambda *overrides: compose("benchmark", overrides=list(overrides))


def names(root):
    return sorted(p.stem for p in (root / "configs" / "method").glob("*.yaml"))


def test_there_is_a_config_for_every_method(root):
    assert names(root) == sorted(kt.METHODS)


@pytest.mark.parametrize("name", kt.METHODS)
def test_method_configs_make_the_method_with_its_own_defaults(composed, name):
    config = composed(f"method={name}")
    assert set(config.method) == {"_target_"}  # defaults live in Python only
    method = instantiate(config.method)
    assert type(method) is kt.METHODS[name]
    assert method == kt.METHODS[name]()


@pytest.mark.parametrize("name", kt.METHODS)
def test_fields_can_be_set_on_the_command_line(composed, name):
    kind = kt.METHODS[name]
    field = next(f for f in dataclasses.fields(kind) if type(f.default) in (int, float))
    value = field.default + 1 if type(field.default) is int else 0.125
    method = instantiate(composed(f"method={name}", f"+method.{field.name}={value}").method)
    assert method == kind(**{field.name: value})


def test_every_yaml_file_is_reached(root):
    scripts = {root / "configs" / f"{name}.yaml" for name in ("benchmark", "reconstruct_many")}
    reached = scripts | {root / "configs" / "method" / f"{name}.yaml" for name in names(root)}
    assert set((root / "configs").rglob("*.yaml")) == reached


def test_benchmark_settings_are_those_that_the_script_reads(composed, root):
    text = (root / "scripts" / "benchmark.py").read_text(encoding="utf-8")
    for key in OmegaConf.to_container(composed()):
        assert f"config.{key}" in text
