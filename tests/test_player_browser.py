"""The player in a real browser: it starts, plays, and does what its switches say."""

from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest
import torch
from browser import Browser, find_chromium
from matplotlib.image import imread
from samples import walk_result

from kcs_torch.skeleton import Skeleton
from kcs_torch.types import Intrinsics
from kcs_torch.viewer import player

EVIL = '</script><script>document.title = "ran"</script><img src=x onerror="document.title = 1">'


@pytest.fixture(scope="module")
def browser():
    program = find_chromium()
    if program is None:
        pytest.skip("needs Chromium (Debian: apt-get install chromium)")
    try:
        tab = Browser(program)
    except (OSError, RuntimeError) as error:
        pytest.skip(f"{program} does not start here: {error}")
    yield tab
    tab.close()


@pytest.fixture(scope="module")
def result():
    walk = walk_result(40)
    root = torch.linspace(0, 300, 40, dtype=torch.float64)
    other = replace(walk.mirrored(), objective=3.0)
    return replace(walk, root_depth=root, objective=2.0, alternatives=(other,))


@pytest.fixture
def page(browser, result, tmp_path):
    """A page that is open; no error may have come up when the test ends."""

    def show(results, **window):
        path = tmp_path / "page.html"
        path.write_text(player(results), encoding="utf-8")
        browser.open(path, **window)
        return browser

    yield show
    assert browser.errors == []


def click(browser, name):
    browser.run(f"document.getElementById('{name}').click()")
    browser.settle()


def choose(browser, name, value):
    browser.run(
        f"(e => {{ e.value = {value!r}; e.dispatchEvent(new Event('change')) }})(document.getElementById('{name}'))"
    )
    browser.settle()


def joints(browser, person=0):
    return np.array(browser.run(f"player.joints({person})")).reshape(-1, 3)


def picture(browser, canvas="space"):
    """What is on a canvas, (H, W, 3) in 0..1."""
    box = browser.run(f"document.getElementById('{canvas}').getBoundingClientRect().toJSON()")
    whole = imread(BytesIO(browser.picture()), format="png")[..., :3]
    x, y = round(box["x"]), round(box["y"])
    return whole[y : y + int(box["height"]), x : x + int(box["width"])]


def share(image, colour, tolerance=0.25):
    rgb = np.array([int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)])
    return float((np.abs(image - rgb).max(-1) < tolerance).mean())


def hidden(browser, name):
    return browser.run(f"document.getElementById('{name}').hidden")


@pytest.mark.parametrize(("width", "height", "mobile"), [(1280, 720, False), (390, 844, True)])
def test_both_pictures_show_both_sides(page, result, width, height, mobile):
    browser = page(result, width=width, height=height, mobile=mobile)
    for canvas in ("space", "image"):
        drawn = picture(browser, canvas)
        assert share(drawn, "#0072b2") > 2e-4, canvas
        assert share(drawn, "#d55e00") > 2e-4, canvas
        assert share(drawn, "#ffffff", 0.05) > 0.5, canvas
    assert browser.run("document.documentElement.scrollWidth") <= width  # nothing sticks out at the side
    charts = browser.run("[...document.querySelectorAll('.chart canvas')].map(c => c.width * c.height)")
    assert min(charts) > 0


def test_headings_show_their_figures_in_full_beside_the_picture(page):
    walk = walk_result(40, skeleton="coco17")
    walk.points[:, 10, 0] += torch.linspace(-90, 90, 40)  # of the right wrist, whose bone has the longest name
    browser = page(walk, width=1200, height=900)
    told = browser.run("[...document.querySelectorAll('h2 output')].map(o => o.textContent).filter(text => text)")
    cut = browser.run("[...document.querySelectorAll('h2 *')].filter(o => o.scrollWidth > o.clientWidth).length")
    assert len(told) == 2 and all(text.startswith("most: ") for text in told)
    assert "right_elbow-right_wrist" in told[0] and cut == 0


def test_a_long_solution_menu_stays_within_a_phone(page, result):
    browser = page(result, width=400, height=844, mobile=True)
    browser.run("document.getElementById('solution').options[1].textContent = '2 other depth of '.repeat(6)")
    browser.settle()
    assert browser.run("document.getElementById('solution').getBoundingClientRect().right") <= 400


def test_lengths_beyond_the_axis_run_along_its_end(page, result):
    points = result.points.clone()
    points[20, 9] *= 50  # for one frame of 40, fewer than the quantile that the axis shows
    browser = page(replace(result, points=points, uncertainty=None))
    drawn = picture(browser, "lengths")
    box = browser.run("document.querySelector('#lengths canvas').getBoundingClientRect().toJSON()")
    whole = browser.run("document.getElementById('lengths').getBoundingClientRect().toJSON()")
    top, left = round(box["y"] - whole["y"]), round(box["x"] - whole["x"]) + 50
    coloured = np.ptp(drawn[:, left:-9], axis=-1) > 0.2
    assert coloured[top + 4 : top + 10].any() and not coloured[top : top + 3].any()


