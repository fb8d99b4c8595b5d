"""docs/examples: short, shown in the docs, and what they promise happens; each asserts it itself."""

import re
import runpy
from pathlib import Path

import pytest
import torch

DOCS = Path(__file__).resolve().parents[1] / "docs"
EXAMPLES = sorted((DOCS / "examples").glob("*.py"))


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_example_is_short_shown_and_true(path, capsys):
    text = path.read_text(encoding="utf-8")
    assert len(text.splitlines()) < 60
    assert f"```{{literalinclude}} examples/{path.name}" in (DOCS / "learning.md").read_text(encoding="utf-8")
    assert re.search(r"^assert .*(after|result)", text, re.M)  # that something became better
    with torch.random.fork_rng():
        runpy.run_path(str(path), run_name="__main__")
    assert re.search(r"\d", capsys.readouterr().out)


def test_examples_are_there():
    assert {path.stem for path in EXAMPLES} == {
        "fit_clip",
        "kcs_loss",
        "lift_without_labels",
        "refine_network",
        "train_unrolled",
    }
