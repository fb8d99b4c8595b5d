"""scripts/layers.py: the layers that are compared are the same one, and the tables are printed."""

import sys

import torch
from numerics import normal
from torch.testing import assert_close

import kcs_torch as kt


def test_layers_agree_and_tables_are_printed(import_script, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["layers.py", "--repeats", "1", "--imports", "0"])
    script, threads = import_script("layers"), torch.get_num_threads()
    try:
        script.main()
    finally:
        torch.set_num_threads(threads)
    text = capsys.readouterr().out
    rows = [line for line in text.splitlines() if line.startswith("| ") and "---" not in line]
    assert len(rows) == 1 + 3 + 1 + 18
    energies = {name for name in kt.nn.__all__ if name.endswith(("Energy", "Distance", "Critic"))}
    assert energies - {name for name in energies if f"`{name}(" in text} == {"ContactEnergy", "ProportionEnergy"}
    body, points = kt.SKELETONS["hand21"], normal(3, 21, 3, dtype=torch.float32)
    expected = kt.nn.KCSMatrix(body)(points)
    for make in (script.tiled, script.indexed):
        assert_close(make(body)(points), expected)
