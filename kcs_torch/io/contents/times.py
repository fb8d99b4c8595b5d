"""Frames and their rate by the times that files give them."""

from __future__ import annotations

import itertools
import re
import statistics
from collections.abc import Iterable, Mapping, Sequence

from kcs_torch.io.folders import frame_numbers

__all__ = ["frames_of_times", "plain_rate", "rate_of_times", "time_unit"]

_TIME = re.compile(r"(?:time|timestamp|t)[ _]?[\[(]?(?P<unit>|s|sec|seconds|ms|msec|milliseconds)[\])]?\Z")
_UNEVEN = 0.3  # of a frame, by which times may be off
_SKIPPED = 1.5  # frames from one time to the next from which on some are missing between


def time_unit(name: str) -> str | None:
    """The unit of times that are called so, "" where the name does not tell; None if no times are.

    >>> time_unit("timestamp_ms"), time_unit("time"), time_unit("x")
    ('ms', '', None)
    """
    match = _TIME.match(name.lower())
    return match["unit"] if match else None


def frames_of_times(times: Iterable[float], notes: list[str]) -> dict[float, int]:
    """The frame of each time; in their order, which is noted, where they lie at no even distances.

    >>> frames_of_times([0, 33, 67, 133], [])
    {0: 0, 33: 1, 67: 2, 133: 4}
    """
    own = sorted(set(times))
    frames = _even(own)
    if frames is None:
        notes.append("the times are uneven: frames are taken in their order, at the mean rate")
        frames = list(range(len(own)))
    return dict(zip(own, frames, strict=True))


def rate_of_times(times: Mapping[int, float], unit: str, notes: list[str]) -> float | None:
    """Frames per second by the times of numbered frames, NaN where unknown; None where they do not tell.

    Args:
        times: of each frame.
        unit: "s", "ms" and the like, or "" where it has to be guessed, which is noted.
        notes: added to.
    """
    numbers = sorted(times)
    frames, _ = frame_numbers(numbers, [])
    known = [(f, times[n]) for f, n in zip(frames, numbers, strict=True) if times[n] == times[n]]
    if len(known) < 2 or not known[-1][1] > known[0][1]:
        return None
    rate = (known[-1][0] - known[0][0]) / (known[-1][1] - known[0][1])
    if unit.startswith("m"):
        rate *= 1e3
    elif not unit:
        scale = next((s for s in (1.0, 1e3, 1e6, 1e9) if s * rate >= 1), 1.0)
        if scale > 1:
            notes.append(f"times are taken to count {scale:.0f} a second")
        rate *= scale
        if plain_rate(rate) == 1:
            notes.append(
                "times are taken for seconds, at 1 frame a second: give fps=... (kcs-torch: --fps) if they count frames"
            )
    return plain_rate(rate)


def plain_rate(rate: float) -> float | None:
    """A rate without what rounded times make of it: to three decimals, or six digits below 10 a second.

    None below a frame in eleven days, which no times mean.

    >>> plain_rate(1 / 0.033333), plain_rate(1 / 30)
    (30.0, 0.0333333)
    """
    plain = round(rate, 3) if rate >= 10 else float(f"{rate:.6g}")
    return plain if plain >= 1e-6 else None


def _even(times: Sequence[float]) -> list[int] | None:
    """The frame of each time, ascending and rounded, to milliseconds say; None where they lie at no even distances."""
    steps = [b - a for a, b in itertools.pairwise(times)]
    if not steps:
        return [0] * len(times)
    usual = statistics.median_low(steps)
    step = statistics.fmean(one for one in steps if one < _SKIPPED * usual)
    frames = list(itertools.accumulate((round(min(one / step, 1e300)) for one in steps), initial=0))
    if len(set(frames)) < len(frames):
        return None
    step = (times[-1] - times[0]) / frames[-1]  # of all, as rounding adds up from gap to gap
    off = (abs((time - times[0]) / step - frame) for time, frame in zip(times, frames, strict=True))
    return frames if max(off) <= _UNEVEN else None
