"""Values and the annotations of what takes them."""

from collections.abc import Sequence
from typing import Literal

import numpy as np
import pytest

from kcs_torch.types.hints import is_a, spoken


@pytest.mark.parametrize(
    ("value", "hint", "fits"),
    [
        (1, int, True),
        (1.5, int, False),
        (True, int, False),
        (True, int | bool, True),
        ("1", float, False),
        (1, float, True),
        (10**400, float, False),
        (10**400, int, False),
        (np.float32(1), float, True),
        (float("nan"), float, False),
        (None, int | None, True),
        (32, Literal[64, 32, 16], True),
        ("32", Literal[64, 32, 16], False),
        ("auto", int | Literal["auto"], True),
        ("atuo", int | Literal["auto"], False),
        ([1, 2.5], Sequence[float], True),
        (["a"], Sequence[float], False),
    ],
)
def test_what_fits(value, hint, fits):
    assert is_a(value, hint) is fits


def test_words():
    assert spoken(float | None) == "a number or none"
    assert spoken(bool | Literal["warn"]) == "true or false or warn"
    assert spoken(Sequence[float]).startswith("a list")
    assert spoken(np.ndarray) == "ndarray"
