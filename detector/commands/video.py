"""``detector video SOURCE -o OUT.mp4``: a clip with the answer on every frame."""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import sys
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Final

from detector.commands import inputs
from detector.commands.inputs import InputError
from detector.commands.stopping import stop_request

if TYPE_CHECKING:
    from detector.camera_model import CameraModel
    from detector.commands.clips import ClipFrame, ClipWriter, FolderClip, VideoClip
    from detector.observer import CameraPose
    from detector.video import Answered, FrameAnswerer

_DESCRIPTION: Final = """\
Run one or more methods on a clip as a vehicle would, and write the clip with the answer drawn on every frame.
"""

_EPILOG: Final = """\
SOURCE is a video file, or a folder of images, which are taken in natural order of their names. Beside the images, or beside
their folder when that is called images, there may be a groundtruth.json or poses.json with K and poses: they are used, so
that pairs are chosen by the distance flown and rotation is taken out. Without poses pairs are chosen by the median flow.

--method NAME[,NAME...]
  paper         flow clusters and lines
  parallax      the void map, drawn too where poses are known
  straight      rival: the middle of the picture
  flow_balance  rival: away from the side where more moves
  line_vp       rival: the vanishing point of the lines alone
  Several make one film, with a panel for each and its name below; --method may also be repeated. All choose their pairs alike.

JSON lines
  One object a frame and method, with the keys of "detector detect --json" (see there; null what a rival does not say) and
  method      its name
  frame       number of the frame, from 0
  file        name of its file; null in a video
  time_s      since the first frame
  earlier_time_s
              of the frame that it was paired with; null where there was none
  baseline_m  metres between the two, where both poses are known

exit code
  0    written
  2    the command line or a file that it names cannot be used; one line on stderr says which and why
  130  interrupted (Ctrl-C); what was written until then can be played
  143  terminated (SIGTERM); the same
"""

