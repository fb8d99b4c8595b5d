"""A page with a 3D player that needs nothing but a browser."""

from __future__ import annotations

import html
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from kcs_torch.errors import OptionError
from kcs_torch.types import Reconstruction
from kcs_torch.types.hints import is_a
from kcs_torch.types.people import files_named, shared
from kcs_torch.viewer.names import as_people, printable
from kcs_torch.viewer.scene import scene_of
from kcs_torch.viewer.summary import doubts, summarise

__all__ = ["player"]

SCRIPTS = ("motion.js", "space.js", "image.js", "charts.js", "player.js")


def player(
    results: Reconstruction | Sequence[Reconstruction],
    *,
    names: Sequence[str] | None = None,
    title: str | None = None,
) -> str:
    """Make a self-contained HTML page that plays the motion of one or several people.

    It shows the 3D motion (drag to turn, wheel to zoom), the tracks with the motion's projection beside it, and the
    bones' lengths and the depths' uncertainty over time. Up is the camera's up. The left side of a body is blue, the
    right vermilion, what is between them grey. One may choose the mirror image, the alternatives, and the body's path
    through space where it is known. Space plays and pauses; arrows step.

    The page needs no network and no other package. It holds 40 kB, about 20 bytes for each joint of a frame and half as
    many for each alternative, but no more than 9 MB: of clips with more frames than fit, every second, third, ... frame
    is shown, and the page says so.

    Args:
        results: one motion, or several of the same clip: each stands where its own tracks are; what lies between
            people in depth is not known.
        names: of the people; their sources or methods if None.
        title: of the page; the source and the method if None.

    Returns:
        The page's text.

    Raises:
        OptionError: there is no result, the frame rates or unknown units differ, the number of names does, or the title
            is no text.
        OutputError: a result has no joint at a finite place.
    """
    if not is_a(title, str | None):
        raise OptionError(f"player: title: expected text or none, got {title!r}")
    people = as_people(results, "player")
    data = scene_of(people, names)
    if title is None:
        title = f"{', '.join(dict.fromkeys(r.method for r in people))}: {files_named(r.tracks for r in people)}"
    called = [person["name"] for person in data["people"]]
    folder = Path(__file__).parent / "page"
    parts = {
        "TITLE": html.escape(title),
        "SUMMARY": html.escape(_head(people, data["step"])),
        "DOUBTS": "".join(f'<p class="doubt">{html.escape(doubt)}</p>' for doubt in doubts(people, called)),
        "NOTES": "".join(f"<li>{html.escape(note)}</li>" for note in _notes(people, data)),
        "DATA": _script_safe(json.dumps(data, allow_nan=False)),
        "STYLE": (folder / "player.css").read_text(encoding="utf-8"),
        "SCRIPT": "\n".join((folder / name).read_text(encoding="utf-8") for name in SCRIPTS),
    }
    page = (folder / "player.html").read_text(encoding="utf-8")
    head, *tail = page.split("@@")  # text, key, text, key, ..., text: nothing of a value is looked at again
    return printable(head + "".join(parts[k] + text for k, text in zip(tail[::2], tail[1::2], strict=True)))


def _head(people: Sequence[Reconstruction], step: int) -> str:
    frames = max(len(r.points) for r in people)
    told = summarise(people[0]) if len(people) == 1 else f"{len(people)} people · {frames} frames"
    ending = {2: "nd", 3: "rd"}.get(step, "th")
    return told if step == 1 else f"{told} · every {step}{ending} frame shown"


def _notes(people: Sequence[Reconstruction], data: dict[str, Any]) -> list[str]:
    notes = []
    if len(people) > 1:
        notes.append("how far people stand behind each other is not known: each is at a depth of its own")
        if any(any(person["shift"]) for person in data["people"]):
            notes.append("lenses were found for each person separately: they stand side by side as in the image")
    told = [list(dict.fromkeys((*r.diagnostics.notes, *r.tracks.notes))) for r in people]
    common = shared(told)
    for one, person in zip(told, data["people"], strict=True):
        start = f"{person['name']}: " if len(people) > 1 else ""
        notes += [start + note for note in ([person["summary"]] if start else []) + one if note not in common]
    return [*notes, *(f"everybody: {note}" for note in common)]


def _script_safe(text: str) -> str:
    """JSON that cannot end its script element."""
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
