"""List what is in the files of a folder: format, frames, joints, people, and the share of unseen joints.

    python scripts/formats.py ../shared/data/raw_formats
    python scripts/formats.py detections --image-size 1088x1920

Every file below the folder that a reader recognises is a row, a folder of one file a frame is one; the rest is named
at the end, with the reason.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Iterator
from pathlib import Path

import kcs_torch as kt
from kcs_torch.cli.options import image_size
from kcs_torch.io import detect_format, load_people
from kcs_torch.io.anything import kind_of


def clips(folder: Path) -> Iterator[Path]:
    """Files, and folders that are one clip, in order."""
    for path in sorted(folder.iterdir()):
        if path.is_dir() and not is_clip(path):
            yield from clips(path)
        else:
            yield path


def is_clip(folder: Path) -> bool:
    """Whether the files of a folder are the frames of one clip."""
    try:
        return bool(detect_format(folder))
    except kt.FormatError:
        return False


def row(path: Path, size: tuple[int, int] | None) -> tuple[str, ...]:
    """Format, frames, joints, people, and unseen shares of a file, as text."""
    if kind_of(path) == "motion":
        motion = kt.load_motion(path)
        unseen = 100 * float((~motion.seen[:, : motion.skeleton.num_observed]).double().mean())
        return "3D motion", str(motion.num_frames), str(motion.skeleton.num_observed), "1", f"{unseen:.1f}"
    people = load_people(path, image_size=size)
    first = people[0]
    unseen = ", ".join(f"{100 * one.unseen_share:.1f}" for one in people)
    return detect_format(path), str(first.num_frames), str(first.skeleton.num_observed), str(len(people)), unseen


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--image-size", metavar="WIDTHxHEIGHT", help="of the videos of MediaPipe's files")
    options = parser.parse_args()
    if not options.folder.is_dir():
        parser.error(f"{options.folder}: expected a folder, found none")
    try:
        size = image_size(options.image_size)
    except kt.OptionError as error:
        parser.error(str(error))
    warnings.simplefilter("ignore", kt.KcsWarning)
    print("| file | format | frames | joints | people | unseen, % |\n|---|---|---|---|---|---|")
    left = []
    for path in clips(options.folder):
        name = path.relative_to(options.folder).as_posix()
        try:
            print(f"| {name} | {' | '.join(row(path, size))} |", flush=True)
        except kt.KcsError as error:
            left.append(f"{name}: {error}")
    print("\n".join(["", *left]))


if __name__ == "__main__":
    main()
