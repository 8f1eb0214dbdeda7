"""The paper's Figs. 3 to 6 for one pair."""

from __future__ import annotations

import dataclasses
from typing import Final

import numpy as np
from numpy.typing import NDArray

from detector import outliers
from detector.drawing import sheet
from detector.drawing.chart import Bars, Chart, Rule, Series, draw_chart
from detector.drawing.frame import FrameCanvas
from detector.drawing.palette import (
    BLUE,
    CHART_BLUE,
    CHART_GREEN,
    CHART_PURPLE,
    CHART_VERMILLION,
    GREEN,
    GREY,
    INK,
    RED,
    SKY,
    WHITE,
    YELLOW,
    magnitude_colours,
)
from detector.overlay import CandidateRole, draw_candidates, headline, scale_begin, scale_end
from detector.params import DetectorParams
from detector.report import P_SHOWN, Pair, Steps, votes
from detector.results import Direction

Picture = NDArray[np.uint8]

_PANEL_PX: Final = 720
"""Width of a frame in a figure, whatever the size of the image."""
_CHART_PX: Final = (720, 420)
_BIN_DEG: Final = 5.0
_MANY: Final = 500
_LMCC: Final = "LMCC"


def figures(pair: Pair, steps: Steps, params: DetectorParams) -> dict[str, Picture]:
    """Return the figures that the pair came far enough for, by name (``figure-3`` to ``figure-6``)."""
    found = steps.result.detection.diagnostics
    drawn: dict[str, Picture] = {}
    if len(steps.tracks):
        drawn["figure-3"] = flow_figure(pair, steps)
    if found.p is not None:
        drawn["figure-4"] = decisions_figure(steps, params)
    if found.n is not None:
        drawn["figure-5"] = clusters_figure(pair, steps)
    if isinstance(steps.result.detection, Direction):
        drawn["figure-6"] = lines_figure(pair, steps, params)
    return drawn


def flow_figure(pair: Pair, steps: Steps) -> Picture:
    """Return Fig. 3: the flow before and after the filters, and what each filter dropped."""
    lengths = steps.tracks.lengths_px
    shown = lengths[steps.came_back] if steps.came_back.any() else lengths
    smallest, largest = scale_begin(shown), scale_end(shown)
    before, after = _canvas(pair), _canvas(pair)
    before.flow(steps.tracks, lengths, largest, smallest=smallest, thickness=_thickness(lengths))
    left = lengths[steps.kept]
    after.flow(steps.tracks[steps.kept], left, largest, smallest=smallest, thickness=_thickness(lengths))
    dropped = _canvas(pair)
    filters = (
        ("distribution filter", ~steps.came_back, CHART_VERMILLION),
        ("length filter", steps.came_back & ~steps.long_enough, CHART_BLUE),
        ("angular filter", steps.long_enough & ~steps.kept, CHART_GREEN),
    )
    for _, mask, colour in filters:
        lost = steps.tracks[mask]
        for start, end in zip(lost.start_px, lost.end_px, strict=True):
            dropped.vector(start, end, colour, 2)
    high = before.picture.shape[0]
    top = sheet.side_by_side(
        [
            sheet.captioned(before.picture, f"(a) before the filters: N = {len(steps.tracks)}"),
            sheet.captioned(after.picture, f"(b) after the filters: N''' = {int(steps.kept.sum())}"),
            sheet.colour_bar(smallest, largest, "flow [px]", high),
        ]
    )
    rows: list[sheet.Entry] = [
        ("line", colour, f"dropped by the {name}: {int(mask.sum())}") for name, mask, colour in filters
    ]
    counts = f"N = {len(steps.tracks)}, N' = {int(steps.came_back.sum())}, "
    counts += f"N'' = {int(steps.long_enough.sum())}, N''' = {int(steps.kept.sum())}"
    # A line of its own for each: the column is wide enough for any one of them alone.
    key = sheet.one_below_the_other([sheet.legend([row], _PANEL_PX) for row in rows])
    below = sheet.side_by_side(
        [sheet.captioned(dropped.picture, "(c) what the filters dropped"), sheet.captioned(key, counts)]
    )
    return sheet.framed(sheet.one_below_the_other([top, below]))


