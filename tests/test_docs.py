"""docs/: what the pages show works, what they name exists, and what is made from the code is whole."""

import re
import runpy
import shlex
import shutil
import sys
import warnings
from importlib import import_module
from pathlib import Path

import pytest
from animal_samples import deeplabcut_columns, write_deeplabcut_csv
from typer.testing import CliRunner

import kcs_torch as kt
from kcs_torch.cli import app

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.glob("*.md"))
BLOCK = re.compile(r"^```(python|bash|yaml)\n(.*?)^```", re.MULTILINE | re.DOTALL)
MADE = runpy.run_path(str(DOCS / "pages.py"))
PICTURES = runpy.run_path(str(ROOT / "scripts" / "gallery.py"))["PICTURES"]


def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def resolve(name: str) -> object:
    """What a dotted name below kcs_torch stands for; modules come before their namesakes."""
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        try:
            found = import_module(".".join(["kcs_torch", *parts[:count]]))
        except ModuleNotFoundError:
            continue
        for part in parts[count:]:
            found = getattr(found, part)
        return found
    raise ModuleNotFoundError(name)


@pytest.mark.parametrize("page", ["pkc", "kcs", "sfam", "baselines"])
def test_method_pages_name_what_exists(page):
    names = set(re.findall(r"`((?:[a-z_0-9]+\.)+\w+)`", text_of(DOCS / f"{page}.md")))
    assert len(names) > 4
    for name in sorted(names):
        assert resolve(name.removeprefix("kcs_torch.")) is not None, name


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_pictures_and_scripts_exist(page):
    text = text_of(page)
    targets = re.findall(r"\]\((?!https?:|#)([^)#]+)(?:#[^)]*)?\)|src=\"([^\"]+)\"|^```{include} (\S+)", text, re.M)
    for target in ("".join(groups) for groups in targets):
        made = {
            "_gallery": lambda name: name in PICTURES,
            "_generated": lambda name: name.removesuffix(".md") in MADE or name[8:-3] in kt.METHODS,
            "api": lambda name: name.removesuffix(".md") in MADE["MODULES"],
        }
        first, _, rest = target.partition("/")
        there = made[first](rest) if first in made else (page.parent / target).exists() or f"pages/{target}" in PICTURES
        assert there, target
    for script in re.findall(r"^python (\S+\.py)|`(scripts/\S+\.py)`", text, re.M):
        assert (ROOT / "".join(script)).is_file(), script


def test_every_page_is_in_the_table_of_contents():
    trees = re.findall(r"^```{toctree}\n(.*?)^```", text_of(DOCS / "index.md"), re.M | re.S)
    listed = {line for tree in trees for line in tree.splitlines() if line and not line.startswith(":")}
    assert listed == {page.stem for page in PAGES} - {"index"}
    assert set(re.findall(r"^api/(\w+)$", text_of(DOCS / "api.md"), re.M)) == {"kcs_torch", *MADE["MODULES"]}


@pytest.fixture
def users_folder(openpose_folder, tmp_path, monkeypatch):
    """A user's working folder, with tracks under the names that the pages use."""
    shutil.copytree(openpose_folder, tmp_path / "openpose_json")
    parts = ("snout", "neck", "back", "tail_base", "left_paw", "right_paw")
    bones = [("neck", "snout"), ("neck", "back"), ("back", "tail_base"), ("neck", "left_paw"), ("neck", "right_paw")]
    clip = kt.data.random_motion(kt.Skeleton.from_names(parts, bones), 40, turn=150, size=400)
    values = (clip.tracks.points + 500).flatten(1).numpy()
    write_deeplabcut_csv(tmp_path / "mouse.csv", deeplabcut_columns(parts=parts, coords=("x", "y")), values)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("page", [p for p in PAGES if p.name != "benchmarks.md" and BLOCK.search(text_of(p))], ids=str)