def test_everything_is_on_one_screen(page, result):
    browser = page(result, width=1280, height=720)
    assert browser.run("document.documentElement.scrollHeight") <= 720


def test_pictures_keep_their_shape_when_the_window_changes(page, result):
    browser = page(result)
    shapes = "[...document.querySelectorAll('canvas')].map(c => [c.width, c.height, c.clientWidth, c.clientHeight])"
    before = browser.run(shapes)
    browser.run("document.querySelector('details').open = true")
    browser.settle()
    browser.settle()
    after = browser.run(shapes)
    assert after != before
    assert all(a == c and b == d for a, b, c, d in after)


def test_play_and_pause(page, result):
    browser = page(result)
    before = picture(browser)
    assert browser.run("player.state.frame") == 0
    click(browser, "play")
    assert browser.run("document.getElementById('play').textContent") == "Pause"
    browser.until("player.state.frame >= 5")
    click(browser, "play")
    stopped = browser.run("player.state.frame")
    browser.settle()
    assert browser.run("player.state.frame") == stopped
    assert np.abs(picture(browser) - before).max() > 0.3


def test_scrubbing_shows_the_frame(page, result):
    browser = page(result)
    browser.run("(s => { s.value = 7; s.dispatchEvent(new Event('input')) })(document.getElementById('slider'))")
    browser.settle()
    assert browser.run("document.getElementById('frame').textContent") == "frame 7 of 40 · 0.28 s"
    points = result.points.numpy()
    middle = np.median(points, axis=(0, 1))
    assert np.allclose(joints(browser), points[7] - middle, atol=1e-4 * np.ptp(points))


def test_keys(page, result):
    browser = page(result)
    for key, frame in (("ArrowRight", 1), ("ArrowRight", 2), ("ArrowLeft", 1)):
        browser.key(key)
        assert browser.run("player.state.frame") == frame
    browser.key("ArrowRight", modifiers=8)  # shift
    assert browser.run("player.state.frame") == 11
    browser.key(" ")
    assert browser.run("player.state.playing")
    browser.key(" ")
    assert not browser.run("player.state.playing")
    browser.key("m")
    assert browser.run("player.state.mirror")


def test_the_mirror_flips_depth(page, result):
    browser = page(result)
    before, seen = joints(browser), picture(browser)
    click(browser, "mirror")
    assert np.allclose(joints(browser), before * [1, 1, -1])
    assert np.abs(picture(browser) - seen).max() > 0.3


def test_the_mirror_before_a_lens_is_the_librarys(page, result):
    distance = torch.full((40,), 4 * float(result.points.abs().max()), dtype=torch.float64)
    near = replace(result, distance=distance, root_depth=None, alternatives=())
    browser = page(near)
    click(browser, "mirror")
    points = near.points.numpy()
    wanted = near.mirrored().points[0].numpy() - np.median(points, axis=(0, 1))
    assert np.allclose(joints(browser), wanted, atol=1e-3 * np.ptp(points))


def test_people_before_lenses_of_their_own_stand_side_by_side(page, result):
    """Mirrored about their own lines of sight; and their images stay where they are."""
    far = 4 * float(result.points.abs().max())
    distance = torch.full((40,), far, dtype=torch.float64)
    lens = Intrinsics(far, far, 0.0, 0.0)
    space = result.points + torch.nn.functional.pad(distance[:, None, None], (2, 0))
    people = [
        replace(
            result,
            distance=distance,
            root_depth=None,
            alternatives=(),
            intrinsics=(own := replace(lens, cx=lens.cx + x)),
            tracks=replace(result.tracks, points=own.project(space)),
        )
        for x in (0.0, 900.0)
    ]
    browser = page(people)
    assert np.allclose(joints(browser, 1) - joints(browser, 0), [900, 0, 0], atol=1)
    click(browser, "mirror")
    assert np.allclose(joints(browser, 1) - joints(browser, 0), [900, 0, 0], atol=1)
    click(browser, "mirror")
    first, second = (np.array(browser.run(f"player.image({k})")).reshape(-1, 2) for k in range(2))
    assert np.allclose(second - first, [900, 0], atol=1)


def test_walk_in_space_adds_the_path(page, result):
    browser = page(result)
    first = joints(browser)
    click(browser, "walk")
    apart = joints(browser) - first
    assert np.allclose(apart, [0, 0, -150], atol=0.1)  # the path runs from 0 to 300
    browser.run("player.show(39)")
    walked = joints(browser)
    click(browser, "walk")
    assert np.allclose(walked - joints(browser), [0, 0, 150], atol=0.1)


