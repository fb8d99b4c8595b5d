"""``kcs-torch score``: how far a motion is from the truth."""

from __future__ import annotations

import dataclasses
import math
import re
from typing import TYPE_CHECKING, Annotated, Any

import typer

from kcs_torch.cli.cleaning import frame_range
from kcs_torch.cli.options import AsJson
from kcs_torch.cli.outputs import Scale, parse_scale, sized
from kcs_torch.cli.report import answer, one_line, print_json, progress

if TYPE_CHECKING:
    from kcs_torch.metrics import Comparison
    from kcs_torch.types import Motion

__all__ = ["score"]

_Up = "The axis that points up in {}, whatever the file says; y if neither says: y, z, x, -y (the camera's axes) or -z."
_Format = "Format of {}; recognised by its content if not given."
_Frames = "Take frames A to B of {}, counted from 0, without B (A: and :B extend to the ends)."


def score(
    pred: Annotated[
        str,
        typer.Argument(
            metavar="PRED", help="A result of `kcs-torch lift` (.npz), or any file of 3D motion.", show_default=False
        ),
    ],
    truth: Annotated[
        str,
        typer.Argument(
            metavar="TRUTH", help="A file of 3D motion: .trc, .c3d, .bvh, .amc, or .npz.", show_default=False
        ),
    ],
    align: Annotated[
        list[str],
        typer.Option(
            metavar="NAME",
            help="Alignment before distances are measured: none, root, scale, rigid (each frame rotated), similarity "
            "(rotated and scaled: PA-MPJPE), sequence (one rotation and scale for the clip); may be repeated. If not "
            "given, all that make sense for these sizes.",
            show_default=False,
        ),
    ] = [],  # noqa: B006 (typer reads it and never changes it)
    root: Annotated[
        str | None, typer.Option(metavar="JOINT", help="TRUTH's root joint; its pelvis if not given and there is one.")
    ] = None,
    mirror: Annotated[bool, typer.Option("--mirror", help="Score the mirror image in depth of PRED.")] = False,
    within: Annotated[
        float | None, typer.Option(metavar="NUMBER", help="Distance for PCK, in TRUTH's unit; 150 mm if not given.")
    ] = None,
    scale: Scale = None,
    pred_format: Annotated[
        str | None, typer.Option("--pred-format", metavar="NAME", help=_Format.format("PRED"))
    ] = None,
    truth_format: Annotated[
        str | None, typer.Option("--truth-format", metavar="NAME", help=_Format.format("TRUTH"))
    ] = None,
    pred_up: Annotated[str | None, typer.Option(metavar="AXIS", help=_Up.format("PRED"))] = None,
    truth_up: Annotated[str | None, typer.Option(metavar="AXIS", help=_Up.format("TRUTH"))] = None,
    pred_frames: Annotated[str | None, typer.Option(metavar="A:B", help=_Frames.format("PRED"))] = None,
    truth_frames: Annotated[str | None, typer.Option(metavar="A:B", help=_Frames.format("TRUTH"))] = None,
    pred_fps: Annotated[float | None, typer.Option(metavar="NUMBER", help="PRED's frames a second.")] = None,
    truth_fps: Annotated[float | None, typer.Option(metavar="NUMBER", help="TRUTH's frames a second.")] = None,
    from_units: Annotated[
        str | None,
        typer.Option(
            "--from-units",
            metavar="m|cm|mm|in|ft",
            help="The unit of PRED or TRUTH, or of both, where the file does not say; one that does keeps its own.",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Compare a motion with ground truth; joints are matched by name, frames by number."""
    with answer(as_json):
        from kcs_torch.metrics import compare

        with progress(f"reading {pred}"):
            ours = _motion(pred, parse_scale(scale), pred_format, pred_up, pred_fps, from_units)
            ours = _cut(ours, pred_frames, "--pred-frames")
        with progress(f"reading {truth}"):
            theirs = _read(truth, truth_format, truth_up, truth_fps, from_units)
            theirs = _cut(theirs, truth_frames, "--truth-frames")
        found = compare(ours, theirs, align=align or None, root=root, mirror=mirror, within=within)
        read = [*_notes(ours, pred, pred_format, "--pred"), *_notes(theirs, truth, truth_format, "--truth")]
        found = dataclasses.replace(found, notes=(*found.notes, *read))
        if as_json:
            print_json(dataclasses.asdict(found))
        else:
            typer.echo(_spoken(found, pred, truth, mirror))


def _motion(
    path: str, size: dict[str, Any] | None, format: str | None, up: str | None, fps: float | None, units: str | None
) -> Motion:
    """A result, which knows its own bones' lengths, or any other motion; in its true size."""
    from kcs_torch.io import load_any
    from kcs_torch.io.anything import kind_of
    from kcs_torch.types import Motion, Reconstruction

    if kind_of(path, format) == "result":
        data = load_any(path, format=format, up=up, fps=fps)
        assert isinstance(data, Reconstruction)
        return dataclasses.replace(Motion.of(sized(data, size)), source=path)
    return sized(_read(path, format, up, fps, units), size)


def _read(path: str, format: str | None, up: str | None, fps: float | None, units: str | None) -> Motion:
    """Motion, in these units where the file does not say its own: they are of both files."""
    from kcs_torch.io.motion import read_motion
    from kcs_torch.io.registry import MotionOptions

    return read_motion(path, format, MotionOptions(None, fps, up, units, fill_in=("units",)))


def _notes(motion: Motion, path: str, format: str | None, own: str) -> list[str]:
    """What was assumed when a file was read, whose options begin with its ``own`` word here; nothing of a result.

    Its axes matter where bodies are compared without turning them. What a result has to say is how it was made, and
    with which options of ``lift`` it is made otherwise.
    """
    from kcs_torch.io.anything import kind_of

    if kind_of(path, format) == "result":
        return []
    return [f"{path}: {re.sub(r'--(from-)?(?=up|fps)', f'{own}-', note)}" for note in motion.notes]


def _cut(motion: Motion, frames: str | None, option: str) -> Motion:
    """The frames that an option asks for."""
    from kcs_torch.errors import OptionError

    start, stop = frame_range(frames, option, seen=False)
    stop = motion.num_frames if stop is None else min(stop, motion.num_frames)
    if not start < stop:
        raise OptionError(f"{option}: expected frames within 0:{motion.num_frames} of {motion.source}, got {frames}")
    return motion.frames(start, stop)


def _spoken(found: Comparison, pred: str, truth: str, mirror: bool) -> str:
    from kcs_torch.metrics import ALIGNMENTS
    from kcs_torch.types.variation import BoneVariation

    unit = f" {found.units}" if found.units else ""
    names = [ours if ours == theirs else f"{ours} = {theirs}" for ours, theirs in found.joints]
    lines = [f"{pred} against {truth}: {found.frames} frames, {len(names)} joints: {', '.join(names)}"]
    near = f"  PCK within {found.pck_within:g}{unit}" if found.pck else ""
    lines.append(f"{'aligned by':<12}{'MPJPE' + (f' [{found.units}]' if unit else ''):>14}{near}")
    for how, error in found.mpjpe.items():
        share = f"  {100 * found.pck[how]:.1f} %".ljust(len(near)) if found.pck else ""
        what = ALIGNMENTS[how]
        if how in ("root", "scale"):
            what = what.replace("the root joint", found.root if found.root else "the middle")
        lines.append(f"{how:<12}{error:>14.4g}{share}  {what}")
    if not math.isnan(found.e3d):
        lines.append(f"{'e3d':<16}{found.e3d:.4f} (one orthogonal matrix for the clip)")
    if not math.isnan(found.bone_deviation):
        true = found.bone_deviation_truth
        variation = BoneVariation(100 * found.bone_deviation, 100 * found.largest_deviation, found.loosest_bone)
        theirs = "no bones in the truth" if math.isnan(true) else f"truth: {100 * true:.2f} %"
        lines.append(f"{'bone deviation':<16}{variation}; {theirs}")
    lines += [f"note: {one_line(note)}" for note in found.notes]
    better = [how for how in found.mpjpe if found.mirrored[how] < 0.98 * found.mpjpe[how]]
    turned = min(found.mirrored.values()) < 0.98 * min(found.mpjpe.values())  # else the axes are to blame
    if better and turned:
        shown = ", ".join(f"{how} {found.mirrored[how]:.4g}{unit}" for how in better)
        how = "without" if mirror else "with"
        lines.append(f"note: the mirror image in depth is closer ({shown}): score it {how} --mirror")
    return "\n".join(lines)
