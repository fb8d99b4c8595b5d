"""Every configuration composes and makes what it names. Files are found by themselves: a new one is tested, too."""

import dataclasses
import inspect
import itertools
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.utils import get_object, instantiate
from omegaconf import DictConfig, OmegaConf

import kcs_torch as kt
from kcs_torch.training.configured import _for_hydra, check_values, command_line

CONFIGS = Path(__file__).resolve().parents[1] / "configs"
PROGRAMS = sorted(path.stem for path in CONFIGS.glob("*.yaml"))
GROUPS = sorted(path.name for path in CONFIGS.iterdir() if path.is_dir() and any(path.glob("*.yaml")))
CHOICES = [f"{group}={path.stem}" for group in GROUPS for path in sorted((CONFIGS / group).glob("*.yaml"))]


def composed(program: str, *overrides: str, **options: Any) -> DictConfig:
    with initialize_config_dir(version_base="1.3", config_dir=str(CONFIGS)):
        return compose(program, overrides=list(overrides), **options)


def groups_of(program: str) -> set[str]:
    """The groups that a program chooses from."""
    return set(composed(program, return_hydra_config=True).hydra.runtime.choices) & set(GROUPS)


def made(config: DictConfig) -> Any:
    """All that a configuration names; what the user has to say is said, what this machine lacks is not asked for."""
    for key in OmegaConf.missing_keys(config):
        OmegaConf.update(config, key, "somewhere")
    if OmegaConf.select(config, "trainer.accelerator") == "gpu" and not torch.cuda.is_available():
        config.trainer.accelerator = "cpu"
    check_values(OmegaConf.to_container(config, resolve=True))
    return instantiate(config, _convert_="all")


def nodes(config: Any, key: str = ""):
    """Yield (place, node) of everything in a configuration that names a class."""
    if isinstance(config, dict):
        if "_target_" in config:
            yield key, config
        for name, value in config.items():
            yield from nodes(value, f"{key}.{name}".lstrip("."))


def test_programs_are_the_scripts():
    assert {"benchmark", "reconstruct_many", "train"} <= set(PROGRAMS)
    for program in PROGRAMS:
        assert (CONFIGS.parent / "scripts" / f"{program}.py").is_file()


@pytest.mark.parametrize("program", PROGRAMS)
def test_programs_have_settings_that_make_something(program):
    result = made(composed(program))
    assert result and not list(nodes(result))


@pytest.mark.parametrize("choice", CHOICES)
def test_every_file_of_every_group_makes_what_it_names(choice):
    group = choice.partition("=")[0]
    users = [program for program in PROGRAMS if group in groups_of(program)]
    assert users, f"no program chooses from configs/{group}"
    for program in users:
        config = composed(program, choice)
        named = {node["_target_"] for _, node in nodes(OmegaConf.to_container(config))}
        result = made(config)
        assert named and not list(nodes(result))
        if group in ("data", "model", "trainer", "method"):
            kind = get_object(config[group]._target_)
            assert type(result[group]) is kind


@pytest.mark.parametrize("choice", CHOICES)
def test_defaults_live_in_python_only(choice):
    for program in PROGRAMS:
        if choice.partition("=")[0] not in groups_of(program):
            continue
        for place, node in nodes(OmegaConf.to_container(composed(program, choice))):
            fields = inspect.signature(get_object(node["_target_"])).parameters
            for name, value in node.items():
                default = fields[name].default if name in fields else inspect.Parameter.empty
                said = isinstance(value, str) and value.startswith("${")
                assert said or type(value) is not type(default) or value != default, f"{place}.{name} is the default"


@pytest.mark.parametrize("choice", [choice for choice in CHOICES if choice.startswith("experiment=")])
def test_every_run_of_a_sweep_makes_what_it_names(choice):
    params = composed("train", choice, return_hydra_config=True).hydra.sweeper.params or {}
    for values in itertools.zip_longest(*(str(value).split(",") for value in params.values())):
        pairs = [f"{key}={value}" for key, value in zip(params, values, strict=True) if value is not None]
        assert made(composed("train", choice, *pairs))


@pytest.mark.parametrize("solver", ["none", "sfam"])
def test_the_module_is_made_of_the_chosen_parts(solver):
    config = composed("train", "model=mlp", "loss=hybrid", f"solver={solver}", "seed=3", "skeleton=h36m17")
    module = made(config)["module"]
    network = module.network if solver == "none" else module.network.network
    assert isinstance(network, kt.nn.MLPLifter) and network.skeleton == kt.SKELETONS["h36m17"]
    assert (solver == "sfam") == isinstance(module.network, kt.nn.RefinedLifter)
    assert set(module.losses) == set(config.loss) and len(config.loss) > 1
    assert module.seed == 3


def test_the_motion_capture_of_cmu_has_nobody_in_two_sets(shared):
    from kcs_torch.training.clips import find_files

    data = composed("train", "data=cmu", f"shared={shared}").data
    people = {
        split: {path.name.split("_")[1] for path in find_files(list(data[split]), data.folder)}
        for split in ("train", "val", "test")
    }
    assert all(len(names) >= 3 for names in people.values())
    for one, other in itertools.combinations(people.values(), 2):
        assert not one & other


