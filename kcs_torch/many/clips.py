"""Which clips a folder holds, and where their results go."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from kcs_torch.errors import OptionError
from kcs_torch.io.folders import natural_key, sibling_files
from kcs_torch.many.record import MADE_BY

__all__ = ["Clip", "clips_of"]

FAILED = ".failed.txt"
"""Suffix of the file that stands in for the results of a clip that failed, and says why."""


@dataclass(frozen=True)
class Clip:
    """One clip's tracks, and where its results go.

    Attributes:
        source: a file, or a folder of files that make one clip.
        target: of the results, without their suffixes.
        name: of the source within the folder of all clips.
    """

    source: Path
    target: Path
    name: str

    def outputs(self, suffixes: Sequence[str]) -> list[Path]:
        """The files of its results."""
        return [self.target.with_name(self.target.name + suffix) for suffix in suffixes]

    @property
    def failure(self) -> Path:
        """The file that says why it failed."""
        return self.target.with_name(self.target.name + FAILED)

    @property
    def people_list(self) -> Path:
        """Written last of all people's results; holds how many there are."""
        return self.target.with_name(f"{self.target.name}.people.txt")

    def person(self, number: int) -> Clip:
        """Where the results of one of its people go."""
        return replace(self, target=self.target.with_name(f"{self.target.name}_{number}"))

    def is_newer_than(self, results: Sequence[Path]) -> bool:
        """Whether its file, or one of its folder's, was changed after any of the results was made."""
        with suppress(OSError):
            made = min(path.stat().st_mtime for path in results)
            return any(path.stat().st_mtime > made for path in (self.source, *sibling_files(self.source)))
        return False

    def share_of(self, shards: int) -> int:
        """Which of so many parts of the work it belongs to: told by its name alone, the same on every machine."""
        digest = hashlib.blake2b(self.name.encode("utf-8", "surrogateescape"), digest_size=8).digest()
        return int.from_bytes(digest, "big") % shards


def clips_of(source: str | Path, output: str | Path, pattern: str = "*") -> list[Clip]:
    """List the clips of a folder in natural order.

    Args:
        source: the folder.
        output: of the results: a clip ``a/b.json`` becomes ``OUTPUT/a/b.json.npz``, or ``OUTPUT/a/b.npz`` where that is
            no other clip's. Folders that hold results are no clips.
        pattern: of clips within the folder; ``**/*.json`` looks into folders, ``*`` takes files, and folders as clips.
            The folder itself is none.

    Raises:
        OptionError: the folder is none, lies in the output, or holds nothing of the pattern.
    """
    folder, output = Path(source), Path(output)
    if not folder.is_dir():
        raise OptionError(f"{folder}: expected a folder of tracks, got {'a file' if folder.exists() else 'nothing'}")
    inside = output.resolve()
    if inside in (folder.resolve(), *folder.resolve().parents):
        raise OptionError(f"{folder}: lies in the output folder, {output}: give an output beside it, or a folder in it")
    try:
        found = sorted(folder.glob(pattern), key=lambda p: natural_key(str(p)))
    except (ValueError, NotImplementedError) as error:
        raise OptionError(f"pattern: expected one such as *.json or **/*.npz, got {pattern!r} ({error})") from None
    results = {p.parent for p in folder.rglob(MADE_BY)} - {folder}
    names = [
        p.relative_to(folder)
        for p in found
        if p.resolve() != inside and inside not in p.resolve().parents and not results & {p, *p.parents}
    ]
    names = [name for name in names if name.parts and not any(part.startswith(".") for part in name.parts)]
    if not names:
        raise OptionError(f"{folder}: expected tracks that match {pattern!r}, found none")
    short = [n if (folder / n).is_dir() else n.with_suffix("") for n in names]
    taken = Counter([*short, *(n for n, brief in zip(names, short, strict=True) if n != brief)])
    pairs = zip(names, short, strict=True)
    return [Clip(folder / n, output / (brief if taken[brief] == 1 else n), n.as_posix()) for n, brief in pairs]
