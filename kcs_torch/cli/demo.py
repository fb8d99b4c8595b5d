"""``kcs-torch demo``: the main job on an embedded example, without data and without a network."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from kcs_torch.cli.lift import MethodName
from kcs_torch.cli.options import AsJson, check_outputs, use_one_thread
from kcs_torch.cli.report import answer, describe, print_json, progress, summary

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["demo", "rigid_error"]


def demo(
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FOLDER", help="Where to write walk.npz, walk.html and walk.png.")
    ] = Path("kcs_demo"),
    method: MethodName = "auto",
    as_json: AsJson = False,
) -> None:
    """Reconstruct a synthetic walking person, seen with noise and gaps, and compare with the truth."""
    with answer(as_json):
        import torch

        import kcs_torch as kt
        from kcs_torch.cli.lift import method_fields
        from kcs_torch.data.synthetic import walking_person

        method_fields(method, [])
        files = [output / f"walk{suffix}" for suffix in (".npz", ".html", ".png")]
        check_outputs(files)
        use_one_thread()
        generator = torch.Generator().manual_seed(0)
        example = walking_person(150, yaw=40.0, turn=180.0, noise=2.0, missing=0.03, generator=generator)
        tracks, truth = example.tracks, example.points
        with progress(f"reconstructing {tracks.num_frames} frames of {tracks.num_joints} joints"):
            result = kt.reconstruct(tracks, method=method)
        for path in files:
            with progress(f"writing {path}"):
                result.save(path)
        flat = truth * torch.tensor([1.0, 1.0, 0.0])
        facts: dict[str, Any] = summary(result) | {
            "error": rigid_error(result.points, truth),
            "error_flat": rigid_error(flat, truth),
            "files": files,
        }
        if as_json:
            print_json(facts)
            return
        typer.echo(describe(facts))
        typer.echo(
            f"  error           {facts['error']:.1f} {result.units} a joint after rigid alignment of each frame "
            f"(without depth: {facts['error_flat']:.1f} {result.units})"
        )
        typer.echo(f"  wrote {', '.join(map(str, files))}")


def rigid_error(points: Tensor, truth: Tensor) -> float:
    """Mean distance after a rotation per frame, of the better of the points and their mirror image in depth."""
    import torch

    from kcs_torch.functional import centre, superpose

    target = centre(truth)[0]
    flip = torch.tensor([1.0, 1.0, -1.0]).to(points)
    moved = (superpose(p, target, "rigid") for p in (points, points * flip))
    return min(float((m - target).norm(dim=-1).mean()) for m in moved)
