"""Films: which frames they show, how fast, and what is in them."""

import itertools
import json
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from samples import walk_result

from kcs_torch.errors import KcsWarning, OptionError, OutputError
from kcs_torch.io import save, save_people
from kcs_torch.viewer import animation
from kcs_torch.viewer.animation import GIF, MP4, Pace, _is_whole, pace
from kcs_torch.viewer.film import Film

needs_ffmpeg = pytest.mark.skipif(not shutil.which("ffmpeg"), reason="needs ffmpeg (Debian: apt-get install ffmpeg)")


@pytest.fixture(scope="module")
def result():
    return walk_result(12)


def beside(result):
    tracks = replace(result.tracks, points=result.tracks.points + 500)
    return replace(result, points=result.points + torch.tensor([500.0, 0, 0]), tracks=tracks)


@pytest.mark.parametrize("limits", [GIF, MP4])
@pytest.mark.parametrize("frames", [1, 2, 199, 300, 5000, 100_000])
@pytest.mark.parametrize("fps", [None, 5.0, 25.0, 30.0, 120.0, 1000.0])
def test_films_are_short_enough_and_at_the_speed_they_say(limits, frames, fps):
    step, rate, faster = pace(frames, fps, limits)
    assert len(range(0, frames, step)) <= limits.most
    assert rate <= limits.rate
    assert rate * step == pytest.approx((fps or 25.0) * faster)
    own = fps or 25.0
    if frames / own <= limits.most / limits.rate and own >= limits.slowest:
        assert faster == pytest.approx(1)  # a short clip runs as it was


