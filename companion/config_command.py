"""``companion config``: the configuration in force with where each value comes from, the default file, schema and reference."""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path

from companion.config_file import default_toml
from companion.config_reference import json_schema, reference_markdown
from companion.config_sources import ConfigPlaces, load, shown_with_origins


def config_parser() -> argparse.ArgumentParser:
    """Return the parser of ``companion config``; its ``command`` runs it."""
    parser = argparse.ArgumentParser(prog="companion config", description="Prints a configuration.")
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--show", action="store_true", help="what holds, each value with where it comes from")
    what.add_argument("--default", action="store_true", help="the commented default file")
    what.add_argument("--schema", action="store_true", help="the JSON Schema of the file, for editors")
    what.add_argument("--reference", action="store_true", help="docs/configuration-reference.md")
    parser.add_argument("-c", "--config", metavar="FILE.toml", help="--show: the main file")
    parser.add_argument(
        "-o",
        "--option",
        metavar="TABLE.KEY=VALUE",
        action="append",
        default=[],
        help="--show: one value in place of what the files and the environment say; may be repeated",
    )
    parser.set_defaults(command=_run)
    return parser


def _run(arguments: argparse.Namespace) -> int:
    if arguments.default:
        text = default_toml()
    elif arguments.schema:
        text = json.dumps(json_schema(), indent=2, ensure_ascii=False) + "\n"
    elif arguments.reference:
        text = reference_markdown()
    else:
        file = Path(arguments.config) if arguments.config else None
        text = shown_with_origins(load(ConfigPlaces(file, dict(os.environ), tuple(arguments.option))))
    sys.stdout.write(text)
    return 0
