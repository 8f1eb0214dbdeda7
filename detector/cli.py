"""Command line of the detector: ``detector COMMAND``.

Each command is a module of :mod:`detector.commands`. OpenCV and the detector itself are imported when a command runs, so that
``--help`` answers at once.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from typing import Final

from detector.commands import bench, detect, evaluate, report, video
from detector.commands.inputs import InputError
from detector.version import ShowVersion

EXIT_NO_READER: Final = 1
"""Nobody reads what is printed any more."""
EXIT_BAD_INPUT: Final = 2
"""The command line, or a file that it names, cannot be used (also argparse's own code)."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code: 0, or 2 with one clear line on stderr.

    Parameters
    ----------
    argv
        Arguments without the program's name; those of the process when not given.

    Raises
    ------
    SystemExit
        From argparse: after ``--help`` (0), and on a command line that it cannot parse (2).
    """
    options = _parser().parse_args(argv)
    try:
        code: int = options.run(options)
        sys.stdout.flush()
    except InputError as error:
        print(f"detector: error: {error}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except (
        BrokenPipeError
    ):  # the reader (head, less) has seen enough; nothing more can be written, at exit neither
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_NO_READER
    return code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="detector",
        description="Void detection for indoor drones, from optical flow and vanishing points of one camera.",
    )
    parser.add_argument("--version", action=ShowVersion)
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for command in (detect, evaluate, report, video, bench):
        command.add(commands)
    return parser
