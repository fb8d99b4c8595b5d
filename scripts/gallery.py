"""Make the pictures of the documentation from the library's synthetic motion, and of real files where they are given.

    python scripts/gallery.py                                   # into docs/_gallery
    python scripts/gallery.py --real openpose_json/ dog.npz     # one more sheet for each of these tracks

Pictures that are there already are kept; ``--anew`` makes them all. PyTorch uses one thread.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import torch

import kcs_torch as kt
from kcs_torch.viewer import draw_skeleton, draw_tracks, sheet

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "_gallery"


def seed(number: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(number)


def named(result: kt.Reconstruction, name: str) -> kt.Reconstruction:
    """The result with another name of its tracks, which pictures show."""
    return replace(result, tracks=replace(result.tracks, source=name))


@cache
def walk() -> kt.Reconstruction:
    """A person who walks past a fixed camera, with noise and gaps."""
    clip = kt.data.walking_person(90, skeleton="coco17", yaw=60, turn=0, noise=6, missing=0.08, generator=seed())
    return named(kt.reconstruct(clip.tracks).scaled(units="m", height=1.75), "walk, fixed camera, 6 mm of noise, gaps")


@cache
def dog() -> kt.Reconstruction:
    """A four-legged animal before a camera that turns."""
    clip = kt.data.random_motion("ap10k", 80, swing=15, yaw=60, turn=120, noise=2, generator=seed(1))
    return named(kt.reconstruct(clip.tracks), "AP-10K animal, turning camera")


@cache
def hand() -> kt.Reconstruction:
    """A hand before a camera that turns."""
    clip = kt.data.random_motion("hand21", 80, swing=15, turn=120, generator=seed(2))
    return named(kt.reconstruct(clip.tracks), "hand, turning camera")


@cache
def marker_tree() -> kt.Reconstruction:
    """A body that nobody has described: bones only, no template."""
    arm = kt.Skeleton.from_names(
        ["base", "shoulder", "elbow", "wrist", "tip"],
        [("base", "shoulder"), ("shoulder", "elbow"), ("elbow", "wrist"), ("wrist", "tip")],
        name="arm",
    )
    clip = kt.data.random_motion(arm, 120, swing=30, turn=180, generator=seed(3))
    return named(kt.reconstruct(clip.tracks), "arm of four links, no template, turning camera")


def save_sheet(result: Callable[[], kt.Reconstruction], frames: int, path: Path) -> None:
    sheet(result(), frames=frames).savefig(path, dpi=100)


def save_result(result: Callable[[], kt.Reconstruction], path: Path) -> None:
    result().save(path)


def save_tracks(path: Path) -> None:
    draw_tracks(walk().tracks).savefig(path, dpi=80)


def save_skeleton(name: str, path: Path) -> None:
    draw_skeleton(kt.SKELETONS[name]).savefig(path, dpi=70)


def save_cleaned(path: Path) -> None:
    """One joint's track before and after cleaning."""
    from matplotlib.figure import Figure

    clip = kt.data.walking_person(90, skeleton="coco17", yaw=90, turn=0, noise=8, missing=0.05, generator=seed(4))
    points = clip.tracks.points.clone()
    points[20::17, 15] += torch.tensor([300.0, -400.0])  # detections on somebody else
    rough = replace(clip.tracks, points=points)
    clean = kt.clean.smooth(kt.clean.fill(kt.clean.gate(rough), 8), "butterworth", cutoff=6)
    figure = Figure(figsize=(8, 3), layout="constrained")
    axis = figure.subplots()
    time = torch.arange(90) / 30
    for tracks, style, label in ((rough, "o", "as it came"), (clean, "-", "--gate --fill 8 --smooth butterworth=6")):
        height = torch.where(tracks.seen[:, 15], -tracks.points[:, 15, 1], torch.nan)
        axis.plot(time, height, style, markersize=3, label=label)
    axis.set_xlabel("seconds")
    axis.set_ylabel("left ankle, up (mm)")
    axis.legend(fontsize=8)
    figure.savefig(path, dpi=100)


def save_uncertainty(path: Path) -> None:
    """The depth of a wrist over time, with its standard deviation, and the truth."""
    from matplotlib.figure import Figure

    clip = kt.data.walking_person(90, skeleton="coco17", yaw=60, turn=0, noise=6, generator=seed())
    result = kt.reconstruct(clip.tracks)
    truth = clip.points[..., 2] - clip.points[..., 2].mean(1, keepdim=True)
    depth = result.points[..., 2] - result.points[..., 2].mean(1, keepdim=True)
    assert result.uncertainty is not None
    figure = Figure(figsize=(8, 3), layout="constrained")
    axis = figure.subplots()
    time = torch.arange(90) / 30
    for joint, colour in (("left_wrist", "#0072b2"), ("right_ankle", "#d55e00")):
        n = clip.skeleton.joints.index(joint)
        low, high = depth[:, n] - result.uncertainty[:, n], depth[:, n] + result.uncertainty[:, n]
        axis.fill_between(time, low, high, color=colour, alpha=0.2, linewidth=0)
        axis.plot(time, depth[:, n], color=colour, label=joint.replace("_", " "))
        axis.plot(time, truth[:, n], "--", color=colour, linewidth=1)
    axis.plot([], [], "--", color="gray", linewidth=1, label="truth")
    axis.set_xlabel("seconds")
    axis.set_ylabel("depth (mm)")
    axis.legend(fontsize=8)
    figure.savefig(path, dpi=100)


PICTURES: dict[str, Callable[[Path], None]] = {
    "tracks.png": save_tracks,
    "walk.png": partial(save_sheet, walk, 8),
    "walk.gif": partial(save_result, walk),
    "dog.png": partial(save_sheet, dog, 4),
    "hand.png": partial(save_sheet, hand, 6),
    "arm.png": partial(save_sheet, marker_tree, 4),
    "cleaned.png": save_cleaned,
    "uncertainty.png": save_uncertainty,
    "pages/player_walk.html": partial(save_result, walk),
    "pages/player_dog.html": partial(save_result, dog),
    **{f"skeleton_{name}.png": partial(save_skeleton, name) for name in kt.SKELETONS},
}
"""What makes each file of the gallery."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=FOLDER, help="folder")
    parser.add_argument("--only", nargs="+", choices=sorted(PICTURES), metavar="NAME", help="make these only")
    parser.add_argument("--anew", action="store_true", help="make pictures that are there already, too")
    parser.add_argument("--real", nargs="+", default=[], metavar="TRACKS", help="files of tracks to make sheets of")
    options = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", kt.KcsWarning)
    for name in options.only or PICTURES:
        path = options.output / name
        if options.anew or not path.is_file():
            path.parent.mkdir(parents=True, exist_ok=True)
            PICTURES[name](path)
            print(path, flush=True)
    for source in options.real:
        path = options.output / f"real_{Path(source).stem}.png"
        try:
            tracks = kt.load_tracks(source)
        except kt.KcsError as error:
            raise SystemExit(f"error: {error}") from None
        path.parent.mkdir(parents=True, exist_ok=True)
        sheet(kt.reconstruct(tracks), frames=6).savefig(path, dpi=100)
        print(path, flush=True)


if __name__ == "__main__":
    main()
