"""Low-pass filters of one run of frames, by the frequency they cut at."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from kcs_torch.clean.common import Array
from kcs_torch.errors import OptionError

__all__ = ["FILTERS", "Filter"]

_STEPS = 60
"""Rounds in which less trusted frames give way to others; each leaves at most 1 - (least weight) of the error."""

_SAVGOL_DEGREE = 3

_LONGEST = 12_000
"""Frames of a Savitzky-Golay window, at most: SciPy's coefficients of longer ones (from 15 879) are no cubic's."""


@dataclass(frozen=True)
class Filter:
    """A smoother of runs.

    Attributes:
        words: what it is, for notes.
        least: frames of the shortest run that it can take.
        apply: smooths (L, D) values, given how much each frame counts, (L,) in 0..1.
    """

    words: str
    least: int
    apply: Callable[[Array, Array], Array]


def butterworth(cutoff: float, fps: float, size: float) -> Filter:
    """Second-order Butterworth forwards and backwards: no lag, and -3 dB at the cut-off for both passes together."""
    from scipy.signal import butter, sosfiltfilt

    # Two passes of gain 1/sqrt(1 + r^4) each, with r = tan(pi f / fps) / tan(pi f_c / fps).
    warped = math.tan(math.pi * cutoff / fps) / (math.sqrt(2) - 1) ** 0.25
    sections = butter(2, 2 / math.pi * math.atan(warped), output="sos")
    period = math.ceil(fps / cutoff)
    least = max(10, period)

    def smooth(values: Array) -> Array:
        return np.asarray(sosfiltfilt(sections, values, axis=0, padlen=min(len(values) - 1, max(9, period))))

    return Filter(f"Butterworth of order 4 without lag, {cutoff:g} Hz", least, _weighted(smooth))


def savgol(cutoff: float, fps: float, size: float) -> Filter:
    """Savitzky-Golay: a cubic through as many frames as bring its gain at the cut-off nearest to -3 dB."""
    from scipy.signal import savgol_coeffs, savgol_filter

    def gain(half: int) -> float:
        taps = savgol_coeffs(2 * half + 1, _SAVGOL_DEGREE)
        return float(taps @ np.cos(2 * math.pi * cutoff / fps * np.arange(-half, half + 1)))

    # The gain falls with the window's length until far below -3 dB; twice Schafer's estimate (2011) is beyond that.
    period = fps / cutoff
    if period > _LONGEST:
        raise OptionError(
            f"smooth: cutoff: expected at least {1.05 * fps / _LONGEST:.2g} Hz for savgol at {fps:g} frames a second, "
            f"got {cutoff:g}: its window would be longer than {_LONGEST} frames"
        )
    below, above = 2, math.ceil(1.25 * period) + 4
    while above - below > 1:
        middle = (below + above) // 2
        below, above = (middle, above) if gain(middle) > math.sqrt(0.5) else (below, middle)
    half = 2  # the shortest that a cubic smooths: nothing cuts at a higher frequency
    if gain(half) > math.sqrt(0.5):
        half = min(below, above, key=lambda h: abs(gain(h) - math.sqrt(0.5)))
    window = 2 * half + 1

    def smooth(values: Array) -> Array:
        return np.asarray(savgol_filter(values, window, _SAVGOL_DEGREE, axis=0))

    words = f"Savitzky-Golay, a cubic over {window} frames, gain {gain(half):.2f} at {cutoff:g} Hz"
    return Filter(words, window, _weighted(smooth))


def one_euro(cutoff: float, fps: float, size: float) -> Filter:
    """One-euro filter (Casiez et al. 2012): causal; its cut-off rises by 1 Hz a body size a second of speed."""

    def smooth(values: Array, trust: Array) -> Array:
        gain = lambda hertz: 1 / (1 + fps / (2 * math.pi * hertz))  # noqa: E731
        out, speed = values.copy(), np.zeros(values.shape[1])
        for t in range(1, len(values)):  # recursive: each frame needs the one before
            speed = speed + gain(1.0) * trust[t] * ((values[t] - values[t - 1]) * fps - speed)
            rate = cutoff + float(np.linalg.norm(speed)) / size
            out[t] = out[t - 1] + gain(rate) * trust[t] * (values[t] - out[t - 1])
        return out

    return Filter(f"one-euro, from {cutoff:g} Hz, with its lag", 2, smooth)


FILTERS: dict[str, Callable[[float, float, float], Filter]] = {
    "butterworth": butterworth,
    "savgol": savgol,
    "one-euro": one_euro,
}
"""A filter from its cut-off in Hz, the frames a second and the body's size, by name."""


def _weighted(smooth: Callable[[Array], Array]) -> Callable[[Array, Array], Array]:
    """A linear smoother S for frames that count differently: the solution of x = S(x + w (y - x)).

    Where S = 1 / (1 + K), that is the minimum of sum w |y - x|^2 + x^T K x; for even weights it is S y itself.
    """

    def apply(values: Array, trust: Array) -> Array:
        out = smooth(values)
        if (trust >= 1).all():
            return out
        enough = 1e-6 * float(np.abs(values - values.mean(0)).max())
        for _ in range(_STEPS):
            before, out = out, smooth(out + trust[:, None] * (values - out))
            if float(np.abs(out - before).max()) <= enough:
                break
        return out

    return apply