def decisions_figure(steps: Steps, params: DetectorParams) -> Picture:
    """Return Fig. 4: the length and angular filters, and the choice of p, n and k."""
    charts = [_length_chart(steps), _angle_chart(steps), _p_chart(steps, params)]
    if steps.n_choices:
        charts += [*_n_charts(steps), *_k_charts(steps, params)]
    panels = [
        draw_chart(_lettered(chart, letter), *_CHART_PX)
        for letter, chart in zip("abcdefgh", charts, strict=False)
    ]
    rows = [sheet.side_by_side(panels[i : i + 2]) for i in range(0, len(panels), 2)]
    return sheet.framed(sheet.one_below_the_other(rows))


def clusters_figure(pair: Pair, steps: Steps) -> Picture:
    """Return Fig. 5: the flow that is left, by its own magnitude and by that of its cluster, with the LMCC."""
    found = steps.result.detection.diagnostics
    kept, magnitudes = steps.tracks[steps.kept], steps.magnitudes
    centre_magnitudes = np.array(found.centre_magnitudes_px)
    smallest, largest = scale_begin(magnitudes), scale_end(magnitudes)
    each, grouped = _canvas(pair), _canvas(pair)
    each.flow(kept, magnitudes, largest, smallest=smallest, thickness=_thickness(magnitudes))
    # A cluster's magnitude is that of its centre; the labels are in the order of the centres.
    grouped.flow(kept, centre_magnitudes[steps.labels], largest, smallest=smallest, thickness=2)
    colours = magnitude_colours(centre_magnitudes, largest, smallest=smallest, on_light=True)
    for canvas in (each, grouped):
        for point, colour in zip(found.centre_points_px, colours, strict=True):
            fill = GREEN if canvas is each else (int(colour[0]), int(colour[1]), int(colour[2]))
            canvas.disc(point, 6, fill, rim=INK, rim_width=2)
        if found.lmcc_px is not None:
            canvas.disc(found.lmcc_px, 8, BLUE, rim=WHITE, rim_width=3)
            canvas.label(found.lmcc_px, _LMCC, 14)
    high = each.picture.shape[0]
    share = float(np.mean(magnitudes < 0.6 * magnitudes.max())) if len(magnitudes) else 0.0
    panels = sheet.side_by_side(
        [
            sheet.captioned(each.picture, f"(a) N''' = {len(kept)} vectors, each by its own magnitude"),
            sheet.captioned(
                grouped.picture,
                f"(b) n = {found.n} clusters, by the mean of the k = {found.k} vectors next to the centre",
            ),
            sheet.colour_bar(smallest, largest, _magnitude_label(steps), high),
        ]
    )
    words = f"{share:.0%} of the magnitudes lie below 60% of the largest"
    if found.plane_statistic is not None and found.plane_threshold is not None:
        words += f"; single-plane test: {found.plane_statistic:.3g} against {found.plane_threshold:.3g}"
    key = sheet.legend(
        [
            ("disc", GREEN, "cluster centre"),
            ("disc", BLUE, f"{_LMCC}, the centre of the lowest magnitude"),
        ],
        panels.shape[1],
    )
    return sheet.framed(sheet.captioned(sheet.one_below_the_other([panels, key]), words))


