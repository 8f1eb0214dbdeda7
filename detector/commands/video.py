"""``detector video SOURCE -o OUT.mp4``: a clip with the answer on every frame."""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import signal
import sys
import threading
from collections import Counter
from collections.abc import Callable, Generator, Iterator
from itertools import islice
from pathlib import Path
from types import FrameType
from typing import IO, TYPE_CHECKING, Any, Final

from detector.commands import inputs
from detector.commands.inputs import InputError

if TYPE_CHECKING:
    from detector.camera_model import CameraModel
    from detector.commands.clips import ClipFrame, ClipWriter, FolderClip, VideoClip
    from detector.observer import CameraPose
    from detector.video import Answered

_DESCRIPTION: Final = """\
Run the detector on a clip as a vehicle would, and write the clip with the answer drawn on every frame.
"""

_EPILOG: Final = """\
SOURCE is a video file, or a folder of images, which are taken in natural order of their names. Beside the images, or beside
their folder when that is called images, there may be a groundtruth.json or poses.json with K and poses: they are used, so
that pairs are chosen by the distance flown and rotation is taken out. Without poses pairs are chosen by the median flow.

JSON lines
  One object a frame, with the keys of "detector detect --json" (see there) and
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
"""

_EXIT_INTERRUPTED: Final = 130
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
        choices=("paper", "parallax"),
        default="paper",
        help="paper: flow clusters and lines; parallax: the void map, drawn too where poses are known (default: %(default)s)",
    )
    inputs.add_params_arguments(parser)
    inputs.add_camera_arguments(parser)
    parser.add_argument(
        "--baseline-frames",
        type=_count,
        metavar="N",
        help="pair each frame with the one N frames before it, in place of choosing by distance or flow",
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
    if options.method == "parallax" and options.baseline_frames is not None:
        raise InputError("--baseline-frames: not with --method parallax, which chooses its pairs by distance")
    _refuse_overwriting(options.source, options.output)
    clip = open_clip(options.source, options.rate)
    camera: CameraModel | None = None
    poses: dict[str, CameraPose] = {}
    if isinstance(clip, FolderClip) and not options.no_poses:
        camera, poses = poses_of(clip)
    kinds: Counter[str] = Counter()
    interrupted = False
    with (
        ClipWriter(options.output, clip.rate_hz, options.codec) as writer,
        _lines(options.json_lines) as lines,
        _after_this_frame() as asked_to_stop,
    ):
        try:
            with contextlib.closing(_answers(options, clip, camera, poses)) as answers:
                for number, frame, answered in answers:
                    _write(writer, lines, number, frame, answered, kinds)
                    if asked_to_stop():
                        interrupted = True
                        break
        except KeyboardInterrupt:
            interrupted = True
    if writer.written:
        writer.check()
    if interrupted:
        print(f"detector: interrupted: {options.output} holds {writer.written} frames", file=sys.stderr)
        return _EXIT_INTERRUPTED
    found = ", ".join(f"{kind} {count}" for kind, count in kinds.most_common())
    wanted = _wanted(options, clip)
    of = f" (the source states {wanted})" if wanted is not None and wanted > writer.written else ""
    print(f"{options.output}: {writer.written} frames{of}: {found}")
    return 0


def _answers(
    options: argparse.Namespace,
    clip: FolderClip | VideoClip,
    known_camera: CameraModel | None,
    poses: dict[str, CameraPose],
) -> Generator[tuple[int, ClipFrame, Answered]]:
    """Answer on the frames one by one, with a progress bar on a terminal."""
    from detector.video import FrameAnswerer, by_fixed_step, by_observer

    params = inputs.params_of(options)
    answer: FrameAnswerer | None = None
    with _progress(_wanted(options, clip)) as advance:
        for number, frame in enumerate(islice(clip.frames(), options.limit)):
            if answer is None:
                height_px, width_px = frame.image.shape
                camera = inputs.camera_of(options, width_px, height_px)
                if options.hfov is None and options.camera is None:
                    camera = known_camera
                if options.method == "parallax":
                    from detector.parallax_video import by_parallax

                    answer = by_parallax(camera)
                elif options.baseline_frames is None:
                    answer = by_observer(params, camera)
                else:
                    answer = by_fixed_step(params, camera, options.baseline_frames)
            pose = None if frame.name is None else poses.get(frame.name)
            yield number, frame, answer(frame.image, round(frame.time_s * 1e9), pose)
            advance()


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
    answered: Answered,
    kinds: Counter[str],
) -> None:
    from detector.commands.detect import kind_of
    from detector.video import annotated

    writer.write(annotated(frame.image, answered, number, frame.time_s))
    kinds[kind_of(answered.observation.detection)] += 1
    if lines is not None:
        try:
            lines.write(json.dumps(_record(number, frame, answered), allow_nan=False) + "\n")
        except OSError as error:
            raise InputError(
                f"--json-lines {lines.name}: cannot be written: {inputs.cause(error)}"
            ) from error


def _record(number: int, frame: ClipFrame, answered: Answered) -> dict[str, Any]:
    from detector.commands.detect import as_dict

    observation = answered.observation
    earlier_ns = observation.earlier_time_ns
    interval_s = None if earlier_ns is None else (observation.time_ns - earlier_ns) * 1e-9
    return {
        "frame": number,
        "file": frame.name,
        "time_s": frame.time_s,
        "earlier_time_s": None if earlier_ns is None else earlier_ns * 1e-9,
        "baseline_m": observation.baseline_m,
        **as_dict(answered.result, observation.baseline_m, interval_s),
    }


@contextlib.contextmanager
def _after_this_frame() -> Iterator[Callable[[], bool]]:
    """Let the first Ctrl-C wait for the end of a frame, so that picture, line and count agree; a second one does not wait.

    Yields what tells whether there was one.
    """
    asked = False

    def note(_number: int, _frame: FrameType | None) -> None:
        nonlocal asked
        if asked:
            raise KeyboardInterrupt
        asked = True

    # A handler can be set in the main thread alone, and a process that was told to ignore the signal goes on doing so.
    is_ours = (
        threading.current_thread() is threading.main_thread()
        and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    )
    if is_ours:
        signal.signal(signal.SIGINT, note)
    try:
        yield lambda: asked
    finally:
        if is_ours:
            signal.signal(signal.SIGINT, signal.default_int_handler)


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
