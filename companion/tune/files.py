"""What a search leaves in its folder: a configuration with the best settings, the report and its pictures."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.config_file import toml_value
from companion.tune.errors import TuneError
from companion.tune.flights import PARAMS_FILE, params_toml
from companion.tune.outcome import Outcome, warning_of
from companion.tune.space import Value

CONFIG_FILE: Final = "companion.toml"
REPORT_FILES: Final = ("report.json", "report.md")


def make_folder(folder: Path) -> None:
    """Make the folder where it is missing.

    Raises
    ------
    TuneError
        It cannot be written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / ".writable"
        probe.touch()
        probe.unlink()
    except (OSError, ValueError) as error:
        raise TuneError(
            f"-o {folder}: cannot be used: {getattr(error, 'strerror', None) or error}"
        ) from error


def config_files(outcome: Outcome, method: str, preset: str) -> Mapping[str, str]:
    """Return the text of the configuration and of the method's parameters beside it, by file name (pure).

    ``companion run -c`` takes it as it is, or its tables may be copied into a configuration that there is.
    """
    tables: dict[str, dict[str, Value]] = {"detector": {"method": method}}
    if method == "paper":
        tables["detector"]["preset"] = preset
    params = {name: value for name, value in outcome.settings.items() if "." not in name}
    files = {}
    if params:
        tables["detector"]["params_file"] = PARAMS_FILE
        files[PARAMS_FILE] = (
            f"# Parameters of the method {method}, from companion tune.\n{params_toml(params)}"
        )
    for name, value in outcome.settings.items():
        table, dot, key = name.partition(".")
        if dot:
            tables.setdefault(table, {})[key] = value
    warning = warning_of(outcome)
    lines = [f"# The best of {outcome.trials} trials of companion tune; its report says on what.\n"]
    lines += [f"# NOTE: {warning}.\n"] if warning is not None else []
    for name, table_values in tables.items():
        lines.append(f"\n[{name}]\n")
        lines += [f"{key} = {toml_value(value)}\n" for key, value in table_values.items()]
    files[CONFIG_FILE] = "".join(lines)
    return files


def write(
    folder: Path,
    texts: Mapping[str, str],
    pictures: Mapping[str, NDArray[np.uint8]],
    report: Mapping[str, Any],
) -> None:
    """Write everything.

    Raises
    ------
    TuneError
        A file cannot be written.
    """
    contents = {name: text.encode() for name, text in texts.items()}
    for name, picture in pictures.items():
        done, data = cv2.imencode(".png", picture)
        if not done:
            raise TuneError(f"-o {folder / name}: the picture cannot be encoded")
        contents[name] = data.tobytes()
    contents["report.json"] = (json.dumps(report, indent=1, allow_nan=False) + "\n").encode()
    for name, content in contents.items():
        try:
            (folder / name).write_bytes(content)
        except OSError as error:
            raise TuneError(f"-o {folder / name}: cannot be written: {error.strerror}") from error
