"""``--version`` of both programs."""

import tomllib
from pathlib import Path

import pytest

import companion.cli
import detector.cli


@pytest.mark.parametrize(
    ("program", "main"), [("companion", companion.cli.main), ("detector", detector.cli.main)]
)
def test_it_says_the_version_of_the_package(program, main, capsys):
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == 0
    assert capsys.readouterr().out == f"{program} {project['version']}\n"
