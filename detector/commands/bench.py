"""``detector bench``: how long the detector takes, beside the literal method, its floor and structure from motion."""

from __future__ import annotations

import argparse
import json
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from detector.commands import inputs
from detector.commands.clips import poses_beside
from detector.commands.inputs import InputError

if TYPE_CHECKING:
    from detector.bench_frames import Stream
    from detector.camera_model import CameraModel
    from detector.observer import CameraPose

_DESCRIPTION: Final = """\
Measure seconds and memory on this machine: all that is compared runs in turns on the same frames.
"""

_EPILOG: Final = """\
frames
  A B       two images; the camera goes there and back between them, which makes a stream
  DIR       images in the order of their names, each paired with the one before; where a groundtruth.json names pairs, the
            longest run of pairs of which each begins where the one before ended
  nothing   a corridor that is made here, at each size itself
  Given frames are cut about their middle to the shape of each size and resized, which adds no detail.

what is measured (seconds; a pair without an answer does not count)
  literal, literal_other   the literal transcription of the paper, its first loop and its others (in a checkout, else null)
  first                    our first loop: both frames prepared, p, n and k estimated
  other                    our other loops in a stream: one frame prepared, one pair answered, p, n and k kept
  floor                    Lucas-Kanade alone, there and back, on the points that other started from
  parallax                 the method parallax in a stream without poses: one frame prepared, one pair answered
  parallax_poses           the same told the poses, where the frames have them: the corridor, and a DIR with a groundtruth.json or poses.json
  flow_balance, line_vp    rivals for scale, from two plain frames; their time counts with and without an answer, they have looked either way
                           (the third rival, the middle of the image, has nothing to measure)
  sfm                      two-view structure from motion
Ratios are medians over the pairs of the ratio on each pair; the methods and rivals are given as multiples of the floor.

JSON keys: docs/performance.md

exit code
  0  done
  2  the command line or a file that it names cannot be used; one line on stderr says which and why
"""

