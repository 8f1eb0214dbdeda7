"""What all methods say of the pair of a report: found beside the images where truth lies there, as JSON and as Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from detector.commands import inputs
from detector.commands.clips import known_beside
from detector.commands.inputs import InputError
from detector.evaluation.dataset import TRUTH_FILE, DatasetError, Pair, load_truth
from detector.evaluation.methods import PairInput
from detector.evaluation.side_by_side import KnownPair, MethodAnswer, answer_side_by_side
from detector.params import DetectorParams

_HEAD: Final = ("method", "answer", "direction (px)", "confidence", "time", "right")
_LEAST_SHOWN_S: Final = 1e-4


@dataclass(frozen=True, slots=True)
class SideBySide:
    """All methods on the pair of a report.

    Attributes
    ----------
    rows
        One a method.
    told
        What they were told beside the images: of ``camera``, ``rotation``, ``translation``.
    truth
        Name of the set that they were judged by; None where there is none.
    loops
        Times that each was timed.
    """

    rows: tuple[MethodAnswer, ...]
    told: tuple[str, ...]
    truth: str | None
    loops: int


def side_by_side(pair: PairInput, params: DetectorParams, known: KnownPair | None, loops: int) -> SideBySide:
    """Run all methods on the pair of a report."""
    given = {
        "camera": pair.camera,
        "rotation": pair.later_from_earlier,
        "translation": pair.translation_earlier_m,
    }
    return SideBySide(
        answer_side_by_side(pair, params, known=known, loops=loops),
        tuple(name for name, value in given.items() if value is not None),
        None if known is None else known.images.name,
        loops,
    )


def known_pair(earlier: Path, later: Path, size_px: tuple[int, int]) -> KnownPair | None:
    """Return what a ``groundtruth.json`` beside two images knows of them as a pair; None where there is none, or it does not know both.

    Parameters
    ----------
    earlier, later
        The image files.
    size_px
        Width and height of the later one.

    Raises
    ------
    InputError
        The file cannot be used, or is of images of another size.
    """
    file = known_beside(later.parent, TRUTH_FILE)
    if file is None:
        return None
    try:
        images = load_truth(file)
    except DatasetError as error:
        raise InputError(inputs.one_line(f"{error} (--no-truth leaves it aside)")) from error
    named = {(images.folder / name).resolve(): name for name in images.frames}
    a, b = named.get(earlier.resolve()), named.get(later.resolve())
    if a is None or b is None:
        return None
    if images.image_size_px not in (None, size_px):
        raise InputError(
            f"{file}: image_size: found {images.image_size_px}, {later.name} has {size_px} (--no-truth leaves it aside)"
        )
    listed = (each for each in images.pairs if (each.a, each.b) == (a, b))
    return KnownPair(images, next(listed, None) or Pair(a=a, b=b))


def as_json(found: SideBySide) -> dict[str, Any]:
    """Return the table as plain values; docs/report.md says what each is."""
    return {
        "loops": found.loops,
        "told": list(found.told),
        "truth": found.truth,
        "methods": [_row_json(row) for row in found.rows],
    }


def _row_json(row: MethodAnswer) -> dict[str, Any]:
    answer, verdict = row.answer, row.verdict
    x_px, y_px = answer.point_px or (None, None)
    return {
        "method": row.method,
        "kind": answer.kind,
        "reason": answer.reason,
        "x_px": x_px,
        "y_px": y_px,
        "confidence": answer.confidence,
        "time_to_contact_frames": answer.contact_frames,
        "seconds": row.seconds,
        "right": row.right,
        "error_deg": None if verdict is None else verdict.error_deg,
        "profile_ratio": None if verdict is None else verdict.profile_ratio,
    }


def as_markdown(found: SideBySide) -> list[str]:
    """Return the paragraphs of the table, its heading first."""
    lines = [_HEAD, tuple("---" for _ in _HEAD), *(_row(row) for row in found.rows)]
    told = (
        f"Told beside the images: {', '.join(found.told)}." if found.told else "Told nothing but the images."
    )
    judged = (
        "Whether they are right is not known: no `groundtruth.json` beside the images knows this pair."
        if found.truth is None
        else f"Judged by the truth of `{found.truth}`, of which no method was told."
    )
    return [
        "## Side by side",
        "\n".join(f"| {' | '.join(line)} |" for line in lines),
        f"Each as a first loop, medians of {found.loops} in turns; `straight`, `flow_balance` and `line_vp` are rivals for scale. {told} {judged}",
    ]


def _row(row: MethodAnswer) -> Sequence[str]:
    answer = row.answer
    silent = row.right is None and row.verdict is not None and answer.reason is not None
    return (
        f"`{row.method}`",
        answer.kind if answer.reason is None else f"{answer.kind} ({answer.reason})",
        "" if answer.point_px is None else f"{answer.point_px[0]:.0f}, {answer.point_px[1]:.0f}",
        "" if answer.confidence is None else f"{answer.confidence:.2f}",
        _milliseconds(row.seconds),
        "no answer" if silent else {True: "right", False: "wrong", None: "not known"}[row.right],
    )


def _milliseconds(seconds: float) -> str:
    return f"{seconds * 1e3:.1f} ms" if seconds >= _LEAST_SHOWN_S else "< 0.1 ms"
