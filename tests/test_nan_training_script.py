"""scripts/nan_training.py: with degenerate clips nothing is NaN, and with a plain SVD it is at once."""

import runpy
from pathlib import Path

import torch

SCRIPT = runpy.run_path(str(Path(__file__).resolve().parents[1] / "scripts" / "nan_training.py"))


def test_two_hundred_steps_without_a_nan():
    counts = SCRIPT["train"](200)
    assert (counts.steps, counts.losses, counts.gradients, counts.parameters) == (200, 0, 0, 0)
    assert counts.first is None


def test_plain_singular_vectors_do_not_last():
    with SCRIPT["plain"]():
        counts = SCRIPT["train"](50, stop=True)
    assert counts.first == counts.steps < 50 and counts.gradients == 1
    assert set(counts.kinds) & set(SCRIPT["KINDS"][1:])  # it takes a degenerate clip
    assert SCRIPT["train"](3).gradients == 0  # the library is as it was


def test_every_kind_of_clip_comes():
    batches = SCRIPT["windows"](SCRIPT["kt"].SKELETONS["h36m17"], torch.Generator().manual_seed(0))
    kinds = {kind for _, (_, found) in zip(range(20), batches, strict=False) for kind in found}
    assert kinds == set(SCRIPT["KINDS"])
