"""The player page and the sheet of key frames."""

import base64
import json
import re
import sys
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
import torch
from samples import walk_result

from kcs_torch.errors import OptionError, OutputError
from kcs_torch.io import save
from kcs_torch.skeleton import SKELETONS, Skeleton
from kcs_torch.viewer import player, sheet
from kcs_torch.viewer.colours import COLOURS, bone_side
from kcs_torch.viewer.summary import summarise

EVIL = '</script><script>alert("x")</script><img src=x onerror=alert(1)>&amp;\u2028'


@pytest.fixture(scope="module")
def result():
    return walk_result()


class Page(HTMLParser):
    """What a browser makes of a page: its elements, their attributes, and the text in each."""

    def __init__(self, text):
        super().__init__()
        self.elements, self.stack = [], []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.elements.append({"tag": tag, "text": "", **dict(attrs)})
        if tag not in ("meta", "input", "img"):
            self.stack.append(self.elements[-1])

    def handle_endtag(self, tag):
        assert self.stack.pop()["tag"] == tag

    def handle_data(self, data):
        if self.stack:
            self.stack[-1]["text"] += data

    def all(self, tag):
        return [e for e in self.elements if e["tag"] == tag]


def scene(text):
    (data,) = [e["text"] for e in Page(text).all("script") if e.get("id") == "data"]
    return json.loads(data, parse_constant=pytest.fail)


def shown(data):
    """The points (T, N, 3) that the script draws."""
    flat = np.frombuffer(base64.b64decode(data["points"]), "<f4")
    return flat.reshape(data["frames"], len(data["joints"]), 3)


# ---------------------------------------------------------------------- the page


def test_page_holds_the_motion_with_y_up(result):
    data = scene(player(result))
    points = result.points.numpy()
    upright = np.stack([points[..., 0], points[..., 2], -points[..., 1]], -1)
    upright -= np.median(upright, axis=(0, 1))
    assert np.allclose(shown(data), upright, atol=1e-4 * np.abs(upright).max())
    assert (data["frames"], data["fps"], data["clock"]) == (12, 25.0, True)
    assert data["joints"] == list(result.skeleton.joints)


def test_page_needs_no_network(result):
    text = player(result)
    page = Page(text)
    assert not [e for e in page.elements if "src" in e or "href" in e]
    assert "@@" not in re.sub(r"<script>.*?</script>", "", text, flags=re.DOTALL)
    assert any("Plotly" in e["text"] and len(e["text"]) > 10**6 for e in page.all("script"))
    for control in ("play", "slider", "mirror", "follow", "speed", "plot"):
        assert [e for e in page.elements if e.get("id") == control], control


def test_page_has_the_bones_of_each_side(result):
    bones = scene(player(result))["bones"]
    body = result.skeleton
    assert sorted(tuple(b) for side in bones.values() for b in side) == sorted(body.bones)
    assert [body.index("left_knee"), body.index("left_ankle")] in bones["left"]
    assert [body.index("right_hip"), body.index("right_knee")] in bones["right"]
    assert all("left" not in body.joints[i] and "right" not in body.joints[i] for b in bones["centre"] for i in b)


def test_the_box_stays_over_the_clip_and_in_the_mirror(result):
    data = scene(player(result))
    points = shown(data)
    for image in (points, points * [1, -1, 1]):
        assert (image >= data["fixed"]["low"]).all()
        assert (image <= data["fixed"]["high"]).all()
    centres = np.frombuffer(base64.b64decode(data["centres"]), "<f4").reshape(-1, 1, 3)
    assert (points - centres >= data["follow"]["low"]).all()
    assert (points - centres <= data["follow"]["high"]).all()
    assert data["fixed"]["ground"] == pytest.approx(points[..., 2].min(), abs=1e-3)


def test_lost_points_do_not_shrink_the_body(result):
    points = torch.cat([result.points] * 20)
    tracks = replace(
        result.tracks, points=torch.cat([result.tracks.points] * 20), weights=torch.cat([result.tracks.weights] * 20)
    )
    many = replace(result, points=points, tracks=tracks)
    plain = scene(player(many))["fixed"]
    points = points.clone()
    points[3, 4] = 1e7
    far = scene(player(replace(many, points=points)))["fixed"]
    size = np.subtract(plain["high"], plain["low"])
    assert (np.subtract(far["high"], far["low"]) < 2 * size.max()).all()


def test_small_motion_far_from_the_origin_is_kept(result):
    far = replace(result, points=result.points + 1e9)
    near = shown(scene(player(result)))
    assert np.allclose(shown(scene(player(far))), near, atol=1e-3 * np.abs(near).max())


def test_names_from_files_are_text_and_not_markup(result):
    body = replace(result.skeleton, joints=(EVIL, *result.skeleton.joints[1:]))
    notes = replace(result.diagnostics, notes=(EVIL,))
    tracks = replace(result.tracks, skeleton=body, source=EVIL.replace("/", ":"))
    text = player(replace(result, tracks=tracks, method=EVIL, diagnostics=notes))
    page, clean = Page(text), Page(player(result))
    assert [e["tag"] for e in page.elements if e["tag"] != "li"] == [
        e["tag"] for e in clean.elements if e["tag"] != "li"
    ]
    assert any(EVIL in e["text"] for e in page.all("li"))
    label = scene(text)["joints"][0]  # plotly takes tags in its labels for markup
    assert "<" not in label
    assert "&lt;img" in label