def test_pictures_are_different_and_of_one_size(result):
    pictures, count, rate = animation(result)
    pictures = np.stack(list(pictures))
    assert (len(pictures), count, rate) == (12, 12, 25.0)
    assert pictures.dtype == np.uint8
    assert pictures.shape[1] % 2 == pictures.shape[2] % 2 == 0
    assert all(np.abs(a.astype(int) - b).max() > 100 for a, b in itertools.pairwise(pictures))
    width = pictures.shape[2]
    for half in (pictures[..., : width // 2, :], pictures[..., width // 2 :, :]):
        for colour in ((0x00, 0x72, 0xB2), (0xD5, 0x5E, 0x00)):  # both sides in both pictures
            assert (np.abs(half.astype(int) - colour).max(-1) < 30).mean() > 5e-4


def test_doubts_are_in_the_head(result):
    unsure = replace(result, diagnostics=replace(result.diagnostics, doubt="depth is a guess: why"))
    film = Film([result, unsure], 1.0)
    film.picture(0, 0.0)
    assert film.head.get_text().endswith(" · depth is a guess")


def test_several_people_are_in_one_film(result):
    def ink(results):
        return float((next(animation(results)[0]) < 128).mean())

    assert ink([result, beside(result)]) > 1.15 * ink(result)


def test_a_person_who_comes_later_is_not_there_before(result):
    weights = result.tracks.weights.clone()
    weights[:6] = 0
    late = beside(result)
    late = replace(late, tracks=replace(late.tracks, weights=weights))
    first = next(animation([result, late])[0])
    there = next(animation([result, beside(result)])[0])
    assert (first < 128).mean() < 0.95 * (there < 128).mean()


def test_somebody_who_goes_far_is_drawn_as_large(result):
    """Ink in both halves stays about the same when the body also moves away by twenty of its sizes."""
    far = torch.linspace(0, 20 * float(np.ptp(result.points.numpy())), 12, dtype=torch.float64)[:, None, None]
    away = torch.nn.functional.pad(far, (0, 1))
    tracks = replace(result.tracks, points=result.tracks.points + away)
    moved = replace(result, points=result.points + torch.nn.functional.pad(away, (0, 1)), tracks=tracks)
    still, moving = (list(animation(r)[0])[6] < 128 for r in (result, moved))
    half = still.shape[1] // 2
    for part in (np.s_[:, :half], np.s_[:, half:]):
        assert moving[part].mean() > 0.6 * still[part].mean()


def test_gif_loops_through_every_frame(result, tmp_path):
    with Image.open(save(result, tmp_path / "walk.gif")) as film:
        assert film.n_frames == 6  # 25 frames a second are too many for a GIF: every second one
        assert film.info["duration"] == 80
        assert film.info["loop"] == 0
        assert film.size == (880, 440)


@needs_ffmpeg
def test_mp4_can_be_played_by_others(result, tmp_path):
    path = save_people([result, beside(result)], tmp_path / "walk.mp4")
    facts = subprocess.run(
        ["ffprobe", "-loglevel", "error", "-count_frames", "-show_streams", "-of", "json", path],
        capture_output=True,
        text=True,
        check=True,
    )
    (stream,) = json.loads(facts.stdout)["streams"]
    assert (stream["codec_name"], stream["pix_fmt"]) == ("h264", "yuv420p")
    assert (stream["width"], stream["height"], stream["nb_read_frames"]) == (880, 440, "12")
    assert stream["r_frame_rate"] == "25/1"


def test_without_ffmpeg_the_package_is_named(result, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(OutputError, match="pip install imageio-ffmpeg"):
        save(result, tmp_path / "walk.mp4")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("script", ["echo no such codec >&2; exit 1", "cat >/dev/null; echo no such codec >&2; exit 3"])
def test_a_failing_ffmpeg_is_told(result, tmp_path, monkeypatch, script):
    folder = tmp_path / "bin"
    folder.mkdir()
    program = folder / "ffmpeg"
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    monkeypatch.setenv("PATH", f"{folder}:/usr/bin:/bin")
    with pytest.raises(OutputError, match=r"walk\.mp4: ffmpeg could not make an MP4: no such codec"):
        save(result, tmp_path / "walk.mp4")
    assert not (tmp_path / "walk.mp4").exists()


def test_odd_motions_are_filmed(result, tmp_path):
    gaps = result.points.clone()
    gaps[2] = torch.nan
    gaps[:, 3] = torch.nan
    blind = replace(result.tracks, weights=torch.zeros_like(result.tracks.weights))
    evil = replace(result.tracks, source="$x^{2$\udcff")
    still = replace(result, points=torch.zeros_like(result.points))
    for odd in (replace(result, points=gaps), replace(result, tracks=blind), replace(result, tracks=evil), still):
        pictures, count, _ = animation(odd, Pace(3, 10, 5))
        assert len(list(pictures)) == count <= 3
    with pytest.raises(OutputError, match="finite"):
        animation(replace(result, points=result.points * torch.nan))
    with pytest.raises(OptionError, match="at least one result"):
        animation([])
    other = replace(result, tracks=replace(result.tracks, fps=50.0))
    for suffix in (".gif", ".rrd"):
        with pytest.raises(OptionError, match="people of one clip, got frame rates"):
            save_people([result, other], tmp_path / f"w{suffix}")
    assert not list(tmp_path.iterdir())


def test_recording_is_read_by_rerun(result, tmp_path):
    pytest.importorskip("rerun", reason="needs rerun-sdk, a large package")
    path = save_people([result, beside(result)], tmp_path / "walk.rrd")

    def rerun(*words):
        return subprocess.run(
            [sys.executable, "-m", "rerun", "rrd", *words], capture_output=True, text=True, check=True
        )

    rerun("verify", path)
    told = rerun("print", path).stdout
    for entity in ("/space/person_0/joints", "/space/person_1/bones", "/image/", "/lengths/", "/uncertainty/"):
        assert entity in told.replace("\\ ", "_"), entity


def test_without_rerun_the_package_is_named(result, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(OutputError, match="pip install rerun-sdk"):
        save(result, tmp_path / "walk.rrd")
    assert list(tmp_path.iterdir()) == []


def test_files_of_one_person_are_told(result, tmp_path):
    with pytest.raises(OutputError, match=r"several people in one file go to \.gif, \.html, \.mp4, \.rrd"):
        save_people([result, result], tmp_path / "walk.npz")


def test_people_of_clips_that_are_not_equally_long_are_told(result, tmp_path):
    with pytest.warns(KcsWarning, match=r"people have 12, 5 frames: all are shown from their own first one on"):
        save_people([result, walk_result(5)], tmp_path / "walk.html")


def test_half_an_mp4_is_told_from_a_whole_one(tmp_path):
    """ffmpeg does not always say that a disk is full."""
    box = lambda kind, size: (8 + size).to_bytes(4, "big") + kind + bytes(size)  # noqa: E731
    whole = box(b"ftyp", 24) + box(b"moov", 100) + box(b"mdat", 500)
    path = tmp_path / "a.mp4"
    large = (1).to_bytes(4, "big") + b"mdat" + (516).to_bytes(8, "big") + bytes(500)
    for made, good in (
        (whole, True),
        (box(b"moov", 9) + large, True),
        (box(b"moov", 9) + bytes(4) + b"mdat" + bytes(50), True),  # to the end of the file
        (whole[:-1], False),
        (whole[:300], False),
        (box(b"ftyp", 24) + box(b"mdat", 500), False),
        (b"", False),
        (whole + bytes(3), False),
    ):
        path.write_bytes(made)
        assert _is_whole(path) is good
