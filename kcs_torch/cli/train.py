"""``kcs-torch train``: hands its arguments to Hydra, as ``scripts/train.py`` does."""

from __future__ import annotations

import typer

from kcs_torch.cli.report import answer

__all__ = ["CONTEXT", "train"]

CONTEXT = {"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}
"""Settings of the command: every argument is Hydra's, ``--help`` too."""

NEEDS = ("hydra", "lightning", "safetensors", "tensorboard")


def train(context: typer.Context) -> None:
    """Train a lifting network; the arguments are Hydra's, --help lists them."""
    from importlib.util import find_spec

    with answer():
        missing = [name for name in NEEDS if find_spec(name) is None]
        if missing:
            from kcs_torch.errors import OptionError

            raise OptionError(f'train: {", ".join(missing)} is missing: pip install ".[train]" in a clone of kcs_torch')
    from kcs_torch.training.run import main

    main(context.args)
