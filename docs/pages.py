"""What the pages show of the code itself: made when the site is built, so that it cannot be out of date.

A Sphinx extension. Into ``docs/_generated`` go the tables of formats, methods and skeletons, the command-line reference
and lists of names for the API reference; into ``docs/_gallery`` the pictures of ``scripts/gallery.py``. Formulas become
MathML, which browsers draw by themselves, so that the site needs no network.
"""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import sys
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path
from typing import Any

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
GENERATED, GALLERY = DOCS / "_generated", DOCS / "_gallery"

MODULES = (
    *("clean", "data", "detect", "functional", "io", "live"),
    *("many", "methods", "metrics", "nn", "solvers", "training", "types", "viewer"),
)
"""Public modules below kcs_torch, each a page of the API reference."""


def table(heads: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A table in Markdown."""
    heads = list(heads)
    lines = [heads, ["---"] * len(heads), *([str(cell).replace("|", "\\|") for cell in row] for row in rows)]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def readers() -> str:
    """The formats that tracks come in."""
    from kcs_torch.io import READERS

    return table(["`--format`", "what"], ((f"`{name}`", reader.summary) for name, reader in READERS.items()))


def motion_readers() -> str:
    """The formats that 3D motion comes in."""
    from kcs_torch.io import MOTION_READERS

    return table(["`--format`", "what"], ((f"`{name}`", reader.summary) for name, reader in MOTION_READERS.items()))


def writers() -> str:
    """The formats that can be written."""
    from kcs_torch.io import WRITERS

    rows = (
        (f"`{suffix}`", writer.summary, yes(writer.write_motion), yes(writer.write_tracks), yes(writer.write_people))
        for suffix, writer in WRITERS.items()
    )
    return table(["suffix", "what", "3D motion, too", "tracks, too", "several people"], rows)


def skeletons() -> str:
    """The built-in skeletons, with a picture of each."""
    from kcs_torch import SKELETONS

    rows = [
        (f"[`{name}`](#{name})", body.num_observed, body.num_joints - body.num_observed, len(body.hinges))
        for name, body in SKELETONS.items()
    ]
    text = [table(["name", "joints", "virtual", "hinges"], rows)]
    for name, body in SKELETONS.items():
        virtual = ", ".join(f"`{joint}`" for joint in body.joints[body.num_observed :])
        more = f" Virtual: {virtual}." if virtual else ""
        text.append(f"## {name}\n\n{body.num_observed} joints.{more}\n\n![{name}](_gallery/skeleton_{name}.png)\n")
    return "\n".join(text)


def options(method: str) -> str:
    """The fields of a method, as ``reconstruct(..., field=value)`` and ``--set field=value`` take them."""
    import dataclasses

    from kcs_torch import METHODS

    kind = METHODS[method]
    said = re.findall(r"^ {4}(?:    )?(\w+): (.*(?:\n {12}.*)*)", (kind.__doc__ or "").partition("Args:")[2], re.M)
    words = {name: re.sub(r"\s+", " ", re.sub(r":\w+:`(.*?)`", r"`\1`", text)) for name, text in said}
    rows = ((f"`{f.name}`", f"`{f.default!r}`", words.get(f.name, "")) for f in dataclasses.fields(kind))
    return table(["field", "default", "what"], rows)


def command_line() -> str:
    """The reference of all commands, by typer's own command."""
    call = [sys.executable, "-m", "typer", "kcs_torch.cli", "utils", "docs", "--name", "kcs-torch"]
    text = subprocess.run(call, capture_output=True, text=True, check=True, env=quiet()).stdout
    text = re.sub(r"\A# .*\n", "", text)
    text = re.sub(r"^(#+) `(.*)`$", r"\1 \2", text, flags=re.M)
    text = re.sub(r"^(\*\*Usage\*\*:)\n\n```console\n\$ (.*)\n```", r"```text\n\2\n```", text, flags=re.M)
    text = re.sub(r"(?<![`\w-])(--[a-z][\w-]*)(?![^`\n]*`:)", r"`\1`", text)
    text = re.sub(r"\*\*Commands\*\*:\n\n(\* .*\n)+\n?", "", text)
    return re.sub(r"^\* `(--help|-h, --help)`: Show this message and exit.\n", "", text, flags=re.M)


def reference(name: str) -> str:
    """The page of a module of the API reference; '' is the package itself."""
    package = importlib.import_module("kcs_torch")
    full = f"kcs_torch.{name}" if name else "kcs_torch"
    module = importlib.import_module(full)
    own, elsewhere = [], []
    for one in sorted(module.__all__, key=str.lower):
        value = getattr(module, one)
        if name and one in package.__all__ and getattr(package, one) is value:
            elsewhere.append(one)
        elif not isinstance(value, type(sys)):
            own.append(one)
    text = [f"# {full}\n"]
    about = [f".. automodule:: {full}", "   :no-members:", "", f".. currentmodule:: {full}", ""]
    kinds = {one: kind_of(getattr(module, one)) for one in own}
    listed = [one for one, kind in kinds.items() if kind != "data"]
    if listed:
        about += [".. autosummary::", "", *(f"   {one}" for one in listed), ""]
    for one, kind in kinds.items():
        if kind == "data":  # the words below an assignment, which autodoc looks for in this module only
            about += [f".. py:data:: {one}", "", f"   {said_of(one)}", ""]
            continue
        about += [f".. auto{kind}:: {one}", *members(getattr(module, one), kind), ""]
    text.append("```{eval-rst}\n" + "\n".join(about) + "```\n")
    if elsewhere:
        text.append("On the page of [the package](kcs_torch.md): " + ", ".join(f"`{one}`" for one in elsewhere) + ".\n")
    return "\n".join(text)


def members(value: Any, kind: str) -> list[str]:
    """What autodoc is to show of a class; of tracks and motion also what their base, which has no page, holds."""
    from kcs_torch.types.trajectories import Trajectories

    if kind != "class":
        return []
    return ["   :members:", *(["   :inherited-members: object"] if issubclass(value, Trajectories) else [])]


def kind_of(value: object) -> str:
    """What autodoc calls it."""
    if isinstance(value, type):
        return "exception" if issubclass(value, BaseException) else "class"
    return "function" if callable(value) else "data"


def said_of(name: str) -> str:
    """The words below the assignment of a public name."""
    for path in sorted((ROOT / "kcs_torch").rglob("*.py")):
        body = ast.parse(path.read_text(encoding="utf-8")).body
        for line, following in pairwise(body):
            one = [line.target] if isinstance(line, ast.AnnAssign) else []
            targets = line.targets if isinstance(line, ast.Assign) else one
            if any(isinstance(part, ast.Name) and part.id == name for t in targets for part in ast.walk(t)):
                value = getattr(following, "value", None)
                if isinstance(following, ast.Expr) and isinstance(value, ast.Constant):
                    return " ".join(str(value.value).split())
    return ""


def yes(value: object) -> str:
    """A cell of a table."""
    return "yes" if value is not None else ""


def quiet() -> dict[str, str]:
    """An environment in which programs do not colour or wrap what they write."""
    import os

    return {**os.environ, "NO_COLOR": "1", "TERM": "dumb", "COLUMNS": "200"}


def write(path: Path, text: str) -> None:
    """Write where something changed: Sphinx reads files again that are newer."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.is_file() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")


def generate(app: Any = None, config: Any = None) -> None:
    """Write everything that pages include."""
    from kcs_torch import METHODS

    for make in (readers, motion_readers, writers, skeletons, command_line):
        write(GENERATED / f"{make.__name__}.md", make())
    for name in METHODS:
        write(GENERATED / f"options_{name}.md", options(name))
    for name in ("", *MODULES):
        write(DOCS / "api" / f"{name or 'kcs_torch'}.md", reference(name))
    call = [sys.executable, str(ROOT / "scripts" / "gallery.py"), "--output", str(GALLERY)]
    subprocess.run(call, check=True, env=quiet())


def mathml(text: str, block: bool) -> str:
    """A formula in LaTeX as MathML."""
    from docutils.utils.math.latex2mathml import tex2mathml

    single = r"\s*([0-9A-Za-z]|\\[A-Za-z]+)"  # TeX takes one sign for an argument, and the converter a whole number
    text = re.sub(r"\\(t?frac)" + single + single, r"\\\1{\2}{\3}", text)
    text = re.sub(r"\\(t?frac)" + single + r"(?=\s*{)", r"\\\1{\2}", text)
    text = re.sub(r"\\(log|det)\b(?=\s*[\\A-Z|])(?!\s*\\(left|[bB]ig|!))", r"\\\1\\,", text)  # no function is set apart
    text = re.sub(r"\\([bB])ig(?=[(\[])", r"\\\1igl", text)
    text = re.sub(r"\\([bB])ig(?=[)\]])", r"\\\1igr", text)
    return str(tex2mathml(text, as_block=block))


def plain(app: Any, what: str, name: str, obj: object, options: Any, lines: list[str]) -> None:
    """Docstrings are plain text: bars and stars in their formulas are no markup, and returns begin with no type."""
    returned = False
    for i, line in enumerate(lines):
        if line.lstrip().startswith((">>>", "...")):
            continue
        parts = re.split(r"(``.*?``)", line)
        parts[::2] = [re.sub(r"([|*])", r"\\\1", part) for part in parts[::2]]
        lines[i] = "".join(parts)
        if returned and line.strip():  # the first line of the section, which napoleon would split at a colon
            lines[i - 1], lines[i] = "", f":returns: {lines[i].strip()}"
        returned = line == "Returns:"


def find(app: Any, env: Any, node: Any, text: Any) -> Any:
    """Docstrings name what the package has by its short name."""
    name = node.get("reftarget", "")
    objects = env.get_domain("py").objects
    if node.get("refdomain") != "py" or f"kcs_torch.{name}" not in objects:
        return None
    from sphinx.util.nodes import make_refnode

    place = objects[f"kcs_torch.{name}"]
    return make_refnode(app.builder, node["refdoc"], place.docname, place.node_id, text, name)


def setup(app: Any) -> dict[str, bool]:
    """Called by Sphinx."""

    def inline(visitor: Any, node: Any) -> None:
        from docutils.nodes import SkipNode

        visitor.body.append(mathml(node.astext(), False))
        raise SkipNode

    def display(visitor: Any, node: Any) -> None:
        from docutils.nodes import SkipNode

        visitor.body.append(f'<div class="math-block">{mathml(node.astext(), True)}</div>')
        raise SkipNode

    app.add_html_math_renderer("mathml", inline_renderers=(inline, None), block_renderers=(display, None))
    app.connect("config-inited", generate, priority=100)  # before Sphinx looks for the players
    app.connect("missing-reference", find)
    app.connect("autodoc-process-docstring", plain, priority=400)  # before napoleon
    return {"parallel_read_safe": True, "parallel_write_safe": True}
