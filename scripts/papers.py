"""The tables of the two seed papers, as far as public data reaches: ``python scripts/benchmark.py paper.parts=all``.

A part is a function that yields rows; a row says under which ``setting`` and ``at`` which point of the table's top
line its figures were measured. :func:`make` runs parts and writes, for each, PART.csv (every run) and PART.png, and one
tables.md. What the parts measure is in ``papers_sfam.py`` (Kovalenko et al. 2019) and ``papers_kcs.py`` (Wandt et al.
2018). The data and the definitions of the figures are those of the measuring protocol beside the repository.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from robustness import Bench

from kcs_torch.errors import OptionError
from kcs_torch.io.atomic import atomic_path, write_table

Row = dict[str, Any]


@dataclass(frozen=True)
class Settings:
    """How much is measured.

    Attributes:
        bench: the protocol and its data.
        methods: names of the methods of the big tables.
        paths: random camera paths a walk.
        seeds: random draws of each disturbance.
        walks: of subject 35, at most.
        frames: of the longest clip whose time is measured.
    """

    bench: Bench
    methods: tuple[str, ...]
    paths: int = 20
    seeds: int = 2
    walks: int = 10
    frames: int = 3200


@dataclass(frozen=True)
class Part:
    """A table or figure of a paper.

    Attributes:
        title: what the paper calls it, and what is shown.
        at: what runs along the top line.
        figures: shown, one table each.
        run: yields the rows.
        log: whether its plot has logarithmic axes, and its table the slope there.
    """

    title: str
    at: str
    figures: tuple[str, ...]
    run: Callable[[Settings], Iterator[Row]]
    log: bool = False


def parts() -> dict[str, Part]:
    """All parts, in the papers' order."""
    import papers_kcs
    import papers_sfam

    return papers_sfam.PARTS | papers_kcs.PARTS


def chosen_parts(names: str | list[str]) -> dict[str, Part]:
    """The parts that are asked for: "all", a name or a list of names."""
    known = parts()
    wanted = list(known) if names == "all" else [names] if isinstance(names, str) else list(names)
    wrong = [name for name in wanted if name not in known]
    if wrong:
        raise OptionError(f"paper.parts={','.join(wrong)}: expected all or some of {', '.join(known)}")
    return {name: known[name] for name in wanted}


def pivot(rows: list[Row], figure: str) -> tuple[list[Any], dict[str, list[float]]]:
    """The means of a figure: points of the top line, and a value of each for every setting (NaN: not measured).

    A last value more is the mean over the top line; rows ``at`` None, of whose points nothing is known, tell it alone.
    """
    rows = [row for row in rows if not math.isnan(row.get(figure, math.nan))]
    top = list(dict.fromkeys(row["at"] for row in rows if row["at"] is not None))
    top = sorted(top) if all(isinstance(x, (int, float)) for x in top) else top
    mean: dict[str, list[float]] = {}
    for setting in dict.fromkeys(row["setting"] for row in rows):
        groups = [[row[figure] for row in rows if (row["setting"], row["at"]) == (setting, at)] for at in top]
        values = [float(np.mean(group)) if group else math.nan for group in groups]
        alone = [row[figure] for row in rows if (row["setting"], row["at"]) == (setting, None)]
        mean[setting] = [*values, float(np.mean(alone or values))]
    return top, mean


def slope(top: list[float], values: list[float]) -> float:
    """The exponent of growth: slope of log(value) over log(point), by least squares."""
    points = [(x, y) for x, y in zip(top, values, strict=True) if x > 0 and y > 0]
    if len(points) < 2:
        return math.nan
    along, up = np.log(np.array(points)).T
    return float(np.polyfit(along, up, 1)[0])


def markdown(part: Part, rows: list[Row]) -> str:
    """A Markdown table a figure."""
    lines = [f"## {part.title}"]
    for figure in part.figures:
        top, mean = pivot(rows, figure)
        if not mean:
            continue
        named = any(isinstance(x, str) for x in top)
        last = ["mean"] if named and len(top) > 1 else ["exponent"] if part.log else []
        head = [f"`{figure}` over {part.at}", *map(str, top), *last]
        lines += ["", "| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
        for setting, (*values, whole) in mean.items():
            extra = [whole] if last == ["mean"] else [slope(top, values)] if last else []
            lines.append("| " + " | ".join([setting, *map(number, [*values, *extra])]) + " |")
    return "\n".join(lines) + "\n"


def number(value: float) -> str:
    """Three or four figures, as papers print them."""
    if math.isnan(value):
        return "-"
    return f"{value:.4f}".lstrip("0") if value < 1 else f"{value:.2f}"


def plot(part: Part, rows: list[Row], path: Path) -> None:
    """Lines over a number, points over names (bars have no foot on a logarithmic axis); a panel a figure."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt
    from matplotlib.ticker import LogFormatter

    shown, panels = plt.subplots(1, len(part.figures), figsize=(6 * len(part.figures) + 2, 4.5), squeeze=False)
    settings = list(dict.fromkeys(row["setting"] for row in rows))
    colours = {setting: plt.get_cmap("tab20")(i % 20) for i, setting in enumerate(settings)}
    for axes, figure in zip(panels[0], part.figures, strict=True):
        top, mean = pivot(rows, figure)
        names = any(isinstance(x, str) for x in top)
        place = np.arange(len(top)) if names else np.array(top, dtype=float)
        for i, (setting, (*values, _)) in enumerate(mean.items()):
            style: dict[str, Any] = {"label": setting, "color": colours[setting]}
            if names:
                axes.plot(place + 0.8 * ((i + 0.5) / len(mean) - 0.5), values, "o", **style)
            else:
                axes.plot(place, values, marker="o", **style)
        if names:
            axes.set_xticks(place, top, rotation=30, ha="right")
            axes.set_xlim(-0.5, len(top) - 0.5)
            axes.set_yscale("log")
            axes.grid(axis="y", which="both", alpha=0.3)
        if part.log:
            axes.set(xscale="log", yscale="log")
        for axis in (axes.xaxis, axes.yaxis):
            if axis.get_scale() == "log":  # plain numbers: 30, not 3 x 10^1
                axis.set_major_formatter(LogFormatter())
                axis.set_minor_formatter(LogFormatter(minor_thresholds=(2, 0.5)))
        axes.set(xlabel=part.at, ylabel=figure)
    lines = {name: line for axes in panels[0] for line, name in zip(*axes.get_legend_handles_labels(), strict=True)}
    shown.suptitle(part.title, fontsize=10)
    shown.tight_layout()
    shown.legend(lines.values(), lines.keys(), loc="center left", bbox_to_anchor=(1, 0.5), fontsize=7)
    with atomic_path(path) as temporary:
        shown.savefig(temporary, dpi=80, bbox_inches="tight")
    plt.close(shown)


def make(names: str | list[str], settings: Settings, folder: Path) -> None:
    """Run parts and write their tables, rows and plots to a folder."""
    todo = chosen_parts(names)
    folder.mkdir(parents=True, exist_ok=True)
    tables = []
    for name, part in todo.items():
        rows = list(part.run(settings))
        write_table(folder / f"{name}.csv", rows)
        tables.append(markdown(part, rows))
        print(tables[-1], flush=True)
        plot(part, rows, folder / f"{name}.png")
        with atomic_path(folder / "tables.md") as temporary:
            temporary.write_text("\n".join(tables), encoding="utf-8")
    print(folder / "tables.md")