def test_there_is_a_config_for_every_method():
    assert [choice for choice in CHOICES if choice.startswith("method=")] == [f"method={m}" for m in sorted(kt.METHODS)]


@pytest.mark.parametrize("name", sorted(kt.METHODS))
def test_method_configs_make_the_method_with_its_own_defaults(name):
    config = composed("benchmark", f"method={name}")
    assert set(config.method) == {"_target_"}
    assert instantiate(config.method) == kt.METHODS[name]()


@pytest.mark.parametrize("name", sorted(kt.METHODS))
def test_fields_can_be_set_on_the_command_line(name):
    kind = kt.METHODS[name]
    field = next(f for f in dataclasses.fields(kind) if type(f.default) in (int, float))
    value = field.default + 1 if type(field.default) is int else 0.125
    method = instantiate(composed("benchmark", f"method={name}", f"+method.{field.name}={value}").method)
    assert method == kind(**{field.name: value})


@pytest.mark.parametrize("program", ["benchmark", "reconstruct_many"])
def test_help_names_the_methods_and_no_groups_that_are_not_used(program):
    text = composed(program, return_hydra_config=True).hydra.help.template
    assert f"a method: {', '.join(sorted(kt.METHODS))}\n" in text and "$APP_CONFIG_GROUPS" not in text


@pytest.mark.parametrize(
    ("word", "value"),
    [
        ("scale=height=1.75m", "height=1.75m"),
        ("scale=left_knee-left_ankle=430mm", "left_knee-left_ankle=430mm"),
        ("scale='height=1.75m'", "height=1.75m"),
        ("reading.joints=a=b", "a=b"),
        ("suffixes=[.npz,'a=b']", [".npz", "a=b"]),
        ("batch=16", 16),
        ("data={fps: 30}", {"fps": 30}),
    ],
)
def test_a_value_that_holds_an_equals_sign_needs_no_quotes(word, value):
    assert OverridesParser.create().parse_override(_for_hydra(word)).value() == value


@pytest.mark.parametrize(
    "name", ["Läufe", "日本", "a&b", "a#b", "a;b", "x^y", "it's", "clip (1)", "take(2)", "s[12]_*", "ä\\"]
)
def test_names_of_files_need_no_quotes(name):
    parse = OverridesParser.create().parse_override
    assert parse(_for_hydra(f"input={name}")).value() == name
    assert parse(_for_hydra(f"input=videos/{name}")).value() == f"videos/{name}"


def test_parts_of_lists_and_sweeps_need_no_quotes():
    parse = OverridesParser.create().parse_override
    assert parse(_for_hydra("data.train=[ä/*.npz,!b*,c,7]")).value() == ["ä/*.npz", "!b*", "c", 7]
    assert parse(_for_hydra("data.train=[a*, !ä*,b]")).value() == ["a*", "!ä*", "b"]  # as if nothing had to be quoted
    assert [*parse(_for_hydra("input=ä,b,7")).sweep_string_iterator()] == ["'ä'", "b", "7"]


def test_a_folder_of_the_user_is_meant_by_a_tilde(monkeypatch):
    monkeypatch.setenv("HOME", "/home/me")
    with command_line("train", ["data.folder=~/motion", "hydra.run.dir=~", "data.train=a~b", "data.val=~b"]):
        assert sys.argv[1:] == [
            "++data.folder=/home/me/motion", "hydra.run.dir=/home/me", "++data.train='a~b'", "++data.val='~b'",
        ]  # fmt: skip
    parse = OverridesParser.create().parse_override
    assert parse(_for_hydra("data.train=[~/a, !~/b,~c]")).value() == ["/home/me/a", "!/home/me/b", "~c"]


def test_a_sweep_over_values_that_hold_an_equals_sign():
    parsed = OverridesParser.create().parse_override(_for_hydra("scale=height=1.75m,height=1.8m"))
    assert [*parsed.sweep_string_iterator()] == ["'height=1.75m'", "'height=1.8m'"]


def test_what_hydra_reads_itself_is_left_to_it():
    for word in (
        *("shard=range(start=0,stop=8)", "seed=1,2", "--config-dir=a=b", "output=${now:%Y=%m}"),
        *("input='ä'", "shard=rnage(0,8)", "input=choice(ä)", "data={ä: 1}", "input=[[ä],b]"),
    ):
        assert _for_hydra(word) == word


@pytest.mark.parametrize("program", ["benchmark", "train"])
def test_settings_are_those_that_the_program_reads(program):
    path = "scripts/benchmark.py" if program == "benchmark" else "kcs_torch/training/run.py"
    text = (CONFIGS.parent / path).read_text(encoding="utf-8")
    used = {"model", "loss", "solver", "shared", "skeleton"} if program == "train" else set()  # by other settings
    for key in set(composed(program)) - used:
        assert f"config.{key}" in text, key
