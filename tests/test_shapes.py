"""Batch dimensions of several tensors, as torch has them."""

import subprocess
import sys

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from kcs_torch.errors import ShapeError
from kcs_torch.functional.shapes import broadcast_shapes

SHAPES = st.lists(st.lists(st.integers(0, 3), max_size=3).map(tuple), max_size=4)


@given(SHAPES)
def test_it_is_that_of_torch(shapes):
    try:
        expected = tuple(torch.broadcast_tensors(*map(torch.empty, shapes))[0].shape) if shapes else ()
    except RuntimeError:
        with pytest.raises(ShapeError, match="batch dimensions: expected sizes that are equal or 1, got "):
            broadcast_shapes(*shapes)
    else:
        assert broadcast_shapes(*shapes) == expected


def test_methods_do_without_the_symbols_of_torch():
    """Its own function of this name loads them, in a third of a second."""
    code = (
        "import sys, kcs_torch as kt\n"
        "clip = kt.data.walking_person(12)\n"
        "for name in ('sfam', 'kcs', 'pkc'): kt.reconstruct(clip.tracks, method=name)\n"
        "print('sympy' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
