"""docs/: what the pages name exists."""

import re
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted((ROOT / "docs").glob("*.md"))


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


def test_the_method_page_names_what_exists():
    text = (ROOT / "docs" / "pkc.md").read_text(encoding="utf-8")
    names = set(re.findall(r"`((?:[a-z_]+\.)+\w+)`", text))
    assert len(names) > 20
    for name in sorted(names):
        assert resolve(name.removeprefix("kcs_torch.")) is not None, name


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_and_scripts_exist(page):
    text = page.read_text(encoding="utf-8")
    links = re.findall(r"\]\((?!https?:)([^)#]+)\)", text)
    scripts = re.findall(r"^python (\S+\.py)", text, re.MULTILINE)
    assert links or scripts
    for link in links:
        assert (page.parent / link).exists(), link
    for script in scripts:
        assert (ROOT / script).is_file(), script