def lines_figure(pair: Pair, steps: Steps, params: DetectorParams) -> Picture:
    """Return Fig. 6: the lines behind the angle gate, the candidates by what the vote made of them, and the direction."""
    detection = steps.result.detection
    found = detection.diagnostics
    canvas = FrameCanvas(pair.later, _zoom(pair, 1.5))
    height, width = pair.later.shape
    canvas.line((0.0, height / 2.0), (float(width), height / 2.0), GREY, 1)
    for x1, y1, x2, y2 in found.lines_px:
        canvas.line((x1, y1), (x2, y2), SKY)
    for point in found.centre_points_px:
        canvas.disc(point, 4, GREEN)
    if isinstance(detection, Direction):
        canvas.cross((detection.x_px, detection.y_px))
    if found.lmcc_px is not None:
        canvas.disc(found.lmcc_px, 6, YELLOW)  # on the cross where the two are one
    draw_candidates(canvas, detection)
    wide = canvas.picture.shape[1]
    key = sheet.legend(
        [
            ("line", SKY, f"{len(found.lines_px)} of {found.n_lines} lines, by their angle"),
            ("disc", GREEN, "cluster centre"),
            ("disc", YELLOW, _LMCC),
            ("square", WHITE, "elected"),
            ("crossed square", RED, "examined and rejected"),
            ("diamond", BLUE, "valid, not examined"),
            ("cross", WHITE, "direction (x_d, y_d)"),
            ("line", GREY, "top of the region searched"),
        ],
        wide,
    )
    picture = sheet.captioned(canvas.picture, headline(detection))
    for vote in votes(steps):
        if vote.role is not CandidateRole.VALID:
            words = (
                f"{vote.role.value}: |L_VP - L_LMCC| / L_LMCC = {vote.difference:.1%}, "
                f"allowed below {params.vote_tolerance:.0%}"
            )
            picture = sheet.captioned(picture, words)
    return sheet.framed(sheet.one_below_the_other([picture, key]))


# ---------------------------------------------------------------------- Fig. 4


def _length_chart(steps: Steps) -> Chart:
    lengths = np.sort(steps.tracks[steps.came_back].lengths_px)
    n_dropped = int(steps.came_back.sum() - steps.long_enough.sum())
    rank = np.arange(1.0, len(lengths) + 1.0)
    return Chart(
        f"length filter: the {n_dropped} shortest of N' = {len(lengths)} are dropped",
        "rank by length",
        "length [px]",
        series=(
            Series(
                rank[:n_dropped], lengths[:n_dropped], CHART_VERMILLION, "dropped", markers=False, thickness=5
            ),
            Series(rank[n_dropped:], lengths[n_dropped:], CHART_BLUE, "kept", markers=False, thickness=5),
        ),
        at_x=(Rule(n_dropped + 0.5, f"N'' = {len(lengths) - n_dropped}"),),
    )


def _angle_chart(steps: Steps) -> Chart:
    p = steps.result.detection.diagnostics.p or 0
    angles = steps.tracks.angles_deg
    edges = np.arange(0.0, 360.0 + _BIN_DEG, _BIN_DEG)
    kept, _ = np.histogram(angles[steps.kept], edges)
    lost, _ = np.histogram(angles[steps.long_enough & ~steps.kept], edges)
    spread = steps.spread
    ends = (spread.mean_deg - p * spread.sigma_deg, spread.mean_deg + p * spread.sigma_deg)
    left, right = edges[:-1], edges[1:]
    return Chart(
        f"angular filter: mean {spread.mean_deg:.0f} deg, p sigma = {p} x {spread.sigma_deg:.0f} deg, "
        f"keeps {int(steps.kept.sum())} of {int(steps.long_enough.sum())}",
        "angle of the flow [deg]",
        f"vectors in {_BIN_DEG:g} deg",
        bars=(
            Bars(left, right, kept.astype(np.float64), CHART_BLUE, "kept"),
            Bars(left, right, lost.astype(np.float64), CHART_VERMILLION, "dropped"),
        ),
        at_x=(
            Rule(spread.mean_deg, "mean", GREY),
            Rule(ends[0], "- p sigma"),
            Rule(ends[1], "+ p sigma"),
        ),
        x_range=(min(0.0, ends[0] - 10.0), max(360.0, ends[1] + 10.0)),
    )


