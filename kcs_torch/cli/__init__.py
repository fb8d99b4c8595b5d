"""The command line ``kcs-torch``. Commands load torch only when they run, so that ``--help`` answers at once."""

from __future__ import annotations

from typing import Annotated

import typer

from kcs_torch.cli import angles, convert, demo, detect, doctor, inspect, lift, score, skeletons, train

__all__ = ["app", "main"]

app = typer.Typer(
    name="kcs-torch",
    help="Turn 2D joint tracks into 3D motion of articulated bodies, without training data.",
    epilog="Exit codes: 0 done; 2 an input or the call is wrong (one line says what); 1 anything else, such as "
    "training that diverged; 130 stopped by Ctrl-C, 143 by SIGTERM.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command()(demo.demo)
app.command()(lift.lift)
app.command()(detect.detect)
app.command()(inspect.info)
app.command()(doctor.doctor)
app.command()(inspect.view)
app.command()(convert.convert)
app.command()(angles.angles)
app.command()(score.score)
app.command(context_settings=train.CONTEXT)(train.train)
app.add_typer(skeletons.app, name="skeletons")


def _print_version(wanted: bool) -> None:
    if wanted:
        import kcs_torch

        typer.echo(f"kcs-torch {kcs_torch.__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and leave.")
    ] = False,
) -> None:
    pass


def main() -> None:
    """Run the command line; the console script ``kcs-torch`` calls this."""
    app()