def test_what_pages_show_runs_from_top_to_bottom(page, users_folder):
    """Python, kcs-torch commands and the files in between; ```shell blocks are for what a test cannot do."""
    text, names = text_of(page), {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", kt.KcsWarning)  # short clips made for tests need not converge
        for found in BLOCK.finditer(text):
            kind, block = found.groups()
            if kind == "yaml":
                name = re.findall(r"`(\w+\.yaml)`", text[: found.start()])[-1]
                (users_folder / name).write_text(block, encoding="utf-8")
            elif kind == "python":
                exec(compile(block, page.name, "exec"), names)
            else:
                lines = [line for line in block.splitlines() if line.startswith("kcs-torch ")]
                for line in lines:
                    done = CliRunner().invoke(app, shlex.split(line)[1:])
                    assert done.exit_code == 0, f"{line}\n{done.output}"


def test_quick_start_takes_three_commands(users_folder):
    blocks = re.findall(r"^```(?:bash|shell)\n(.*?)^```", text_of(DOCS / "quickstart.md"), re.M | re.S)
    commands = [line for block in blocks for line in block.splitlines()]
    assert len(commands) == 3 and commands[-1].startswith("kcs-torch lift") and ".bvh" in commands[-1]


def test_tables_of_formats_are_the_registries():
    from kcs_torch.io import MOTION_READERS, READERS, WRITERS

    for make, registry in (("readers", READERS), ("motion_readers", MOTION_READERS), ("writers", WRITERS)):
        assert re.findall(r"^\| `(.+?)` \|", MADE[make]().partition("---")[2], re.M) == list(registry)
        assert f"_generated/{make}.md" in text_of(DOCS / "formats.md")


@pytest.mark.parametrize("method", sorted(kt.METHODS))
def test_every_field_of_a_method_is_described(method):
    rows = MADE["options"](method).splitlines()[2:]
    assert len(rows) > 1 and all(len(row.split(" | ")[2]) > 10 for row in rows), rows
    page = DOCS / f"{method}.md"
    assert f"_generated/options_{method}.md" in text_of(page if page.exists() else DOCS / "baselines.md")


def test_command_reference_has_all_commands():
    headings = re.findall(r"^#+ kcs-torch (.*)$", MADE["command_line"](), re.M)
    commands = [c.name or c.callback.__name__ for c in app.registered_commands]
    assert headings == [*commands, "skeletons", "skeletons list", "skeletons show"]


@pytest.mark.parametrize("name", ["", *MADE["MODULES"]])
def test_reference_has_every_public_name_with_words(name):
    module = import_module(f"kcs_torch.{name}" if name else "kcs_torch")
    text = MADE["reference"](name)
    for one in module.__all__:
        if not isinstance(getattr(module, one), type(sys)):
            assert re.search(rf"\b{one}\b", text), one
    for said in re.findall(r"^\.\. py:data:: .*\n\n(.*)$", text, re.M):
        assert said.strip(), text


def test_formulas_become_mathml():
    pytest.importorskip("docutils", reason="docutils comes with the extra test")
    formula = re.compile(r"^ *```math\n(.*?)^ *```|(?<!\$)\$([^$\n]+)\$", re.M | re.S)
    formulas = [found for page in PAGES for found in formula.findall(text_of(page))]
    assert len(formulas) > 100
    for block, inline in formulas:
        assert "<math" in MADE["mathml"](block or inline, bool(block))
    assert "<mfrac>\n    <mn>1</mn>" in MADE["mathml"](r"\frac12 x", False)


def test_gallery_makes_pictures_and_keeps_them(tmp_path, monkeypatch, capsys):
    call = ["gallery.py", "--output", str(tmp_path), "--only", "skeleton_coco17.png", "cleaned.png"]
    for expected in (2, 0):
        monkeypatch.setattr(sys, "argv", call)
        runpy.run_path(str(ROOT / "scripts" / "gallery.py"), run_name="__main__")
        assert len(capsys.readouterr().out.splitlines()) == expected
    for path in tmp_path.glob("*.png"):
        assert path.read_bytes().startswith(b"\x89PNG")
    used = {name for page in PAGES for name in re.findall(r"_gallery/(\S+?)\)", text_of(page))}
    assert used <= set(PICTURES) and len(used) > 5