def test_alternatives_can_be_chosen(page, result):
    browser = page(result)
    before = joints(browser)
    options = browser.run("[...document.getElementById('solution').options].map(o => o.textContent)")
    assert options == ["1 best · objective 2.0", "2 mirror image · objective 3.0"]
    choose(browser, "solution", "1")
    z = joints(browser)[:, 2] + before[:, 2]
    assert np.allclose(z, z[0], atol=1e-3 * np.ptp(before))


def test_several_people(page, result):
    beside = replace(result.tracks, points=result.tracks.points + 400)
    other = replace(result, points=result.points + 400, tracks=beside, uncertainty=None, root_depth=None)
    browser = page([result, other])
    assert not hidden(browser, "pick-person")
    assert not hidden(browser, "spread")
    one = picture(page(result))
    both = picture(page([result, other]))
    assert share(both, "#009e73") > 4 * share(one, "#009e73")  # the second one's trunk
    choose(browser, "person", "1")
    assert hidden(browser, "spread")
    assert np.allclose(joints(browser, 1) - joints(browser, 0), 400, atol=1)


def test_what_is_unknown_is_not_offered(page):
    plain = walk_result(5, uncertain=False)
    browser = page(plain)
    for name in ("pick-person", "pick-solution", "pick-walk", "pick-bars", "spread"):
        assert hidden(browser, name), name
    dots = replace(plain.tracks, skeleton=Skeleton.from_edges([], plain.skeleton.num_joints, tree=False))
    assert hidden(page(replace(plain, tracks=dots)), "lengths")


def test_a_body_that_goes_far_is_followed(page, result):
    browser = page(result)
    assert not browser.run("document.getElementById('follow').checked")
    far = torch.linspace(0, 20 * float(np.ptp(result.points.numpy())), 40, dtype=torch.float64)
    away = replace(result, points=result.points + torch.nn.functional.pad(far[:, None, None], (0, 2)))
    browser = page(away)
    assert browser.run("document.getElementById('follow').checked")
    assert share(picture(browser), "#0072b2") > 2e-4


def test_pointing_tells_the_joints_name(page, result):
    browser = page(result)
    browser.run("document.querySelector('[data-view=camera]').click()")
    browser.settle()
    box = browser.run("document.getElementById('space').getBoundingClientRect().toJSON()")
    spot = next(s for s in browser.run("player.spots()") if s["name"] == "left_ankle")
    browser.mouse("mouseMoved", box["x"] + spot["x"] + 3, box["y"] + spot["y"])
    browser.settle()
    assert not hidden(browser, "tip")
    assert browser.run("document.getElementById('tip').textContent").startswith("left_ankle · ")


def test_dragging_turns_and_the_wheel_zooms(page, result):
    browser = page(result)
    yaw = browser.run("player.state.yaw")
    browser.mouse("mousePressed", 300, 300, button="left", buttons=1)
    browser.mouse("mouseMoved", 400, 300, button="left", buttons=1)
    browser.mouse("mouseReleased", 400, 300, button="left")
    assert browser.run("player.state.yaw") == pytest.approx(yaw - 0.8)
    browser.mouse("mouseWheel", 300, 300, deltaX=0, deltaY=-200)
    browser.settle()
    assert browser.run("player.state.zoom") > 1.1


def test_a_click_on_a_chart_goes_to_the_frame(page, result):
    browser = page(result)
    box = browser.run("document.querySelector('#lengths canvas').getBoundingClientRect().toJSON()")
    x, y = box["x"] + box["width"] - 8, box["y"] + 30
    browser.mouse("mousePressed", x, y, button="left", buttons=1)
    browser.mouse("mouseReleased", x, y, button="left")
    assert browser.run("player.state.frame") == 39


def test_names_from_files_do_not_run(page, result):
    body = replace(result.skeleton, joints=(EVIL, *result.skeleton.joints[1:]))
    told = replace(result.diagnostics, notes=(EVIL,))
    tracks = replace(result.tracks, skeleton=body, source=EVIL.replace("/", ":"), notes=(EVIL,))
    evil = replace(result, tracks=tracks, method=EVIL, alternatives=(), diagnostics=told)
    browser = page([evil, replace(evil, method="b")])
    click(browser, "names")
    assert EVIL in browser.run("document.title")
    assert browser.run("document.images.length") == 0
    assert browser.run("document.scripts.length") == 2


def test_odd_motions_open(page):
    walk = walk_result(6)
    gaps = walk.points.clone()
    gaps[2] = torch.nan
    gaps[:, 3] = torch.nan
    blind = replace(walk.tracks, weights=torch.zeros_like(walk.tracks.weights))
    still = torch.zeros_like(walk.points)
    one = replace(walk, points=walk.points[:1], tracks=walk.tracks.frames(0, 1))
    assert hidden(page(one), "pick-speed")  # a picture is not played
    for odd in (replace(walk, points=gaps), replace(walk, tracks=blind), replace(walk, points=still), one):
        browser = page(odd)
        for name in ("follow", "mirror", "names"):
            click(browser, name)
        browser.run("player.show(3)")
        browser.settle()
