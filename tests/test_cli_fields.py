"""Fields of methods by ``--set``, and what is no value of them."""

import math
from dataclasses import dataclass
from typing import Literal

import pytest

import kcs_torch as kt
from kcs_torch.cli.fields import parse_settings


@dataclass(frozen=True)
class Fake:
    beta: float = 1.5
    rank: int | None = None
    smooth: bool = False
    start: Literal["flat", "template"] = "flat"
    links: tuple[tuple[str, str], ...] = ()
    sizes: tuple[float, ...] = ()
    label: str | None = None


@dataclass(frozen=True)
class Other:
    beta: int = 1
    gamma: float = 0.0


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("beta=2", 2.0),
        ("beta = 1e-3", 1e-3),
        ("beta=.inf", math.inf),
        ("rank=3", 3),
        ("rank=none", None),
        ("smooth=true", True),
        ("smooth=no", False),
        ("start=template", "template"),
        ("links=[[left_wrist, right_wrist]]", (("left_wrist", "right_wrist"),)),
        ("links=[]", ()),
        ("sizes=1,2.5,1e-3", (1.0, 2.5, 1e-3)),
        ("label=a=b", "a=b"),
        ("label=none", None),
    ],
)
def test_settings_follow_the_fields_types(text, value):
    (got,) = parse_settings([text], [Fake]).values()
    assert got == value and type(got) is type(value)


@pytest.mark.parametrize(
    "text",
    ["beta=x", "beta=", "rank=2.5", "smooth=perhaps", "start=other", "links=[[a, b, c]]", "links=[[a", "sizes=a"],
)
def test_settings_of_the_wrong_type(text):
    with pytest.raises(kt.OptionError, match=f"--set {text.partition('=')[0]}: expected "):
        parse_settings([text], [Fake])


def test_settings_of_several_methods():
    assert parse_settings(["beta=0.5", "gamma=1"], [Fake, Other]) == {"beta": 0.5, "gamma": 1.0}
    with pytest.raises(kt.OptionError, match="gamma"):
        parse_settings(["gama=1"], [Fake, Other])