def test_title_and_summary_are_on_the_page(result):
    page = Page(player(result))
    assert page.all("title")[0]["text"] == "SfAM: walk.npz"
    assert summarise(result) in [e["text"] for e in page.all("p")]
    assert {"é <b>", "made for a test"} <= {e["text"] for e in page.all("li")}
    assert Page(player(result, title="A & B")).all("title")[0]["text"] == "A & B"


def test_a_template_value_that_looks_like_a_key_stays(result):
    assert Page(player(result, title="@@DATA@@")).all("title")[0]["text"] == "@@DATA@@"


@pytest.mark.parametrize("view", [player, sheet])
def test_nothing_finite_is_told(result, view):
    with pytest.raises(OutputError, match="finite"):
        view(replace(result, points=torch.full_like(result.points, torch.nan)))


@pytest.mark.parametrize("view", [player, sheet])
def test_unusual_motions_can_be_seen(result, view):
    still = replace(result, points=torch.zeros_like(result.points))
    gaps = result.points.clone()
    gaps[2] = torch.nan
    gaps[:, 3] = torch.nan
    gaps[4, 5, 2] = torch.inf
    one = replace(
        result,
        points=result.points[:1],
        tracks=replace(result.tracks.frames(0, 1), fps=None),
    )
    loose = Skeleton.from_edges([], result.skeleton.num_joints, tree=False)
    dots = replace(result, tracks=replace(result.tracks, skeleton=loose))
    blind = replace(result, tracks=replace(result.tracks, weights=torch.zeros_like(result.tracks.weights)))
    for odd in (still, replace(result, points=gaps), one, dots, blind, replace(result, points=result.points * 1e-12)):
        assert view(odd)


# ---------------------------------------------------------------------- the sheet


def test_sheet_shows_three_rows_of_frames(result):
    figure = sheet(result, frames=5)
    assert len(figure.axes) == 15
    titles = [a.get_title() for a in figure.axes if a.get_title()]
    assert titles == [
        "frame 0 (0.00 s)",
        "frame 3 (0.12 s)",
        "frame 6 (0.24 s)",
        "frame 8 (0.32 s)",
        "frame 11 (0.44 s)",
    ]
    assert len(sheet(result, frames=50).axes) == 3 * 12  # no frame twice


def test_sheet_draws_bones_in_the_colours_of_their_sides(result):
    from matplotlib.colors import to_hex

    (lines,) = sheet(result, frames=2).axes[2].collections[:1]
    wanted = sorted(COLOURS[bone_side(result.skeleton, b)] for b in range(result.skeleton.num_bones))
    assert sorted(to_hex(c) for c in lines.get_colors()) == wanted


def test_sheet_leaves_out_what_is_unseen(result):
    tracks, full = (sheet(result, frames=1).axes[i].collections[0] for i in (0, 1))
    seen = result.tracks.seen[0].tolist()
    assert len(full.get_segments()) == result.skeleton.num_bones
    assert len(tracks.get_segments()) == sum(seen[a] and seen[b] for a, b in result.skeleton.bones)
    assert not all(seen)


def test_sheet_has_y_down_and_equal_axes(result):
    for axis in sheet(result, frames=2).axes:
        low, high = axis.get_ylim()
        assert low > high
        assert axis.get_aspect() == 1


def test_sheet_is_written_as_a_picture(tmp_path, result):
    from matplotlib.image import imread

    picture = imread(save(result, tmp_path / "s.png"))
    assert picture.shape[0] > 300
    assert picture.shape[1] > 300
    assert len(np.unique(picture[..., :3].reshape(-1, 3), axis=0)) > 20


def test_sheet_opens_no_window_and_keeps_no_state(result):
    before = "matplotlib.pyplot" in sys.modules
    sheet(result)
    assert ("matplotlib.pyplot" in sys.modules) == before


def test_too_few_frames_are_told(result):
    with pytest.raises(OptionError, match="frames: expected at least 1, got 0"):
        sheet(result, frames=0)


# ---------------------------------------------------------------------- both


@pytest.mark.parametrize(
    ("view", "module", "package"),
    [(player, "plotly.offline", "plotly"), (sheet, "matplotlib.figure", "matplotlib")],
)
def test_a_missing_package_is_told(result, monkeypatch, view, module, package):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(OutputError, match=f"pip install {package}"):
        view(result)


def test_summary_leaves_out_what_is_unknown(result):
    words = summarise(result)
    assert words.startswith("12 frames at 25 a second · skeleton coco17 · viewpoint turn 12°")
    assert "bone variation" not in words  # NaN
    assert words.endswith("not converged after 80 iterations")


def test_sides_are_told_apart_by_the_colour_blind():
    """Under a simulation of the two common red-green deficiencies the two colours stay far apart."""
    rgb = np.array([[int(COLOURS[s][i : i + 2], 16) / 255 for i in (1, 3, 5)] for s in ("left", "right")]) ** 2.2
    protan = np.array([[0.152, 1.053, -0.205], [0.115, 0.786, 0.099], [-0.004, -0.048, 1.052]])
    deutan = np.array([[0.367, 0.861, -0.228], [0.280, 0.673, 0.047], [-0.012, 0.043, 0.969]])
    for simulation in (protan, deutan):
        left, right = np.clip(rgb @ simulation.T, 0, 1) ** (1 / 2.2)
        assert np.linalg.norm(left - right) > 0.3


@pytest.mark.parametrize("name", ["body25", "mediapipe33", "h36m17"])
def test_both_sides_have_bones(name):
    body = SKELETONS[name]
    sides = [bone_side(body, b) for b in range(body.num_bones)]
    assert sides.count("left") == sides.count("right") > 0
