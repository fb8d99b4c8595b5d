"""Pictures that show which joint is which."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from matplotlib.colors import to_hex

from kcs_torch.errors import OptionError
from kcs_torch.skeleton import SKELETONS, Skeleton
from kcs_torch.types import Tracks
from kcs_torch.viewer import draw_skeleton, draw_tracks
from kcs_torch.viewer.colours import COLOURS
from kcs_torch.viewer.draw import clearest_frame
from kcs_torch.viewer.layout import flat_layout

EVIL = "$x^{2$ <script>\n" + "long " * 30


def tracks(num_frames=5, *, at=(0.0, 0.0), blind=(), skeleton="body25"):
    """A person who stands still in their template pose; nothing is seen in the blind frames."""
    body = SKELETONS[skeleton]
    points = 300 * body.template_points(dtype=torch.float64)[None, : body.num_observed, :2] + torch.tensor(at)
    points = points.repeat(num_frames, 1, 1)
    confidence = torch.ones(points.shape[:2], dtype=torch.float64)
    confidence[list(blind)] = 0
    return Tracks.from_arrays(points, confidence, skeleton=body, source="clip.json")


def names(axis):
    return {t.get_text(): t for t in axis.texts if t.get_text()}


def overlaps(texts, figure):
    renderer = figure.canvas.get_renderer()
    boxes = [t.get_window_extent(renderer) for t in texts]
    return sum(a.overlaps(b) for k, a in enumerate(boxes) for b in boxes[:k])


def test_every_seen_joint_has_its_number_and_name_beside_it():
    one = tracks()
    weights = one.weights.clone()
    weights[:, 4] = 0
    figure = draw_tracks(replace(one, weights=weights))
    (axis,) = figure.axes
    body = one.skeleton
    assert set(names(axis)) == {f"{j} {n}" for j, n in enumerate(body.joints) if j != 4}
    assert axis.get_xlabel() == "unseen: RWrist"
    assert axis.get_title() == "24 of 25 joints seen"
    places = axis.transData.transform(one.points[0].numpy())
    for label, text in names(axis).items():
        j = int(label.split()[0])
        spot = axis.transData.transform(text.get_position())
        nearest = np.linalg.norm(places - spot, axis=1).argmin()
        beside = np.linalg.norm(places[j] - spot) < 90 * figure.dpi / 72
        assert nearest == j or beside, label
        assert to_hex(text.get_color()) == COLOURS[body.side(j)]


@pytest.mark.parametrize("name", list(SKELETONS))
def test_names_of_a_skeleton_do_not_cover_each_other(name):
    body = SKELETONS[name]
    figure = draw_skeleton(body)
    found = names(figure.axes[0])
    assert len(found) == body.num_joints
    assert overlaps(list(found.values()), figure) == 0
    frame = figure.axes[0].get_window_extent()
    renderer = figure.canvas.get_renderer()
    for label, text in found.items():
        box = text.get_window_extent(renderer)
        assert frame.x0 <= box.x0 and box.x1 <= frame.x1 and frame.y0 <= box.y0 and box.y1 <= frame.y1, label


def test_virtual_joints_are_hollow_and_have_no_number():
    body = SKELETONS["coco17"]
    figure = draw_skeleton(body)
    (dots,) = [c for c in figure.axes[0].collections if len(c.get_offsets()) == body.num_joints]
    hollow = [to_hex(c) == "#ffffff" for c in dots.get_facecolors()]
    assert hollow == [j >= body.num_observed for j in range(body.num_joints)]
    assert {"neck", "pelvis", "0 nose"} <= set(names(figure.axes[0]))
    assert "17 joints, 2 virtual (hollow)" in figure.get_suptitle()


def test_a_frame_in_which_the_body_is_seen_is_drawn():
    late = tracks(8, blind=[0, 1, 2])
    assert clearest_frame([late]) == 3
    assert "frame 3 of 8" in draw_tracks(late).get_suptitle()
    assert clearest_frame([tracks(8, blind=[0]), late]) == 3  # both are there
    weights = late.weights.clone()
    weights[3, :12] = 0  # half of the body only
    assert clearest_frame([replace(late, weights=weights)]) == 4
    assert "frame 6 of 8" in draw_tracks(late, frame=6).get_suptitle()
    assert names(draw_tracks(late, frame=0).axes[0]) == {}


def test_several_people_are_drawn_together_and_one_by_one():
    people = [tracks(at=(600.0 * k, 0.0)) for k in range(5)] + [tracks(blind=[0, 1])]
    figure = draw_tracks(people)
    assert len(figure.axes) == 4
    assert list(names(figure.axes[0])) == [f"person {k}" for k in range(6)]
    assert [a.get_title().split(":")[0] for a in figure.axes[1:]] == ["person 0", "person 1", "person 2"]
    assert names(draw_tracks(people, frame=0).axes[0]).keys() == {f"person {k}" for k in range(5)}


def test_of_people_with_hands_one_has_names_and_fingers_have_numbers():
    figure = draw_tracks([tracks(skeleton="wholebody63"), tracks(at=(900, 0), skeleton="wholebody63")])
    together, alone = figure.axes
    assert set(names(together)) == {"person 0", "person 1"}
    said = set(names(alone))
    body = SKELETONS["wholebody63"]
    assert {f"{body.index(joint)} {joint}" for joint in ("left_shoulder", "right_knee")} | {"neck"} <= said
    fingers = {j for j, joint in enumerate(body.joints) if "finger" in joint or "thumb" in joint}
    assert {str(j) for j in fingers} <= said and overlaps(list(names(alone).values()), figure) <= 2


def test_y_is_down_and_both_axes_have_one_scale():
    axis = draw_tracks(tracks()).axes[0]
    low, high = axis.get_ylim()
    assert low > high
    unit = axis.transData.transform([[1, 0], [0, 1]]) - axis.transData.transform([0, 0])
    assert abs(unit[0, 0]) == pytest.approx(abs(unit[1, 1]))


@pytest.mark.parametrize("edges", [[], [(0, 1), (1, 2), (2, 0)], [(0, 1), (2, 3)]])
def test_any_graph_can_be_laid_out(edges):
    body = Skeleton.from_edges(edges, 4, tree=False)
    places = flat_layout(body)
    gaps = np.linalg.norm(places[:, None] - places, axis=-1) + 9 * np.eye(4)
    assert np.isfinite(places).all()
    assert gaps.min() > 0.3
    assert len(names(draw_skeleton(body).axes[0])) == 4


def test_left_is_left_without_a_template():
    body = Skeleton.from_names(["hip", "left_knee", "right_knee"], [("hip", "left_knee"), ("hip", "right_knee")])
    body = replace(body, template=None, proportions=None)
    x = flat_layout(body)[:, 0]
    assert x[1] > x[0] > x[2]  # as in a body that faces the viewer


def test_odd_names_are_drawn_as_text(tmp_path):
    body = replace(SKELETONS["body25"], joints=(EVIL, *SKELETONS["body25"].joints[1:]))
    one = replace(tracks(), skeleton=body, source=EVIL)
    for figure in (draw_tracks(one), draw_skeleton(replace(body, name=EVIL))):
        figure.savefig(tmp_path / "a.png")
        (label,) = [n for n in names(figure.axes[0]) if n.startswith("0 $x^{2$")]
        assert len(label) <= 40
        assert "\n" not in label


def test_wrong_frames_are_told():
    with pytest.raises(OptionError, match="expected a frame from 0 to 4, got 5"):
        draw_tracks(tracks(), frame=5)
    with pytest.raises(OptionError, match="at least one person"):
        draw_tracks([])
    with pytest.raises(OptionError, match="expected Tracks, got ndarray"):
        draw_tracks(np.zeros((3, 17, 2)))


def test_what_is_no_frame_and_a_skeleton_by_its_name():
    with pytest.raises(OptionError, match="expected a frame from 0 to 0, got 0.5"):
        draw_tracks(Tracks.from_arrays(torch.rand(1, 17, 2), skeleton="h36m17"), frame=0.5)
    assert draw_skeleton("coco17").axes
