"""The player page and the sheet of key frames."""

import base64
import itertools
import json
import sys
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
import torch
from samples import walk_result

from kcs_torch.errors import OptionError, OutputError
from kcs_torch.io import save
from kcs_torch.reconstruct import reconstruct
from kcs_torch.skeleton import SKELETONS, Skeleton
from kcs_torch.types import Diagnostics, Intrinsics, Reconstruction, Tracks
from kcs_torch.viewer import player, sheet
from kcs_torch.viewer.colours import COLOURS, bone_keys, bone_side, joint_keys
from kcs_torch.viewer.film import Film
from kcs_torch.viewer.names import as_people
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


def unpack(part):
    """What the script makes of an array."""
    raw = base64.b64decode(part["data"])
    values = np.frombuffer(raw, {"i2": "<i2", "f4": "<f4", "u1": "u1"}[part["kind"]])
    return np.where(values == -32768, np.nan, values * part["step"]) if part["kind"] == "i2" else values


def shown(data, solution=0, person=0):
    """The points (T, N, 3) that the script draws, about the scene's middle."""
    one = data["people"][person]
    motion = one["solutions"][solution]
    centres = unpack(motion["centres"]).reshape(one["frames"], 1, 3)
    return unpack(motion["points"]).reshape(one["frames"], len(one["joints"]), 3) + centres


def two_people(result):
    """The same person twice, the second beside the first and for half as long."""
    half = result.tracks.frames(0, 6)
    other = replace(result, points=result.points[:6] + 1, tracks=replace(half, points=half.points + 1))
    return [result, replace(other, scales=result.scales[:6], uncertainty=None)]


def doubtful(result, doubt="depth is <little> more than a guess: it hardly turns. It should"):
    return replace(result, diagnostics=replace(result.diagnostics, notes=(doubt,), doubt=doubt))


# ---------------------------------------------------------------------- the page


def test_page_holds_the_motion(result):
    data = scene(player(result))
    points = result.points.numpy()
    middle = np.median(points, axis=(0, 1))
    assert np.allclose(data["middle"], middle)
    assert np.allclose(shown(data), points - middle, atol=1e-4 * np.ptp(points))
    assert (data["total"], data["step"], data["fps"]) == (12, 1, 25.0)
    assert data["people"][0]["joints"] == list(result.skeleton.joints)
    spread = unpack(data["people"][0]["solutions"][0]["spread"]).reshape(12, -1)
    assert np.allclose(spread, result.uncertainty, atol=1e-4 * float(result.uncertainty.max()))


def test_tensors_that_need_gradients_are_shown_as_they_are(result):
    grown = {name: getattr(result, name).clone().requires_grad_() for name in ("points", "uncertainty")}
    tracks = replace(result.tracks, points=result.tracks.points.clone().requires_grad_())
    assert scene(player(replace(result, tracks=tracks, **grown))) == scene(player(result))


def test_page_needs_no_network_and_is_small(result):
    text = player(result)
    assert len(text) < 70_000
    page = Page(text)
    assert not [e for e in page.elements if "src" in e or "href" in e]
    assert "@@" not in text
    for control in ("play", "slider", "mirror", "follow", "walk", "bars", "names", "speed", "person", "solution"):
        assert [e for e in page.elements if e.get("id") == control], control


def test_page_has_the_bones_of_each_side(result):
    bones = scene(player(result))["people"][0]["bones"]
    body = result.skeleton
    assert [tuple(b[:2]) for b in bones] == list(body.bones)
    assert [body.index("left_knee"), body.index("left_ankle"), "left"] in bones
    assert [body.index("right_hip"), body.index("right_knee"), "right"] in bones
    middle = [body.joints[i] for a, b, key in bones for i in (a, b) if key == "centre"]
    assert not [name for name in middle if "left" in name or "right" in name]


