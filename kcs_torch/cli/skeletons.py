"""``kcs-torch skeletons``: list the built-in skeletons, or show one."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from kcs_torch.cli.options import AsJson, check_outputs
from kcs_torch.cli.pictures import is_picture, write_picture
from kcs_torch.cli.report import answer, print_json

if TYPE_CHECKING:
    from rich.tree import Tree

    from kcs_torch.skeleton import Skeleton

__all__ = ["app"]

app = typer.Typer(help="List the built-in skeletons, or show one.", invoke_without_command=True)


@app.callback()
def _default(context: typer.Context) -> None:
    if context.invoked_subcommand is None:
        list_skeletons()


@app.command("list")
def list_skeletons(as_json: AsJson = False) -> None:
    """List the built-in skeletons."""
    with answer(as_json):
        from kcs_torch.skeleton import SKELETONS

        rows = [
            {
                "name": name,
                "joints": body.num_observed,
                "virtual": body.num_joints - body.num_observed,
                "bones": body.num_bones,
                "template": body.template is not None,
            }
            for name, body in SKELETONS.items()
        ]
        if as_json:
            print_json(rows)
            return
        typer.echo("name            joints  virtual  bones  template")
        for row in rows:
            template = "yes" if row["template"] else "no"
            typer.echo(f"{row['name']:<14}  {row['joints']:>6}  {row['virtual']:>7}  {row['bones']:>5}  {template:>8}")


@app.command("show")
def show_skeleton(
    name: Annotated[
        str, typer.Argument(metavar="NAME|FILE", help="A built-in name, or a YAML or JSON file.", show_default=False)
    ],
    output: Annotated[
        list[Path],
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="Draw it with the joints' names: .png, .svg or .pdf; or its template as a page to turn: .html.",
            show_default=False,
        ),
    ] = [],  # noqa: B006 (typer reads it and never changes it)
    as_json: AsJson = False,
) -> None:
    """Show a skeleton's joints, bones, mirror pairs, hinges and contacts; a file is checked."""
    with answer(as_json):
        from kcs_torch.errors import OutputError
        from kcs_torch.skeleton import get_skeleton

        body = get_skeleton(name)
        for path in output:
            if not is_picture(path) and path.suffix.lower() != ".html":
                raise OutputError(f"{path}: expected a file with one of the suffixes .png, .svg, .pdf and .html")
        check_outputs([path for path in output if not is_picture(path)])
        for path in output:
            if is_picture(path):
                from kcs_torch.viewer import draw_skeleton

                write_picture(lambda: draw_skeleton(body), path)
            else:
                _save_template(body, path)
        if as_json:
            print_json(body.to_dict())
        else:
            _print(body)
            for path in output:
                typer.echo(f"wrote {path}")


def _print(body: Skeleton) -> None:
    """A heading and the bones: as trees where they are, as a list otherwise."""
    virtual = body.num_joints - body.num_observed
    more = f" + {virtual} virtual" if virtual else ""
    template = "with a template pose" if body.template is not None else "without a template pose"
    typer.echo(f"{body.name}: {body.num_observed}{more} joints, {body.num_bones} bones, {template}")
    if body.is_tree:
        from rich.console import Console

        Console(soft_wrap=True, highlight=False).print(_tree(body))
    else:
        typer.echo(f"joints: {', '.join(body.joints)}")
        for bone in body.bone_names:
            typer.echo(f"  {bone}")
    pairs = ", ".join(f"{body.joints[a]} = {body.joints[b]}" for a, b in body.mirror)
    typer.echo(f"mirror pairs: {pairs or 'none'}")
    hinges = ", ".join(f"{body.joints[h.joint]} {h.bends}" for h in body.hinges)
    typer.echo(f"bend one way: {hinges or 'none known'}")
    typer.echo(f"touch the ground: {', '.join(body.joints[i] for i in body.contacts) or 'none known'}")
    if body.spread is not None:
        typer.echo(f"bones stray from the template by {min(body.spread):g} to {max(body.spread):g} degrees")


def _tree(body: Skeleton) -> Tree:
    from rich.markup import escape
    from rich.tree import Tree

    means = {v: f" (virtual: mean of {', '.join(body.joints[s] for s in sources)})" for v, sources in body.virtual}
    flexible = {body.bones[i] for i in body.flexible}

    def label(joint: int, bone: tuple[int, int] | None = None) -> str:
        number = f"{joint} " if joint < body.num_observed else ""
        return escape(f"{number}{body.joints[joint]}{means.get(joint, '')}{' (flexible)' if bone in flexible else ''}")

    neighbours: dict[int, list[tuple[int, tuple[int, int]]]] = {n: [] for n in range(body.num_joints)}
    for bone in body.bones:
        neighbours[bone[0]].append((bone[1], bone))
        neighbours[bone[1]].append((bone[0], bone))
    children = {b for _, b in body.bones}
    start = next(n for n in range(body.num_joints) if n not in children)
    top = Tree(label(start))
    waiting = [(start, -1, top)]
    while waiting:
        joint, came_from, branch = waiting.pop()
        for other, bone in neighbours[joint]:
            if other != came_from:
                waiting.append((other, joint, branch.add(label(other, bone))))
    return top


def _save_template(body: Skeleton, path: Path) -> None:
    """Write the template pose as a motion of one frame.

    Raises:
        SkeletonError: the skeleton has none.
    """
    import torch

    from kcs_torch.functional import bone_lengths
    from kcs_torch.types import Diagnostics, Reconstruction, Tracks

    points = body.template_points(dtype=torch.float64)[None]
    ones = torch.ones(points.shape[:-1], dtype=points.dtype)
    tracks = Tracks(points[..., :2], ones, body, units="", source=body.name)
    facts = Diagnostics(0.0, 0.0, 0.0, 0.0, True, 0)
    lengths = bone_lengths(points, body.bone_index())[0]
    cameras = torch.eye(3, dtype=points.dtype)[None, :2]
    Reconstruction(points, cameras, ones[:, 0], lengths, tracks, "template", facts, units="template").save(path)
