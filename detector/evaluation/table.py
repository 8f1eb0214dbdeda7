"""Evaluations and comparisons as Markdown, for people."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

Record = Mapping[str, Any]

_DASH = "-"


def evaluations(summaries: Sequence[Record]) -> str:
    """Return two tables: how good the answers were, and which answers there were.

    Parameters
    ----------
    summaries
        Objects of :func:`detector.evaluation.run.summary`.
    """
    return "\n\n".join([_accuracy(summaries), _answers(summaries)])


def comparison(result: Record, first: str, second: str) -> str:
    """Return the tables of a comparison (:func:`detector.evaluation.comparison.compare`).

    Parameters
    ----------
    result
        What the comparison returned.
    first, second
        What was compared, in words.
    """
    entries = list(result["sets"])
    if len(entries) > 1:
        entries.append(result["all"])
    rows = [
        [
            entry["name"],
            figure["name"],
            _number(figure["first"]),
            _number(figure["second"]),
            _signed(figure["difference"]),
            _interval(figure["interval"], signed=True),
            figure["verdict"],
        ]
        for entry in entries
        for figure in entry["figures"]
    ]
    figures = _table(["set", "figure", first, second, "difference", "95 % interval", f"{first} is"], rows)
    agreement = _table(
        ["set", "pairs", "same kind", "both directions", "of those within W/20", "same answer"],
        [
            [
                entry["name"],
                *(
                    str(entry["agreement"][key])
                    for key in (
                        "pairs",
                        "same_kind",
                        "both_directions",
                        "within_twentieth_width",
                        "same_answer",
                    )
                ),
            ]
            for entry in entries
        ],
    )
    return f"{figures}\n\n{agreement}"


def _accuracy(summaries: Sequence[Record]) -> str:
    header = [
        "set", "method", "preset", "told", "pairs", "directions right", "by chance", "in box", "error (width)", "error (deg)",
        "profile ratio", "planes found", "false planes", "VP within W/10", "FOE (px)", "time to contact", "s median / p95",
    ]  # fmt: skip
    rows = []
    for item in summaries:
        direction, plane, lines = item["direction"], item["single_plane"], item["vanishing_point"]
        foe, contact, seconds = item["foe"], item["time_to_contact"], item["seconds"]
        boxed = any(record["in_box"] is not None for record in item["per_pair"])
        rows.append(
            [
                item["name"],
                item["method"],
                _preset(item),
                _told(item),
                str(item["pairs"]),
                _share(direction["right"], direction["with_truth"], direction["right_ci"]),
                _percent(direction["chance"]),
                str(direction["in_box"]) if boxed else _DASH,
                _number(direction["median_error_width"]),
                _number(direction["median_error_deg"]),
                _number(direction["median_profile_ratio"]),
                _share(plane["tp"], plane["tp"] + plane["fn"], plane["found_ci"]),
                _share(plane["fp"], plane["fp"] + plane["tn"], plane["false_ci"]),
                _share(lines["within_tenth_width"], lines["with_truth"], lines["within_tenth_width_ci"]),
                f"{_number(foe['median_px'])} ({foe['n']})" if foe["n"] else _DASH,
                f"{100.0 * contact['median_relative_error']:.1f} % ({contact['n']})"
                if contact["n"]
                else _DASH,
                f"{_number(seconds['median'])} / {_number(seconds['p95'])}",
            ]
        )
    return _table(header, rows)


def _answers(summaries: Sequence[Record]) -> str:
    rows = [
        [
            item["name"],
            item["method"],
            _preset(item),
            _told(item),
            str(item["pairs"]),
            _counts(item["kinds"]),
            _counts(item["reasons"]),
            f"{item['no_motion']['silent']} of {item['no_motion']['with_truth']}"
            if item["no_motion"]["with_truth"]
            else _DASH,
        ]
        for item in summaries
    ]
    return _table(
        ["set", "method", "preset", "told", "pairs", "answers", "reasons of none", "silent without motion"],
        rows,
    )


def _preset(item: Record) -> str:
    return ", ".join([item["preset"], *(f"{key}={value}" for key, value in item["changes"].items())])


def _told(item: Record) -> str:
    words = {"full": "rotation, translation", "rotation": "rotation", "none": "nothing"}[item["poses"]]
    parts = [words]
    if item["images"] == "derotated":
        parts.append("derotated")
    if item["loops"] == "sequence":
        parts.append("other loops")
    return ", ".join(parts)


def _share(hits: int, cases: int, interval: Sequence[float] | None) -> str:
    if not cases:
        return _DASH
    # An interval of no width would look like certainty.
    shown = "" if interval is None or interval[0] == interval[1] else f" ({_interval(interval)})"
    return f"{hits} of {cases}{shown}"


def _interval(interval: Sequence[float] | None, *, signed: bool = False) -> str:
    if interval is None:
        return _DASH
    return " .. ".join(_signed(value) if signed else _number(value) for value in interval)


def _number(value: float | None) -> str:
    return _DASH if value is None else f"{value:.3g}"


def _percent(value: float | None) -> str:
    return _DASH if value is None else f"{100.0 * value:.0f} %"


def _signed(value: float | None) -> str:
    return _DASH if value is None else f"{value:+.3g}"


def _counts(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {name}" for name, count in counts.items()) or _DASH


def _table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)