def test_tracks_are_shown_where_they_are_seen(result):
    data = scene(player(result))["people"][0]
    seen = result.tracks.seen.numpy()
    tracks = unpack(data["tracks"]).reshape(*seen.shape, 2)
    assert (np.isfinite(tracks).all(-1) == seen).all()
    given = result.tracks.points.numpy()[seen]
    assert np.allclose(tracks[seen], given - np.median(given, axis=0), atol=1e-3 * np.ptp(given))
    assert ((unpack(data["weights"]).reshape(seen.shape) > 0) == seen).all()


def test_the_projection_lies_on_the_tracks(result):
    """Scale and shift of each frame take the points onto the tracks, as far as those of the result do."""
    data = scene(player(result))
    one = data["people"][0]
    fit = unpack(one["solutions"][0]["fit"]).reshape(-1, 1, 3)
    drawn = fit[..., :1] * shown(data)[..., :2] + fit[..., 1:]
    seen = result.tracks.seen.numpy()
    tracks = unpack(one["tracks"]).reshape(*seen.shape, 2)
    gap = np.where(seen[..., None], tracks - drawn, 0)
    weighted = (result.tracks.weights.numpy()[..., None] * gap).sum(1)
    assert np.allclose(weighted, 0, atol=1e-3 * np.nanmax(np.abs(tracks)))


def test_before_a_known_lens_the_projection_is_a_pinholes(result):
    distance = torch.full((12,), 5 * float(result.points.abs().max()), dtype=torch.float64)
    space = result.points + torch.nn.functional.pad(distance[:, None, None], (2, 0))
    image = space[..., :2] / space[..., 2:] * torch.tensor([900.0, 1100.0]) + torch.tensor([320.0, 240.0])
    near = replace(result, distance=distance, tracks=replace(result.tracks, points=image))
    data = scene(player(near))
    middle = np.median(image.numpy()[result.tracks.seen.numpy()], axis=0)
    best = data["people"][0]["solutions"][0]
    assert np.allclose(best["lens"], [900, 1100, 320 - middle[0], 240 - middle[1]], rtol=1e-6, atol=1e-3)
    assert np.allclose(unpack(best["path"]), distance)


def test_people_before_lenses_of_their_own_stand_as_in_the_image(result):
    """Each a metre from a lens whose principal point is the middle of what it sees, in millimetres or metres."""
    distance = torch.full((12,), 2000.0, dtype=torch.float64)

    def seen_at(x, y, units=1.0):
        lens = Intrinsics(1000.0, 1000.0, x, y)
        space = result.points + torch.nn.functional.pad(distance[:, None, None], (2, 0))
        tracks = replace(result.tracks, points=lens.project(space))
        return replace(result, points=units * result.points, distance=units * distance, intrinsics=lens, tracks=tracks)

    one, other, small = seen_at(100, 200), seen_at(700, 250), seen_at(700, 250, 1e-3)
    data = scene(player([one, other]))
    shifts = [p["shift"] for p in data["people"]]
    assert np.allclose(shifts, [[200, 400, 0], [1400, 500, 0]])  # a pixel is two units wide there
    apart = shown(data, person=1) - shown(data, person=0)
    assert np.allclose(apart, [1200, 100, 0], atol=1e-3 * np.ptp(result.points.numpy()))
    film = Film([one, other], 1.0)
    assert np.allclose(film.points[1] - film.points[0], [1200, 100, 0])
    assert scene(player([one, small]))["people"][1]["shift"] == pytest.approx([1.4, 0.5, 0])
    for people in ([other], [other, other]):
        assert all(p["shift"] == [0, 0, 0] for p in scene(player(people))["people"])
    assert scene(player([result, other]))["people"][0]["shift"] == [0, 0, 0]
    told = [any("side by side" in e["text"] for e in Page(player([one, k])).all("li")) for k in (other, one)]
    assert told == [True, False]


def test_lost_points_do_not_cost_the_body_its_digits(result):
    points = torch.cat([result.points] * 20)
    tracks = replace(
        result.tracks, points=torch.cat([result.tracks.points] * 20), weights=torch.cat([result.tracks.weights] * 20)
    )
    points[3, 4] = 1e7
    many = replace(result, points=points, tracks=tracks, scales=torch.cat([result.scales] * 20), uncertainty=None)
    body = shown(scene(player(many)))[20:32]
    points = result.points.numpy()
    body = np.roll(body, -4, axis=0)  # 20 = 12 + 8
    assert np.allclose(np.diff(body, axis=1), np.diff(points, axis=1), atol=2e-3 * np.ptp(points))


