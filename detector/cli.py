"""Command line of the detector: ``detector COMMAND``.

Each command is a module of :mod:`detector.commands`. OpenCV and the detector itself are imported when a command runs, so that
``--help`` answers at once.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import Final

from detector.commands import detect, evaluate, report, video
from detector.commands.inputs import InputError

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
    except InputError as error:
        print(f"detector: error: {error}", file=sys.stderr)
        return EXIT_BAD_INPUT
    return code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="detector",
        description="Void detection for indoor drones, from optical flow and vanishing points of one camera.",
    )
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for command in (detect, evaluate, report, video):
        command.add(commands)
    return parser
