"""The figures of docs/performance.md: `detector bench` on the generated corridor and on real footage, in one run.

    python benchmarks/detector.py [the options of detector bench] [--write]

--write puts the tables, the plot and all figures as JSON into docs/. Without frames the footage is the walk through an office that the demo uses; it is
540 x 360, so larger sizes of it are enlarged and hold no finer detail. On a quiet machine this takes some five minutes on two cores.
"""

from __future__ import annotations

import argparse
import datetime
import json
import sys
from pathlib import Path

# This folder holds a detector.py too, and Python looks here first.
if __name__ == "__main__":
    sys.path[0] = str(Path(__file__).parents[1])

from detector.commands import bench, inputs
from detector.commands.inputs import InputError
from detector.drawing.performance import performance_chart

ROOT = Path(__file__).parents[1]
PAGE, PICTURE = ROOT / "docs" / "performance.md", ROOT / "docs" / "images" / "performance.png"
FIGURES = ROOT / "docs" / "images" / "performance.json"
WALK = ROOT / "companion" / "sim" / "data" / "office_walk" / "images"
BEGIN, END = "<!-- figures begin: benchmarks/detector.py --write -->", "<!-- figures end -->"
PICTURE_WORDS = """\
![Time against image size and number of points](images/performance.png)

Left: a pair at each size, generated corridor, one thread. Right: the other loops with the cap `fast_points` set to 150 .. 1200. Below: the methods and rivals alone."""
STEPS = ("frames", "features", "flow", "clusters", "lines", "vote", "contact")


def steps_table(figures: dict) -> str:
    lines = ["| size | loop | " + " | ".join(STEPS) + " |", "|---" * (len(STEPS) + 2) + "|"]
    for size, row in figures["sizes"].items():
        for loop in ("first", "other"):
            times = [row["steps"][loop].get(step) for step in STEPS]
            cells = ["-" if time is None else f"{time['median'] * 1e3:.1f}" for time in times]
            lines.append(f"| {size.replace('x', ' x ')} | {loop} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def page_with(page: str, figures: str) -> str:
    head, rest = page.split(BEGIN)
    return f"{head}{BEGIN}\n{figures}\n{END}{rest.split(END)[1]}"


def report(results: list[dict]) -> str:
    day = datetime.datetime.now(datetime.UTC).date().isoformat()
    parts = [f"Measured {day}."]
    for figures in results:
        load = figures["load_average"]
        waited = (
            "" if figures["clock"] == "wall" else ", which is why processor time is given, not elapsed time"
        )
        parts += [
            f"### {figures['frames'][0].upper()}{figures['frames'][1:]}",
            bench.table_of(figures),
            f"Load average of the machine before and after: {load['before']:.1f}, {load['after']:.1f}{waited}. Passes: {figures['repeats']}.",
            f"Our steps, ms (medians, {figures['threads']} thread; of the other loops without the renewal):",
            steps_table(figures),
        ]
    parts += [PICTURE_WORDS]
    return "\n\n".join(parts)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    bench.add_arguments(parser)
    parser.add_argument("--write", action="store_true", help="into docs/performance.md and its picture")
    options = parser.parse_args()
    try:
        if options.plot is not None:
            inputs.check_picture_path("--plot", options.plot)
        results = []
        for frames in ([], options.frames or [WALK]):
            options.frames = frames
            results.append(bench.figures_of(options))
        picture = performance_chart(results[0])
        if options.plot is not None:
            inputs.write_picture("--plot", options.plot, picture)
        if options.write:
            PAGE.write_text(page_with(PAGE.read_text(encoding="utf-8"), report(results)), encoding="utf-8")
            inputs.write_picture("--write", PICTURE, picture)
            FIGURES.write_text(json.dumps(inputs.json_clean(results), indent=1) + "\n", encoding="utf-8")
    except InputError as error:
        print(f"benchmarks/detector.py: error: {error}", file=sys.stderr)
        return 2
    print(json.dumps(inputs.json_clean(results)) if options.json else report(results))
    return 0


if __name__ == "__main__":
    sys.exit(main())