def _p_chart(steps: Steps, params: DetectorParams) -> Chart:
    p = steps.result.detection.diagnostics.p or 0
    gains = steps.gains
    notes = ["" if gain is None else f"+{gain:.1%}" for gain in gains]
    return Chart(
        f"p: the first from {outliers.P_RANGE[0]} on that gains less than {params.angle_gain:.0%} survivors",
        "p",
        "survivors N'''",
        series=(
            Series(
                np.array(P_SHOWN, np.float64), np.array(steps.survivors, np.float64), CHART_BLUE, notes=notes
            ),
        ),
        at_x=(Rule(float(p), f"p = {p}"),),
        x_range=(0.4, P_SHOWN[-1] + 0.6),
        y_range=(0.0, 1.25 * max(*steps.survivors, 1)),
        whole_x=True,
    )


def _n_charts(steps: Steps) -> list[Chart]:
    n = np.array([choice.n for choice in steps.n_choices], np.float64)
    chosen = float(steps.result.detection.diagnostics.n or 0)
    shown = (
        (
            "Calinski-Harabasz index: larger is better",
            "CH",
            [c.calinski_harabasz for c in steps.n_choices],
            CHART_BLUE,
        ),
        (
            "Davies-Bouldin index: smaller is better",
            "DB",
            [c.davies_bouldin for c in steps.n_choices],
            CHART_GREEN,
        ),
        ("n: the largest CH / DB", "CH / DB", [c.quotient for c in steps.n_choices], CHART_PURPLE),
    )
    return [
        Chart(
            title,
            "number of clusters n",
            label,
            series=(Series(n, np.array(values), colour),),
            at_x=(Rule(chosen, f"n = {chosen:.0f}"),),
            whole_x=True,
        )
        for title, label, values, colour in shown
    ]


def _k_charts(steps: Steps, params: DetectorParams) -> list[Chart]:
    found = steps.result.detection.diagnostics
    k = np.array([choice.k for choice in steps.k_choices], np.float64)
    estimates = np.array([choice.magnitudes for choice in steps.k_choices])
    lowest = int(np.argmin(found.centre_magnitudes_px))
    others = [index for index in range(estimates.shape[1]) if index != lowest]
    curves = [
        Series(k, estimates[:, index], GREY, "cluster centres" if index == others[0] else "", markers=False)
        for index in others
    ]
    curves.append(Series(k, estimates[:, lowest], CHART_BLUE, _LMCC))
    changes = np.array(
        [np.nan if c.largest_change is None else 100.0 * c.largest_change for c in steps.k_choices]
    )
    at_k = (Rule(float(found.k or 0), f"k = {found.k}"),)
    return [
        Chart(
            "magnitude of each centre, by its k nearest vectors",
            "nearest neighbours k",
            f"mean {_magnitude_label(steps)}",
            series=curves,
            at_x=at_k,
            whole_x=True,
        ),
        Chart(
            f"k: the first whose estimates all change by less than {params.nearest_change:.0%}",
            "nearest neighbours k",
            "largest change [%]",
            series=(Series(k, changes, CHART_BLUE),),
            at_x=at_k,
            at_y=(Rule(100.0 * params.nearest_change, "limit", CHART_VERMILLION),),
            whole_x=True,
            x_range=(k[0] - 1.5, k[-1] + 1.5),
        ),
    ]


def _lettered(chart: Chart, letter: str) -> Chart:
    return dataclasses.replace(chart, title=f"({letter}) {chart.title}")


# ---------------------------------------------------------------------- frames


def _canvas(pair: Pair) -> FrameCanvas:
    return FrameCanvas(pair.later, _zoom(pair), "light")


def _zoom(pair: Pair, factor: float = 1.0) -> float:
    return float(factor * _PANEL_PX / pair.later.shape[1])


def _thickness(shown: NDArray[np.float64]) -> int:
    """Return the thickness of flow vectors: many of them are drawn thin."""
    return 2 if len(shown) < _MANY else 1


def _magnitude_label(steps: Steps) -> str:
    return "flow [px]" if steps.unit == "px" else f"[{steps.unit}]"