def test_small_motion_far_from_the_origin_is_kept(result):
    far = replace(result, points=result.points + 1e9)
    near = shown(scene(player(result)))
    assert np.allclose(shown(scene(player(far))), near, atol=1e-3 * np.abs(near).max())


def test_long_clips_show_every_nth_frame_and_say_so(result, monkeypatch):
    monkeypatch.setattr("kcs_torch.viewer.scene.MOST_NUMBERS", 12 * (7 * result.points.shape[1] + 14) // 3)
    text = player(result)
    data = scene(text)
    assert (data["step"], data["total"], data["people"][0]["frames"]) == (3, 12, 4)
    third = result.points[::3].numpy()
    assert np.allclose(shown(data), third - data["middle"], atol=1e-4 * np.ptp(third))
    assert any("every 3rd frame shown" in e["text"] for e in Page(text).all("p"))


def test_alternatives_are_told_apart(result):
    body = result.skeleton
    arm = result.points.clone()
    arm[:, body.index("left_wrist"), 2] += torch.linspace(0, 50, 12)
    others = (replace(result.mirrored(), objective=3.0), replace(result, points=arm, objective=7.25))
    data = scene(player(replace(result, objective=2.0, alternatives=others)))
    labels = [s["label"] for s in data["people"][0]["solutions"]]
    assert labels == [
        "1 best · objective 2.0",
        "2 mirror image · objective 3.0",
        "3 other depth of left_wrist · objective 7.2",
    ]
    nearly = replace(others[0], points=arm * torch.tensor([1.0, 1.0, -1.0]))
    mirrored = scene(player(replace(result, alternatives=(nearly,))))
    assert mirrored["people"][0]["solutions"][1]["label"].startswith("2 nearly the mirror image")
    assert np.allclose(shown(data, 2)[..., 2], arm[..., 2] - data["middle"][2], atol=1e-4 * np.ptp(arm.numpy()))


def test_several_people_share_a_scene(result):
    people = two_people(result)
    text = player(people)
    data = scene(text)
    assert [p["name"] for p in data["people"]] == ["person 0", "person 1"]
    assert [p["frames"] for p in data["people"]] == [12, 6]
    apart = shown(data, person=1) - shown(data)[:6]
    assert np.allclose(apart, 1, atol=1e-4 * np.ptp(result.points.numpy()))
    assert data["people"][1]["solutions"][0]["spread"] is None
    assert any("behind each other is not known" in e["text"] for e in Page(text).all("li"))
    methods = scene(player([result, replace(result, method="other")]))
    assert [p["name"] for p in methods["people"]] == ["SfAM", "other"]
    assert [p["name"] for p in scene(player(people, names=["a", "b"]))["people"]] == ["a", "b"]


def test_people_of_one_file_are_called_by_their_numbers(result):
    """Also in another order than the file's; what is said of everybody is said once."""
    several = [
        replace(one, tracks=replace(one.tracks, source=f"shots/walk.json, person {number}"))
        for number, one in zip((2, 0), two_people(result), strict=True)
    ]
    text = player(several)
    assert [p["name"] for p in scene(text)["people"]] == ["person 2", "person 0"]
    assert Page(text).all("title")[0]["text"] == "SfAM: walk.json"
    assert Page(player(several[0])).all("title")[0]["text"] == "SfAM: walk.json, person 2"
    told = [e["text"] for e in Page(text).all("li")]
    assert [note for note in told if "made for a test" in note] == ["everybody: made for a test"]


def test_people_of_no_clip_are_told(result):
    other = replace(result, tracks=replace(result.tracks, fps=50.0))
    with pytest.raises(OptionError, match="people of one clip, got frame rates"):
        player([result, other])
    with pytest.raises(OptionError, match="at least one result"):
        player([])
    with pytest.raises(OptionError, match="expected 1 names, got 2"):
        player(result, names=["a", "b"])


@pytest.mark.parametrize("view", [player, lambda people: Film(as_people(people, "film"), 1.0)])
def test_people_in_several_units_are_told_or_shown_in_the_first_ones(result, view):
    ours = result.scaled(units="m", factor=1e-3)
    theirs = ours.scaled(units="mm", factor=1e3)
    made = view([ours, theirs])
    if isinstance(made, str):
        data = scene(made)
        assert data["units"] == "m"
        assert np.allclose(shown(data), shown(data, person=1), atol=1e-6)
    else:
        assert np.allclose(*made.points)
    with pytest.raises(OptionError, match="everybody in one unit of length, got m and px .*--scale"):
        view([ours, replace(result, units="px")])


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
    assert scene(text)["people"][0]["joints"][0] == EVIL  # the script draws names as text
    assert text.count("</script") == player(result).count("</script")


def test_title_and_summary_are_on_the_page(result):
    page = Page(player(result))
    assert page.all("title")[0]["text"] == "SfAM: walk.npz"
    assert summarise(result) in [e["text"] for e in page.all("p")]
    assert any("up is the camera's" in e["text"] for e in page.all("small"))
    assert {"é <b>", "made for a test"} <= {e["text"] for e in page.all("li")}
    assert Page(player(result, title="A & B")).all("title")[0]["text"] == "A & B"
    with pytest.raises(OptionError, match="title: expected text or none, got 5"):
        player(result, title=5)


def test_a_page_can_be_written_whatever_bytes_a_files_name_holds(result):
    tracks = replace(result.tracks, source="walk\udcff.npz", notes=("walk\udcff.npz: read",))
    assert "walk?.npz: read" in player(replace(result, tracks=tracks)).encode().decode()


def test_doubts_are_in_the_head_of_the_page(result):
    def told(people):
        return [e["text"] for e in Page(player(people)).all("p") if e.get("class") == "doubt"]

    assert told(result) == []
    assert told(doubtful(result)) == ["depth is <little> more than a guess: it hardly turns. It should"]
    both = [doubtful(one) for one in two_people(result)]
    assert told(both) == ["depth is <little> more than a guess: person 0, person 1"]
    assert told([result, both[1]]) == ["depth is <little> more than a guess: person 1"]


def test_a_template_value_that_looks_like_a_key_stays(result):
    assert Page(player(result, title="@@DATA@@")).all("title")[0]["text"] == "@@DATA@@"


@pytest.mark.parametrize("view", [player, sheet])
def test_nothing_finite_is_told(result, view):
    with pytest.raises(OutputError, match="finite"):
        view(replace(result, points=torch.full_like(result.points, torch.nan)))


@pytest.mark.filterwarnings("error")
def test_numbers_beyond_single_precision_are_told(result):
    assert "<html" in player(replace(result, points=result.points / result.points.abs().max() * 1e29))
    with pytest.raises(OutputError, match=r"walk.* coordinates up to 1e\+30, got .*e\+302"):
        player(replace(result, points=result.points * 1e300))


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


@pytest.mark.filterwarnings("ignore::kcs_torch.KcsWarning")
def test_labels_of_flat_bodies_stay_beside_their_pictures():
    joints = [f"s{i}" for i in range(8)]
    snake = Skeleton.from_names(joints, list(itertools.pairwise(joints)))
    along, time = torch.arange(8.0), torch.linspace(0, 6, 20)[:, None]
    points = torch.stack([100 * along.expand(20, 8), 10 * (along + time).sin()], -1)
    figure = sheet(reconstruct(points, skeleton=snake, method="sfam", fps=30))
    figure.canvas.draw()
    named = [axis for axis in figure.axes if axis.get_ylabel()]
    assert [axis.get_ylabel().split()[0].rstrip(",") for axis in named[:3]] == ["tracks", "3D", "3D"]
    for axis in named:
        assert axis.yaxis.label.get_window_extent().height < axis.get_window_extent().height, axis.get_ylabel()


def test_sheet_tells_doubts(result):
    assert sheet(result)._suptitle.get_text().endswith("not converged after 80 iterations")
    assert sheet(doubtful(result))._suptitle.get_text().endswith("\ndepth is <little> more than a guess")


def test_sheet_shows_frames_in_which_the_body_is_seen(result):
    weights = result.tracks.weights.clone()
    weights[[0, 1, 6, 11]] = 0
    part = replace(result, tracks=replace(result.tracks, weights=weights))
    titles = [a.get_title().split(" (")[0] for a in sheet(part, frames=3).axes[:3]]
    assert titles == ["frame 2", "frame 7", "frame 10"]
    assert len(sheet(replace(part, tracks=replace(part.tracks, weights=0 * weights)), frames=3).axes) == 9


def test_sheet_of_wide_bodies_goes_on_below(result):
    turned = replace(
        result,
        points=result.points[..., [1, 0, 2]],
        tracks=replace(result.tracks, points=result.tracks.points[..., [1, 0]]),
    )
    for one, columns in ((result, 7), (turned, 4)):
        figure = sheet(one, frames=7)
        assert len(figure.axes) == 3 * 7
        assert figure.axes[0].get_gridspec().ncols == columns
        width, height = figure.get_size_inches()
        assert 0.8 < width / height < 2
        figure.canvas.draw()
        boxes = [a.get_window_extent() for a in figure.axes]
        used = sum(box.width * box.height for box in boxes) / figure.bbox.width / figure.bbox.height
        assert used > 0.55, used


def test_sheet_draws_bones_in_the_colours_of_their_sides(result):
    from matplotlib.colors import to_hex

    (lines,) = sheet(result, frames=2).axes[2].collections[:1]
    wanted = sorted(COLOURS[key] for key in bone_keys(result.skeleton))
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
    with pytest.raises(OptionError, match="frames: expected a whole number, at least 1, got 0"):
        sheet(result, frames=0)


# ---------------------------------------------------------------------- both


def test_summary_leaves_out_what_is_unknown(result):
    words = summarise(result)
    assert words.startswith("12 frames at 25 a second · skeleton coco17 · viewpoint turn 12°")
    assert "bone variation" not in words  # NaN
    assert words.endswith("not converged after 80 iterations")


def test_summary_tells_nothing_of_time_of_a_single_image():
    words = summarise(walk_result(1))
    assert words.startswith("1 frame") and "turn" not in words and "variation" not in words


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


def test_fingers_have_a_colour_each():
    hand = SKELETONS["hand21"]
    keys, ends = bone_keys(hand), joint_keys(hand)
    fingers = {j.split("_")[0]: ends[k] for k, j in enumerate(hand.joints) if j.endswith("tip")}
    assert len(set(fingers.values())) == 5
    assert ends[hand.index("wrist")] == "centre"
    assert set(keys) == set(fingers.values())


def test_pages_are_bounded():
    """Many joints, or many frames of few joints: no more than is told."""
    for frames, joints in ((4000, 133), (60_000, 3)):
        body = Skeleton.from_edges([(i, i + 1) for i in range(joints - 1)], joints)
        points = torch.randn(frames, joints, 3, generator=torch.Generator().manual_seed(0))
        tracks = Tracks.from_arrays(points[..., :2], skeleton=body, source="long.npz")
        facts = Diagnostics(0.0, 0.0, 0.0, 0.0, True, 1)
        eye = torch.eye(3)[None, :2].expand(frames, 2, 3)
        long = Reconstruction(points, eye, torch.ones(frames), torch.ones(joints - 1), tracks, "any", facts)
        text = player(replace(long, alternatives=(long, long)))
        assert 4e6 < len(text) < 9e6
        assert "frame shown" in text


def test_each_solution_is_drawn_along_its_own_path(result):
    other = replace(result, root_depth=torch.linspace(0, 5, 12).double())
    best = replace(result, root_depth=torch.linspace(0, 1, 12).double(), alternatives=(other,))
    solutions = scene(player(best))["people"][0]["solutions"]
    assert [unpack(one["path"])[-1] for one in solutions] == pytest.approx([1, 5])
