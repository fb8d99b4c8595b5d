"""Batch dimensions of several tensors, as torch has them, and shapes that functions refuse in our words."""

import subprocess
import sys

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from kcs_torch import functional as F
from kcs_torch.errors import ShapeError
from kcs_torch.functional.shapes import broadcast_shapes, check_core

SHAPES = st.lists(st.lists(st.integers(0, 3), max_size=3).map(tuple), max_size=4)


@given(SHAPES)
def test_it_is_that_of_torch(shapes):
    try:
        expected = tuple(torch.broadcast_tensors(*map(torch.empty, shapes))[0].shape) if shapes else ()
    except RuntimeError:
        with pytest.raises(ShapeError, match="batch dimensions: expected sizes that are equal or 1, got "):
            broadcast_shapes(*shapes)
    else:
        assert broadcast_shapes(*shapes) == expected


def test_methods_do_without_the_symbols_of_torch():
    """Its own function of this name loads them, in a third of a second."""
    code = (
        "import sys, kcs_torch as kt\n"
        "clip = kt.data.walking_person(12)\n"
        "for name in ('sfam', 'kcs', 'pkc'): kt.reconstruct(clip.tracks, method=name)\n"
        "print('sympy' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


CLIP, IMAGE, ROWS, TURNS = (torch.rand(2, 5, *core) for core in ((4, 3), (4, 2), (2, 3), (3, 3)))
MASS, WAY = torch.ones(2, 5, 4), torch.rand(2, 5, 3)
# What a function is called with, and for each argument a shape that does not fit.
REFUSED = {
    "angle_between": ({"first": WAY, "second": WAY}, {"first": (), "second": (5, 2)}),
    "back_project": ({"tracks": IMAGE, "cameras": ROWS}, {"tracks": (5, 4, 3), "cameras": (5, 3, 3)}),
    "best_path": (
        {"cost": torch.rand(2, 5, 3), "transition": torch.rand(2, 4, 3, 3)},
        {"cost": (3,), "transition": (2, 5, 3, 3)},
    ),
    "bone_vectors": ({"points": CLIP, "bones": [(0, 1)]}, {"points": (3,)}),
    "centre": ({"points": CLIP, "weights": MASS}, {"points": (3,), "weights": (2, 5, 4, 1)}),
    "chain_inverse": ({"matrix": F.incidence([(0, 1), (1, 2)], 3)}, {"matrix": (3,)}),
    "complete_rotation": ({"cameras": ROWS}, {"cameras": (5, 3, 3)}),
    "distance_spread": ({"points": CLIP, "weights": MASS}, {"points": (5, 4, 2), "weights": (4, 4)}),
    "euler_angles": ({"order": "XYZ", "matrices": TURNS}, {"matrices": (5, 2, 3)}),
    "euler_rotation": ({"order": "XYZ", "angles": WAY}, {"angles": (5, 2)}),
    "factorize": ({"tracks": IMAGE, "rank": 3}, {"tracks": (5, 4, 3)}),
    "flexion": ({"upper": WAY, "lower": WAY, "axis": WAY}, {"upper": (2,), "lower": (5, 2), "axis": ()}),
    "interpolate": ({"values": CLIP, "seen": MASS > 0}, {"values": (4, 3)}),
    "joint_angles": ({"points": CLIP, "joints": [(0, 1, 2)]}, {"points": (3,)}),
    "kcs_matrix": ({"vectors": CLIP}, {"vectors": (3,)}),
    "log_det": ({"matrix": TURNS @ TURNS.mT, "eps": torch.ones(5)}, {"matrix": (3,), "eps": (4,)}),
    "minimal_turn": ({"source": WAY, "target": WAY}, {"source": (5, 2), "target": (5, 4)}),
    "nearest_rotation": ({"matrix": TURNS}, {"matrix": (5, 2, 3)}),
    "orthonormality_defect": ({"rows": ROWS}, {"rows": (5, 3, 3)}),
    "perspective": (
        {"points": CLIP + 1, "intrinsics": torch.ones(2, 1, 1, 4)},
        {"points": (4, 4), "intrinsics": (3, 3)},
    ),
    "pinhole_translation": (
        {"points": CLIP, "rays": IMAGE, "weights": MASS},
        {"points": (2, 5, 4, 4), "rays": (2, 5, 3, 2), "weights": (2, 5, 4, 1)},
    ),
    "pose_matrix": ({"points": CLIP, "bones": [(0, 1)]}, {"points": (3,)}),
    "procrustes": (
        {"source": CLIP, "target": CLIP, "weights": MASS},
        {"source": (3,), "target": (5, 3, 3), "weights": (5, 1)},
    ),
    "project": ({"points": CLIP, "cameras": ROWS}, {"points": (5, 4, 2), "cameras": (5, 2, 2)}),
    "psd_shrink": ({"matrix": TURNS, "threshold": torch.ones(5)}, {"matrix": (3,), "threshold": (4,)}),
    "rotation_angle": ({"first": TURNS, "second": TURNS}, {"first": (5, 2, 3), "second": (3,)}),
    "rotation_matrix": ({"vectors": WAY}, {"vectors": (5, 2)}),
    "rotation_vector": ({"matrices": TURNS}, {"matrices": (5, 2, 3)}),
    "rows_to_cameras": ({"rows": ROWS}, {"rows": (5, 3, 3)}),
    "scatter_log_det": ({"values": WAY, "eps": 1.0}, {"values": (3,)}),
    "standing": ({"image": IMAGE, "weights": MASS}, {"image": (5, 4, 3), "weights": (2, 4, 4)}),
    "superpose": (
        {"source": CLIP, "target": CLIP, "how": "rigid", "weights": MASS},
        {"source": (4, 2), "target": (2, 5, 3, 3), "weights": (2, 5, 1)},
    ),
    "svt": ({"matrix": WAY, "threshold": 1.0, "corner": torch.ones(2)}, {"threshold": (3,), "corner": (3,)}),
    "viewpoint_turn": ({"cameras": ROWS}, {"cameras": (2, 3)}),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_does_not_fit_is_told_by_its_name(name):
    """Torch told of sizes at dimensions; some functions answered, with what nobody had asked for."""
    function, (arguments, wrong) = getattr(F, name), REFUSED[name]
    function(**arguments)
    for what, shape in wrong.items():
        with pytest.raises(ShapeError, match=rf"{name}: .*{what}.*expected .*got"):
            function(**{**arguments, what: torch.ones(shape)})
    if isinstance(arguments[what], torch.Tensor) and name not in ("log_det", "psd_shrink", "svt"):
        with pytest.raises(ShapeError, match=f"{name}: {what}: expected a tensor, got list: use torch.as_tensor"):
            function(**{**arguments, what: [1.0]})


FLOATING = {
    "angle_between": ("first", "second"),
    "back_project": ("tracks", "cameras"),
    "centre": ("points",),
    "chain_inverse": ("matrix",),
    "euler_angles": ("matrices",),
    "euler_rotation": ("angles",),
    "factorize": ("tracks",),
    "flexion": ("upper", "lower"),
    "joint_angles": ("points",),
    "minimal_turn": ("source", "target"),
    "pinhole_translation": ("points", "rays"),
    "procrustes": ("source", "target"),
    "project": ("points", "cameras"),
    "rotation_angle": ("first", "second"),
    "rotation_vector": ("matrices",),
    "rows_to_cameras": ("rows",),
    "scatter_log_det": ("values",),
    "superpose": ("source", "target"),
    "viewpoint_turn": ("cameras",),
}


@pytest.mark.parametrize("name", FLOATING)
def test_whole_numbers_are_refused(name):
    """They were divided by, or written into, without a fraction."""
    function, (arguments, _) = getattr(F, name), REFUSED[name]
    for what in FLOATING[name]:
        expected = rf"{name}: {what}: expected floating point, got torch.int64: use {what}.float\(\)"
        with pytest.raises(ShapeError, match=expected):
            function(**{**arguments, what: (9 * arguments[what]).long()})


def test_other_whole_numbers_are_refused():
    with pytest.raises(ShapeError, match=r"orbit: yaw: expected floating point, got torch.int64: use yaw.float\(\)"):
        F.orbit(torch.tensor([0, 90]), 20.0)
    with pytest.raises(ShapeError, match=r"orbit: yaw: expected a tensor, got float: use torch.as_tensor\(yaw\)"):
        F.orbit(90.0)
    with pytest.raises(ShapeError, match=r"pose_matrix: points: expected floating point, got torch.int64"):
        F.pose_matrix(CLIP.long(), [(0, 1)], normalise=True)
    assert F.pose_matrix(CLIP.long(), [(0, 1)]).dtype == torch.int64


PAIRS = {name: names for name, names in FLOATING.items() if len(names) == 2 and name != "pinhole_translation"}


@pytest.mark.parametrize("name", PAIRS)
def test_of_two_precisions_the_result_has_the_finer(name):
    function, (arguments, _) = getattr(F, name), REFUSED[name]
    exact = {k: v.double() if isinstance(v, torch.Tensor) else v for k, v in arguments.items()}
    expected = function(**exact)
    for what in PAIRS[name]:
        found = function(**{**exact, what: arguments[what]})
        for ours, theirs in zip(*(x if isinstance(x, tuple) else (x,) for x in (found, expected)), strict=True):
            torch.testing.assert_close(ours, theirs)


@pytest.mark.parametrize(
    "name", [*PAIRS, "centre", "distance_spread", "perspective", "pinhole_translation", "standing"]
)
def test_batches_that_do_not_fit_are_told(name):
    function, (arguments, _) = getattr(F, name), REFUSED[name]
    for what in [key for key, value in arguments.items() if isinstance(value, torch.Tensor)]:
        with pytest.raises(ShapeError, match=rf"{name}: .*{what}.*: expected the same batch, got \("):
            function(**{**arguments, what: torch.cat([arguments[what]] * 2)[:3]})


def test_single_poses_are_moved_as_clips_are():
    turned = CLIP @ TURNS[0].mT + 1
    alone, clip = (F.superpose(*pair, "similarity") for pair in ((CLIP[0, 0], turned[0, 0]), (CLIP, turned)))
    torch.testing.assert_close(alone, clip[0, 0])
    with pytest.raises(ShapeError, match=r"superpose: source: expected shape \(\.\.\., T, N, 3\), got \(4, 3\)"):
        F.superpose(CLIP[0, 0], turned[0, 0], "sequence")


def test_cores_have_letters_for_any_size():
    check_core(torch.zeros(7, 2, 5, 3), "points", "T", "N", 3)
    check_core(torch.zeros(()), "size")
    with pytest.raises(ShapeError, match=r"points: expected shape \(\.\.\., T, N, 3\), got \(5, 3\)"):
        check_core(torch.zeros(5, 3), "points", "T", "N", 3)
