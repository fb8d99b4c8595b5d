"""scripts/formats.py, scripts/live.py and scripts/gallery.py: what they are called wrongly with is a line."""

import sys

import pytest

import kcs_torch as kt
from kcs_torch.data import walking_person


def called(script, monkeypatch, capsys, *words):
    """Exit code, output and errors of a script."""
    monkeypatch.setattr(sys, "argv", [script.__name__, *map(str, words)])
    code = 0
    try:
        script.main()
    except SystemExit as end:
        code = end.code
    return code, *capsys.readouterr()


@pytest.fixture
def tracks(tmp_path):
    kt.save(walking_person(5, skeleton="coco17").tracks, tmp_path / "in" / "walk.npz")
    return tmp_path / "in"


def test_formats_lists_a_link_that_leads_nowhere(import_script, tracks, monkeypatch, capsys):
    (tracks / "deep").mkdir()
    (tracks / "deep" / "link").symlink_to(tracks / "gone")
    code, out, _ = called(import_script("formats"), monkeypatch, capsys, tracks)
    assert code == 0 and "| walk.npz |" in out and "deep/link: " in out


def test_formats_refuses_a_size_that_is_none(import_script, tracks, monkeypatch, capsys):
    code, out, err = called(import_script("formats"), monkeypatch, capsys, tracks, "--image-size", "nonsense")
    assert code == 2 and not out and "--image-size: expected WIDTHxHEIGHT" in err


def test_live_asks_for_the_truth_of_every_file(import_script, tracks, monkeypatch, capsys):
    code, out, err = called(import_script("live"), monkeypatch, capsys, "--inputs", tracks, "--truth", tracks.parent)
    assert code == 2 and not out and f"--truth {tracks.parent}: expected a file walk.npz" in err


def test_gallery_tells_of_tracks_that_are_not_there(import_script, tmp_path, monkeypatch, capsys):
    words = ("--output", tmp_path, "--real", tmp_path / "gone.json")
    script = import_script("gallery")
    monkeypatch.setattr(script, "PICTURES", {})
    code, out, _ = called(script, monkeypatch, capsys, *words)
    assert str(code).startswith("error: ") and "gone.json: there is no such file" in code and not out
