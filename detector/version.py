"""``--version`` of both command lines."""

from __future__ import annotations

import argparse
import sys
from typing import Any


class ShowVersion(argparse.Action):
    """Print the installed version and end; it is looked up only then, which takes longer than all of ``--help``."""

    def __init__(self, option_strings: list[str], dest: str, **_: Any) -> None:
        super().__init__(option_strings, dest, nargs=0, help="print the version and exit")

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        """Print it and exit."""
        from importlib.metadata import version

        sys.stdout.write(f"{parser.prog} {version('void-companion')}\n")
        parser.exit()