_SIZES: Final = ((640, 480), (1280, 720), (540, 360))
_SUFFIXES: Final = frozenset({".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff", ".pgm"})
_FEWEST_FRAMES: Final = 6
_MOST_SIDE_PX: Final = 4096
_LEAST_SIDE_PX: Final = 64
_MS: Final = 1e3


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the parser of ``detector``."""
    parser = commands.add_parser(
        "bench",
        help="measure its speed and memory",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_arguments(parser)
    parser.set_defaults(run=_run)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add what the command takes; :func:`figures_of` reads it."""
    parser.add_argument("frames", type=Path, nargs="*", metavar="A B | DIR", help="images, see below")
    parser.add_argument(
        "--size",
        type=_size,
        action="append",
        metavar="WxH",
        help="may be repeated (default: 640x480, 1280x720 and 540x360)",
    )
    inputs.add_params_arguments(parser)
    parser.add_argument(
        "--exact", action="store_true", help="measure the exact path in place of the fast one"
    )
    parser.add_argument(
        "--repeats", type=_count, default=3, metavar="N", help="passes over the frames (default: %(default)s)"
    )
    parser.add_argument(
        "--count", type=_count, default=10, metavar="N", help="most frames used (default: %(default)s)"
    )
    parser.add_argument(
        "--threads",
        type=_count,
        action="append",
        metavar="N",
        help="may be repeated; the first is what sizes holds (default: 1, then 2)",
    )
    parser.add_argument(
        "--clock",
        choices=("wall", "cpu"),
        default="wall",
        help="elapsed time, or processor time where the machine has other work (default: %(default)s)",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--plot", type=Path, metavar="OUT.png", help="draw time against size and points")


def figures_of(options: argparse.Namespace) -> dict[str, Any]:
    """Measure what the options ask for; the keys are those of the JSON.

    Raises
    ------
    InputError
        The frames or parameters cannot be used.
    """
    from detector import bench, bench_frames
    from detector.camera_model import CameraError

    params = inputs.params_of(options)
    if options.exact:
        params = params.model_copy(update={"speed": "exact"})
    sizes = tuple(dict.fromkeys(options.size or _SIZES))
    for width, height in sizes:
        if width < params.min_width_px or height < params.min_height_px:
            raise InputError(
                f"--size {width}x{height}: allowed is {params.min_width_px}x{params.min_height_px} and more"
            )
    count = max(options.count, 3)
    if options.frames:
        given, source = _given(options.frames, count)
        try:
            streams = {
                size: bench_frames.there_and_back(bench_frames.resized_stream(given, size), _FEWEST_FRAMES)
                for size in sizes
            }
        except CameraError as error:
            raise InputError(inputs.one_line(f"{options.frames[0]}: K: {error}")) from error
    else:
        streams = {size: bench_frames.generated_stream(size, count) for size in sizes}
        source = "generated corridor"
    figures = bench.run(
        streams,
        params,
        repeats=options.repeats,
        threads=tuple(dict.fromkeys(options.threads or (1, 2))),
        literal=bench.literal_reference(),
        clock=options.clock,
        progress=_say if sys.stderr.isatty() else None,
    )
    return {"preset": options.preset, "frames": source, **figures}


def table_of(figures: dict[str, Any]) -> str:
    """Return the figures for people, as Markdown."""
    blocks = {str(figures["threads"]): figures["sizes"], **figures["more_threads"]}
    lines = [
        (
            "| size | threads | literal first, other | ours first | ours other, p95 | then renewal, p95 | LK floor | parallax, p95 | parallax with poses, p95 | flow balance, p95 | line VP, p95 "
            "| SfM | literal / first | literal / other | other / floor | parallax, with poses / floor | flow balance, line VP / floor | peak |"
        ),
        "|---" * 18 + "|",
    ]
    for threads, sizes in blocks.items():
        for size, row in sizes.items():
            cells = [
                size.replace("x", " x "),
                threads,
                f"{_ms(row['literal_s'])}, {_ms(row['literal_other_s'])}",
                _ms(row["first_s"]),
                f"{_ms(row['other_s'])}, {_ms(row['other_s'], 'p95')}",
                f"{_ms(row['renewal_s'])}, {_ms(row['renewal_s'], 'p95')}",
                _ms(row["floor_s"]),
                *(
                    f"{_ms(row[f'{name}_s'])}, {_ms(row[f'{name}_s'], 'p95')}"
                    for name in ("parallax", "parallax_poses", "flow_balance", "line_vp")
                ),
                _ms(row["sfm_s"]),
                *(
                    ", ".join(_times(row[key]) for key in keys)
                    for keys in (
                        ("literal_over_first",),
                        ("literal_over_other",),
                        ("other_over_floor",),
                        ("parallax_over_floor", "parallax_poses_over_floor"),
                        ("flow_balance_over_floor", "line_vp_over_floor"),
                    )
                ),
                "-" if row["peak_mb"] is None else f"{row['peak_mb']:.0f} MB",
            ]
            lines.append(f"| {' | '.join(cells)} |")
    machine = figures["machine"]
    lines += [
        "",
        f"Times in ms (medians{', processor time' if figures['clock'] == 'cpu' else ''}). Frames: {figures['frames']}. Preset {figures['preset']}, speed {figures['speed']}, "
        + (
            "no literal transcription here. "
            if figures["literal_n_init"] is None
            else f"literal n_init {figures['literal_n_init']}. "
        )
        + f"{machine['processor']}, {machine['cores']} cores, OpenCV {machine['opencv']}, Python {machine['python']}.",
    ]
    return "\n".join(lines)


def _run(options: argparse.Namespace) -> int:
    if options.plot is not None:
        inputs.check_picture_path("--plot", options.plot)
    figures = figures_of(options)
    if options.plot is not None:
        from detector.drawing.performance import performance_chart

        inputs.write_picture("--plot", options.plot, performance_chart(figures))
    print(json.dumps(inputs.json_clean(figures), allow_nan=False) if options.json else table_of(figures))
    return 0


# ---------------------------------------------------------------------- input


def _given(paths: list[Path], count: int) -> tuple[Stream, str]:
    """Return the images that the command line names, with what is known of them, and how to call them."""
    from detector.bench_frames import Stream

    camera: CameraModel | None = None
    poses: dict[str, CameraPose] = {}
    if len(paths) == 1 and not paths[0].exists():
        raise InputError(f"{paths[0]}: cannot be read: No such file or directory")
    if len(paths) == 1 and paths[0].is_dir():
        files = _files_of(paths[0])[:count]
        if len(files) < 2:
            raise InputError(f"{paths[0]}: found {len(files)} images, needed are 2 of one walk")
        folder = paths[0].resolve()
        name = folder.parent.name if folder.name == "images" else folder.name
        source = f"{name}, {len(files)} frames, resized"
        camera, poses = poses_beside(paths[0])
    elif len(paths) == 2 and not any(path.is_dir() for path in paths):
        files, source = paths, f"{paths[0].name} and {paths[1].name} there and back, resized"
    else:
        raise InputError(
            f"found {len(paths)} paths ({' '.join(str(p) for p in paths[:3])}), allowed are two images or one folder"
        )
    images = [inputs.read_image(file) for file in files]
    for file, image in zip(files, images, strict=True):
        if image.shape != images[0].shape:
            raise InputError(
                f"{file}: found {image.shape[1]} x {image.shape[0]} px, {files[0].name} has "
                f"{images[0].shape[1]} x {images[0].shape[0]}"
            )
    size = (images[0].shape[1], images[0].shape[0])
    if camera is not None and (camera.width_px, camera.height_px) != size:
        raise InputError(
            f"{files[0]}: found {size[0]} x {size[1]} px, its K is for {camera.width_px} x {camera.height_px}"
        )
    of_files = [poses.get(file.name) for file in files]
    known = tuple(pose for pose in of_files if pose is not None)
    return Stream(tuple(images), camera, known if len(known) == len(files) else ()), source


def _files_of(folder: Path) -> list[Path]:
    from detector.evaluation.dataset import TRUTH_FILE, DatasetError, load_truth

    if (folder / TRUTH_FILE).is_file():
        try:
            images = load_truth(folder / TRUTH_FILE)
        except DatasetError as error:
            raise InputError(inputs.one_line(error)) from error
        if images.pairs:
            return [folder / name for name in longest_run([(pair.a, pair.b) for pair in images.pairs])]
    try:
        files = sorted(path for path in folder.iterdir() if path.suffix.lower() in _SUFFIXES)
        if not files and (folder / "images").is_dir():
            files = sorted(path for path in (folder / "images").iterdir() if path.suffix.lower() in _SUFFIXES)
    except OSError as error:
        raise InputError(f"{folder}: cannot be read: {inputs.cause(error)}") from error
    return files


def longest_run(pairs: list[tuple[str, str]]) -> list[str]:
    """Return the frames of the longest run of pairs of which each begins with the frame that the one before ended with."""
    best: list[str] = []
    run: list[str] = []
    for a, b in pairs:
        run = [*run, b] if run and run[-1] == a else [a, b]
        if len(run) > len(best):
            best = run
    return best


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d{1,5})[xX](\d{1,5})", text)
    size = (0, 0) if match is None else (int(match[1]), int(match[2]))
    if not all(_LEAST_SIDE_PX <= side <= _MOST_SIDE_PX for side in size):
        raise argparse.ArgumentTypeError(
            f"found {text!r}, allowed is WIDTHxHEIGHT of {_LEAST_SIDE_PX} to {_MOST_SIDE_PX} px, such as 640x480"
        )
    return size


def _count(text: str) -> int:
    if not (text.isascii() and text.isdigit() and 1 <= int(text) <= 1000):
        raise argparse.ArgumentTypeError(f"found {text!r}, allowed are whole numbers from 1 to 1000")
    return int(text)


def _say(what: str) -> None:
    print(f"bench: {what}", file=sys.stderr)


def _ms(spread: dict[str, float] | None, which: str = "median") -> str:
    return "-" if spread is None else f"{spread[which] * _MS:.1f}"


def _times(ratio: float | None) -> str:
    return "-" if ratio is None else f"{ratio:.1f}"
