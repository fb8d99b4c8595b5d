"""What the README shows works: its Python, its commands, its lists."""

import re
import shlex
import shutil
import tomllib
import warnings
from pathlib import Path

import pytest
import torch
from typer.testing import CliRunner

import kcs_torch as kt
from kcs_torch.cli import app

TEXT = (Path(__file__).resolve().parents[1] / "README.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", TEXT, re.MULTILINE | re.DOTALL)


def table(heading: str) -> list[str]:
    """The names in the first column of the table whose first heading is given."""
    lines = TEXT.splitlines()
    first = next(i for i, line in enumerate(lines) if line.startswith(f"| {heading} |"))
    names = []
    for line in lines[first + 2 :]:
        if not line.startswith("|"):
            break
        names.append(re.match(r"\| `(.+?)` \|", line).group(1))
    return names


@pytest.fixture
def users_folder(openpose_folder, tmp_path, monkeypatch):
    """A user's working folder, with tracks under the README's name."""
    shutil.copytree(openpose_folder, tmp_path / "openpose_json")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_python_runs_from_top_to_bottom(users_folder):
    names: dict = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", kt.KcsWarning)  # short clips made for tests need not converge
        for block in blocks("python"):
            exec(compile(block, "README.md", "exec"), names)
    assert (users_folder / "walk.html").stat().st_size > 1000
    assert names["result"].points.isfinite().all()


def test_four_lines_reconstruct_a_users_file():
    assert len([line for line in blocks("python")[0].splitlines() if line]) == 4


def test_the_lizard_has_depth():
    """No warning calls it a guess: one would be an error here."""
    (block,) = (block for block in blocks("python") if "lizard = " in block)
    torch.manual_seed(3)
    names = {"kt": kt}
    exec(compile(block, "README.md", "exec"), names)
    assert not names["result"].diagnostics.doubt


def test_commands_run(users_folder):
    lines = [line for block in blocks("bash") for line in block.splitlines() if line.startswith("kcs-torch ")]
    assert len(lines) > 3
    for line in lines:
        done = CliRunner().invoke(app, shlex.split(line)[1:])
        assert done.exit_code == 0, f"{line}\n{done.output}"
    assert {"walk.npz", "walk.html", "walk.csv", "walk.png"} <= {p.name for p in users_folder.iterdir()}


def test_two_commands_set_everything_up(root):
    """One command installs and runs the demo, one runs the tests; the checks run the latter from here."""
    install, tests = [b.strip() for b in blocks("bash") if ".venv" in b]
    assert "\n" not in install and "\n" not in tests
    assert install.endswith("&& kcs-torch demo")
    extra = re.search(r'pip install -e "\.\[(\w+)\]"', install).group(1)
    project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert any(need.startswith("pytest-xdist") for need in project["optional-dependencies"][extra])
    assert [line for line in TEXT.splitlines() if "-m pytest" in line] == [tests]


def test_methods_are_those_of_the_registry():
    assert sorted(table("name")) == sorted(kt.METHODS)


def test_formats_are_those_of_the_registries():
    from kcs_torch.io import MOTION_READERS, READERS, WRITERS

    assert sorted(table("reads")) == sorted(READERS)
    assert sorted(table("reads motion")) == sorted(MOTION_READERS)
    assert sorted(table("writes")) == sorted(WRITERS)


def test_links_lead_somewhere(root):
    links = re.findall(r"\]\(([^)]+)\)", TEXT)
    assert links
    for link in links:
        assert link.startswith("https://") or (root / link).is_file(), link


def test_picture_is_small(root):
    assert (root / "docs" / "demo.png").stat().st_size < 300_000
