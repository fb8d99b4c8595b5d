"""Commands that show something: info and skeletons as pictures, several people in one page."""

import json

import pytest
from matplotlib.image import imread
from samples import walk_result, walking_motion
from test_cli import QUICK, run

from kcs_torch.io import save


def people(page):
    text = page.read_text(encoding="utf-8")
    start = text.index('type="application/json">') + len('type="application/json">')
    return json.loads(text[start : text.index("</script>", start)])["people"]


def test_info_draws_the_joints_names(openpose_folder, tmp_path):
    done = run("info", openpose_folder, "-o", tmp_path / "body.png")
    assert done.stdout.endswith(f"wrote {tmp_path / 'body.png'}\n")
    assert imread(tmp_path / "body.png").shape[1] > 1500  # two people: three panels
    run("info", openpose_folder, "--output", tmp_path / "body.svg", "--json")
    assert (tmp_path / "body.svg").read_text(encoding="utf-8").rstrip().endswith("</svg>")


def test_info_offers_the_picture(openpose_folder):
    assert f"kcs-torch info {openpose_folder} -o picture.png" in run("info", openpose_folder).stdout


def test_info_draws_to_pictures_only(openpose_folder, tmp_path):
    done = run("info", openpose_folder, "-o", tmp_path / "body.npz", code=2)
    assert "expected a picture with one of the suffixes .png, .svg, .pdf, got '.npz'" in done.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", [".png", ".svg", ".pdf", ".html"])
def test_skeletons_are_drawn(tmp_path, suffix):
    path = tmp_path / f"body{suffix}"
    assert f"wrote {path}" in run("skeletons", "show", "hand21", "-o", path).stdout
    assert path.stat().st_size > 3000


def test_a_skeleton_without_a_template_is_drawn(tmp_path):
    (tmp_path / "stick.yaml").write_text("joints: [a, b, c]\nbones: [[a, b], [b, c]]\n")
    run("skeletons", "show", tmp_path / "stick.yaml", "-o", tmp_path / "stick.png")
    assert imread(tmp_path / "stick.png").shape[0] > 300
    assert "no template" in run("skeletons", "show", tmp_path / "stick.yaml", "-o", tmp_path / "a.html", code=2).stderr


@pytest.mark.filterwarnings("ignore:.*(never seen|without any seen joint|viewpoint turned)")
def test_lift_of_everybody_makes_one_page_of_all(openpose_folder, tmp_path):
    words = ("-o", tmp_path / "walk.html", "-o", tmp_path / "walk.csv", "--person", "all", "--fps", 25)
    done = run("lift", openpose_folder, *words, *QUICK, "--json")
    names = {"walk_0.html", "walk_1.html", "walk.html", "walk_0.csv", "walk_1.csv"}
    assert {p.name for p in tmp_path.iterdir()} == names
    assert len(people(tmp_path / "walk.html")) == 2
    assert len(people(tmp_path / "walk_0.html")) == 1
    assert json.loads(done.stdout)["together"] == [str(tmp_path / "walk.html")]


def test_view_shows_motion(tmp_path):
    """Alone and beside a result; it has no mirror image, and tracks are to be lifted first."""
    save(walking_motion(4), tmp_path / "m.npz")
    save(walk_result(4, name="r.npz"), tmp_path / "r.npz")
    run("view", tmp_path / "m.npz", "-o", tmp_path / "m.html")
    assert len(people(tmp_path / "m.html")) == 1
    run("view", tmp_path / "m.npz", tmp_path / "r.npz", "-o", tmp_path / "both.html", "--scale", "height=1.75m")
    assert len(people(tmp_path / "both.html")) == 2
    assert "--mirror: expected a result" in run("view", tmp_path / "m.npz", "--mirror", code=2).stderr
    save(walk_result(4).tracks, tmp_path / "t.npz")
    assert "got 2D tracks: lift them first" in run("view", tmp_path / "t.npz", code=2).stderr


def test_view_says_how_motion_was_read(tmp_path):
    """Which axis is taken to point up, and how to tell; and nothing of a method, as none made it."""
    save(walking_motion(4), tmp_path / "m.trc")
    told = run("view", tmp_path / "m.trc", "-o", tmp_path / "m.html").stderr
    assert f"note: {tmp_path / 'm.trc'}: y is taken to point up: give up=... (kcs-torch: --from-up)" in told
    assert not any(word in people(tmp_path / "m.html")[0]["summary"] for word in ("turn", "reprojection", "converged"))
    assert "taken to" not in run("view", tmp_path / "m.trc", "--from-up", "-y", "-o", tmp_path / "n.html").stderr
    first, second = (people(tmp_path / name)[0] for name in ("m.html", "n.html"))
    assert first != second


def test_view_plays_at_the_rate_that_is_given(tmp_path):
    """Notes on files that do not tell theirs name this option."""
    save(walking_motion(4), tmp_path / "m.npz")
    run("view", tmp_path / "m.npz", "--fps", 120, "-o", tmp_path / "m.html")
    assert '"fps": 120' in (tmp_path / "m.html").read_text(encoding="utf-8")
    done = run("view", tmp_path / "m.npz", "--fps", 0, code=2)
    assert "fps (--fps): expected a positive number" in done.stderr


def test_view_shows_several_results_together(tmp_path):
    for name in ("a.npz", "b.npz"):
        save(walk_result(4, name=name), tmp_path / name)
    run("view", tmp_path / "a.npz", tmp_path / "b.npz")
    assert [p["name"] for p in people(tmp_path / "a.html")] == ["a.npz", "b.npz"]
    done = run("view", tmp_path / "a.npz", tmp_path / "b.npz", "-o", tmp_path / "c.csv", code=2)
    assert "several people in one file go to" in done.stderr
    words = ["-o", tmp_path / "c.html", "-o", tmp_path / "c.png"]
    done = run("view", tmp_path / "a.npz", tmp_path / "b.npz", *words, code=2)
    assert "c.png: several people in one file go to" in done.stderr and not (tmp_path / "c.html").exists()