_MAX_FRAMES: Final = 100_000_000


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the parser of ``detector``."""
    parser = commands.add_parser(
        "video",
        help="a clip with the answer on every frame",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("source", type=Path, metavar="SOURCE", help="video file or folder of images")
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="OUT.mp4",
        help="video to write (.mp4, .avi, .mkv, .mov, .webm)",
    )
    parser.add_argument("--json-lines", type=Path, metavar="FILE", help="write one JSON object a frame")
    parser.add_argument(
        "--method",
        action="append",
        metavar="NAME[,NAME...]",
        help="whose answers, see below; several are shown side by side (default: paper)",
    )
    inputs.add_params_arguments(parser)
    inputs.add_camera_arguments(parser)
    parser.add_argument(
        "--baseline-frames",
        type=_count,
        metavar="N",
        help="pair each frame with the one N frames before it, in place of choosing by distance or flow; with the method paper alone",
    )
    parser.add_argument("--limit", type=_count, metavar="N", help="stop after N frames")
    parser.add_argument(
        "--rate",
        type=_hertz,
        default=10.0,
        metavar="HZ",
        help="frames/s of a folder, and of a video that does not say (default: %(default)g)",
    )
    parser.add_argument(
        "--no-poses", action="store_true", help="leave a groundtruth.json or poses.json aside"
    )
    parser.add_argument(
        "--codec",
        type=_four_characters,
        metavar="FOURCC",
        help="four characters (default: by the ending of OUT, mp4v for .mp4)",
    )
    parser.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> int:
    from detector.commands.clips import ClipWriter, FolderClip, open_clip, poses_of

    inputs.params_of(options)  # before anything is written
    methods = inputs.methods_of("--method", options.method or ["paper"])
    if methods != ("paper",) and options.baseline_frames is not None:
        raise InputError("--baseline-frames: only with --method paper, the others choose their pairs")
    _refuse_overwriting(options.source, options.output)
    clip = open_clip(options.source, options.rate)
    camera: CameraModel | None = None
    poses: dict[str, CameraPose] = {}
    if isinstance(clip, FolderClip) and not options.no_poses:
        camera, poses = poses_of(clip)
    kinds: dict[str, Counter[str]] = {name: Counter() for name in methods}
    with (
        stop_request() as stop,  # around the file, so that it is closed whatever comes
        ClipWriter(options.output, clip.rate_hz, options.codec) as writer,
        _lines(options.json_lines) as lines,
    ):
        interrupted = False
        try:
            with contextlib.closing(_answers(options, methods, clip, camera, poses)) as answers:
                for number, frame, answered in answers:
                    _write(writer, lines, number, frame, answered)
                    for name, each in answered.items():
                        kinds[name][each.answer.kind] += 1
                    if stop.by is not None:
                        interrupted = True
                        break
        except KeyboardInterrupt:
            interrupted = True
        finally:
            stop.hurry = False
    if writer.written:
        writer.check()
    if interrupted:
        print(f"detector: interrupted: {options.output} holds {writer.written} frames", file=sys.stderr)
        return stop.exit_code
    found = "; ".join(
        ("" if len(kinds) == 1 else f"{name}: ")
        + ", ".join(f"{kind} {count}" for kind, count in counts.most_common())
        for name, counts in kinds.items()
    )
    wanted = _wanted(options, clip)
    of = f" (the source states {wanted})" if wanted is not None and wanted > writer.written else ""
    print(f"{options.output}: {writer.written} frames{of}: {found}")
    return 0


def _answers(
    options: argparse.Namespace,
    methods: Sequence[str],
    clip: FolderClip | VideoClip,
    known_camera: CameraModel | None,
    poses: dict[str, CameraPose],
) -> Generator[tuple[int, ClipFrame, dict[str, Answered]]]:
    """Answer on the frames one by one, by each method, with a progress bar on a terminal."""
    answerers: dict[str, FrameAnswerer] = {}
    with _progress(_wanted(options, clip)) as advance:
        for number, frame in enumerate(islice(clip.frames(), options.limit)):
            if not answerers:
                height_px, width_px = frame.image.shape
                camera = inputs.camera_of(options, width_px, height_px)
                if options.hfov is None and options.camera is None:
                    camera = known_camera
                answerers = {name: _answerer(name, options, camera) for name in methods}
            pose = None if frame.name is None else poses.get(frame.name)
            time_ns = round(frame.time_s * 1e9)
            yield number, frame, {name: each(frame.image, time_ns, pose) for name, each in answerers.items()}
            advance()


def _answerer(method: str, options: argparse.Namespace, camera: CameraModel | None) -> FrameAnswerer:
    from detector.evaluation.methods import METHODS
    from detector.parallax_video import by_parallax
    from detector.rival_video import by_rival
    from detector.video import by_fixed_step, by_observer

    params = inputs.params_of(options)
    if method == "parallax":
        return by_parallax(camera)
    if method != "paper":
        return by_rival(METHODS[method](params), params, camera)
    if options.baseline_frames is not None:
        return by_fixed_step(params, camera, options.baseline_frames)
    return by_observer(params, camera)


def _wanted(options: argparse.Namespace, clip: FolderClip | VideoClip) -> int | None:
    """Return how many frames there should be; None where the source does not say."""
    limit: int | None = options.limit
    if clip.total is None or limit is None:
        return clip.total
    return min(limit, clip.total)


def _write(
    writer: ClipWriter,
    lines: IO[str] | None,
    number: int,
    frame: ClipFrame,
    answered: dict[str, Answered],
) -> None:
    from detector.video import side_by_side

    writer.write(side_by_side(frame.image, answered, number, frame.time_s))
    if lines is None:
        return
    for name, each in answered.items():
        try:
            lines.write(json.dumps(_record(number, frame, name, each), allow_nan=False) + "\n")
        except OSError as error:
            raise InputError(
                f"--json-lines {lines.name}: cannot be written: {inputs.cause(error)}"
            ) from error


def _record(number: int, frame: ClipFrame, method: str, answered: Answered) -> dict[str, Any]:
    from detector.commands.detect import as_dict, rival_as_dict

    earlier_ns, result = answered.earlier_time_ns, answered.result
    interval_s = None if earlier_ns is None else (answered.time_ns - earlier_ns) * 1e-9
    return {
        "frame": number,
        "file": frame.name,
        "method": method,
        "time_s": frame.time_s,
        "earlier_time_s": None if earlier_ns is None else earlier_ns * 1e-9,
        "baseline_m": answered.baseline_m,
        **(
            rival_as_dict(answered.answer)
            if result is None
            else as_dict(result, answered.baseline_m, interval_s)
        ),
    }


@contextlib.contextmanager
def _lines(path: Path | None) -> Iterator[IO[str] | None]:
    """Open the file of JSON lines, if one is wanted; each line is written at once."""
    if path is None:
        yield None
        return
    try:
        file = path.open("w", encoding="utf-8", buffering=1)
    except (OSError, ValueError) as error:
        raise InputError(f"--json-lines {path}: cannot be written: {inputs.cause(error)}") from error
    with file:
        yield file


@contextlib.contextmanager
def _progress(total: int | None) -> Iterator[Callable[[], None]]:
    """Show a bar on stderr where that is a terminal; yield what moves it on by one frame."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    with Progress(
        TextColumn("frames"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    ) as progress:
        task = progress.add_task("frames", total=total)
        yield lambda: progress.advance(task)


def _refuse_overwriting(source: Path, output: Path) -> None:
    try:
        same = source.is_file() and output.exists() and source.samefile(output)
    except (OSError, ValueError):
        return  # opening it says why it cannot be used
    if same:
        raise InputError(f"-o {output}: is the source itself")


def _count(text: str) -> int:
    value = int(text) if text.isascii() and text.isdigit() and len(text) < 10 else 0
    if not 1 <= value <= _MAX_FRAMES:
        raise argparse.ArgumentTypeError(f"found {text!r}, allowed are 1 to {_MAX_FRAMES}")
    return value


def _hertz(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.1 <= value <= 1000.0:
        raise argparse.ArgumentTypeError(f"found {text!r}, allowed are 0.1 to 1000")
    return value


def _four_characters(text: str) -> str:
    if len(text) != 4 or not text.isascii() or not text.isprintable():
        raise argparse.ArgumentTypeError(f"found {text!r}, allowed are four characters such as mp4v or MJPG")
    return text
