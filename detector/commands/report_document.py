"""A report as JSON and as Markdown: the paper's Tables 1 and 2 beside its figures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

from detector.commands import side_by_side_table
from detector.commands.detect import as_dict, kind_of
from detector.commands.inputs import json_clean
from detector.commands.side_by_side_table import SideBySide
from detector.overlay import headline
from detector.report import P_SHOWN, LoopCost, Steps, votes

STEP_ROWS: Final = (
    ("", "frames", "frame quality"),
    ("2.1", "features", "feature extraction"),
    ("2.2", "flow", "optical flow and filters"),
    ("2.2", "clusters", "clusters of the flow, single plane"),
    ("2.3", "lines", "lines and vanishing points"),
    ("2.4", "vote", "vote"),
    ("", "contact", "time to contact"),
)
"""Section of the paper, name in the diagnostics, words, in the order of the paper's Table 2."""

_NOTE_ON_COSTS: Final = (
    "The rows without a section are not in the paper. Calls are those of Python and C functions, as a deterministic profiler counts "
    "them. In the other loops p, n and k are kept, and the earlier frame's key points are known."
)

CAPTIONS: Final = {
    "figure-3": "As the paper's Fig. 3: the flow before and after the filters, and what each filter dropped.",
    "figure-4": "As the paper's Fig. 4: the length and angular filters, and what p, n and k were chosen by.",
    "figure-5": "As the paper's Fig. 5: the flow and its clusters by magnitude, and the LMCC.",
    "figure-6": "As the paper's Fig. 6: lines, vanishing-point candidates by what the vote made of them, and the direction.",
}


@dataclass(frozen=True, slots=True)
class Report:
    """Everything that a report shows.

    Attributes
    ----------
    earlier, later
        Names of the two images.
    size_px
        Their width and height.
    preset
        Its name.
    steps
        What each step saw.
    first, other
        Cost of the first loop and of the others, each the median of ``loops``.
    pictures
        File names of the figures, by figure.
    side_by_side
        What all methods say of the pair.
    """

    earlier: str
    later: str
    size_px: tuple[int, int]
    preset: str
    steps: Steps
    first: LoopCost
    other: LoopCost
    loops: int
    pictures: dict[str, str]
    side_by_side: SideBySide


def as_json(report: Report) -> dict[str, Any]:
    """Return the report as plain values that JSON can hold; docs/report.md says what each is."""
    steps, found = report.steps, report.steps.result.detection.diagnostics
    chosen = zip(P_SHOWN, steps.survivors, steps.gains, strict=True) if steps.survivors else ()
    content = {
        "earlier": report.earlier,
        "later": report.later,
        "size_px": list(report.size_px),
        "preset": report.preset,
        "answer": as_dict(steps.result),
        "table_1": {
            "n_features_earlier": found.n_features_earlier,
            "n_features_later": found.n_features_later,
            "n_tracks": found.n_tracks,
            "n_after_distribution": found.n_after_distribution,
            "n_after_length": found.n_after_length,
            "n_after_angle": found.n_after_angle,
            "p": found.p,
            "n": found.n,
            "k": found.k,
        },
        "table_2": {
            "loops": report.loops,
            "first": _loop_json(report.first),
            "other": _loop_json(report.other),
        },
        "decisions": {
            "p": [{"p": p, "survivors": count, "gain": gain} for p, count, gain in chosen],
            "n": [
                {
                    "n": choice.n,
                    "calinski_harabasz": choice.calinski_harabasz,
                    "davies_bouldin": choice.davies_bouldin,
                    "ch_over_db": choice.quotient,
                }
                for choice in steps.n_choices
            ],
            "k": [
                {
                    "k": choice.k,
                    "magnitudes": [float(value) for value in choice.magnitudes],
                    "largest_change": choice.largest_change,
                }
                for choice in steps.k_choices
            ],
        },
        "magnitude_unit": steps.unit,
        "candidates": [
            {
                "x_px": vote.point_px[0],
                "y_px": vote.point_px[1],
                "role": vote.role.value,
                "magnitude": vote.magnitude,
                "difference_from_lmcc": vote.difference,
            }
            for vote in votes(steps)
        ],
        "side_by_side": side_by_side_table.as_json(report.side_by_side),
        "pictures": report.pictures,
    }
    cleaned: dict[str, Any] = json_clean(content)
    return cleaned


def _loop_json(cost: LoopCost) -> dict[str, Any]:
    return {
        "steps": {
            name: {"seconds": cost.seconds[name], "calls": cost.calls.get(name)} for name in cost.seconds
        },
        "total_seconds": cost.total_seconds,
        "total_calls": cost.total_calls,
    }


def as_markdown(report: Report) -> str:
    """Return the report for people, with the pictures that lie beside it."""
    detection = report.steps.result.detection
    found = detection.diagnostics
    width, height = report.size_px
    words = [
        f"# {report.earlier} and {report.later}",
        f"**{headline(detection)}**",
        f"{width} x {height} px, preset `{report.preset}`, answer of the first loop: `{kind_of(detection)}`.",
        "## Table 1: filters and clusters",
        _table(
            ("p", "n", "k", "N", "N'", "N''", "N'''", "key points, earlier", "key points, later"),
            [
                (
                    _known(found.p),
                    _known(found.n),
                    _known(found.k),
                    str(found.n_tracks),
                    str(found.n_after_distribution),
                    str(found.n_after_length),
                    str(found.n_after_angle),
                    str(found.n_features_earlier),
                    str(found.n_features_later),
                )
            ],
        ),
        "## Table 2: what each step costs",
        _table(
            ("section", "step", "first loop", "other loops", "calls, first", "calls, other"),
            _cost_rows(report.first, report.other),
        ),
        f"Medians of {report.loops} loops. {_NOTE_ON_COSTS}",
        *side_by_side_table.as_markdown(report.side_by_side),
    ]
    for name, file in report.pictures.items():
        words += [f"![{name}]({file})", f"*{CAPTIONS[name]}*"]
    missing = [name for name in CAPTIONS if name not in report.pictures]
    if missing:
        words.append(f"Not drawn, since the answer came before: {', '.join(missing)}.")
    return "\n\n".join(words) + "\n"


def _cost_rows(first: LoopCost, other: LoopCost) -> list[tuple[str, ...]]:
    known = {name for _, name, _ in STEP_ROWS}
    rest = [("", name, name) for name in first.seconds if name not in known]
    rows: list[tuple[str, ...]] = []
    for section, name, words in (*STEP_ROWS, *rest):
        if name not in first.seconds and name not in other.seconds:
            continue
        rows.append(
            (
                section,
                words,
                _milliseconds(first.seconds.get(name)),
                _milliseconds(other.seconds.get(name)),
                _count(first.calls.get(name)),
                _count(other.calls.get(name)),
            )
        )
    rows.append(
        (
            "",
            "**total**",
            _milliseconds(first.total_seconds),
            _milliseconds(other.total_seconds),
            _count(first.total_calls),
            _count(other.total_calls),
        )
    )
    rates = [
        cost.total_calls / cost.total_seconds if cost.total_seconds > 0.0 else math.nan
        for cost in (first, other)
    ]
    rows.append(("", "calls / total time", "", "", *(f"{rate / 1e3:.0f} kHz" for rate in rates)))
    return rows


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _milliseconds(seconds: float | None) -> str:
    return "" if seconds is None else f"{seconds * 1e3:.2f} ms"


def _count(calls: int | None) -> str:
    return "" if calls is None else f"{calls:,}"


def _known(value: int | None) -> str:
    return "" if value is None else str(value)
