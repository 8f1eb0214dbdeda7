"""The systemd unit, by systemd's own judge; what is installed where is in one accord."""

from __future__ import annotations

import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
UNIT = ROOT / "systemd" / "void-companion.service"
INSTALLER = ROOT / "install.sh"

ANALYZE = shutil.which("systemd-analyze") or ""

needs_systemd = pytest.mark.skipif(not ANALYZE, reason="systemd-analyze is not installed")


def settings() -> dict[str, list[str]]:
    """Return the unit's settings; one may stand there several times."""
    found: dict[str, list[str]] = {}
    for line in UNIT.read_text().splitlines():
        if match := re.fullmatch(r"([A-Za-z]+)=(.*)", line):
            found.setdefault(match[1], []).append(match[2])
    return found


def analyze(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([ANALYZE, *words], capture_output=True, text=True, timeout=60)


@needs_systemd
def test_systemd_finds_nothing_wrong_with_the_unit(tmp_path):
    # The program is not installed where tests run: another one that exists stands in for it.
    path = tmp_path / UNIT.name
    path.write_text(re.sub(r"(?m)^ExecStart=\S+", "ExecStart=/bin/true", UNIT.read_text()))
    judged = analyze("verify", "--man=no", str(path))
    assert judged.returncode == 0, judged.stderr
    # Not every fault changes the code: an unknown key is only complained of. Other units of the machine are not ours.
    assert UNIT.name not in judged.stderr


@needs_systemd
def test_the_judge_is_heard(tmp_path):
    path = tmp_path / UNIT.name
    path.write_text(re.sub(r"(?m)^ExecStart=\S+", "ExecStart=/bin/true", UNIT.read_text()) + "Nonsense=1\n")
    assert UNIT.name in analyze("verify", "--man=no", str(path)).stderr


@needs_systemd
def test_the_service_is_exposed_by_at_most_2_0():
    judged = analyze("security", "--offline=yes", "--threshold=20", "--no-pager", str(UNIT))
    assert judged.returncode == 0, judged.stdout


def test_the_service_is_never_given_up():
    assert settings()["StartLimitIntervalSec"] == ["0"]
    assert settings()["Restart"] == ["always"]


def test_unit_and_installer_mean_the_same_paths_and_user():
    installer = INSTALLER.read_text()
    (start,) = settings()["ExecStart"]
    assert "name=void-companion\nprefix=/opt/$name\nsettings=/etc/$name\n" in installer
    assert start == "/opt/void-companion/bin/companion run -c /etc/void-companion/config.toml"
    users = (ROOT / "systemd" / "void-companion.sysusers").read_text()
    assert f"u {settings()['User'][0]} " in users
    for group in settings()["SupplementaryGroups"][0].split():
        assert f"m {settings()['User'][0]} {group}\n" in users


def test_what_recorder_page_and_status_socket_need_is_allowed():
    allowed = settings()
    assert {"AF_UNIX", "AF_INET", "AF_INET6"} <= set(allowed["RestrictAddressFamilies"][0].split())
    for folder in ("StateDirectory", "LogsDirectory", "RuntimeDirectory"):
        assert allowed[folder] == ["void-companion"]
    # Processes of our own are started with other priorities and may be ended by us: both are of this set.
    assert "@system-service" in allowed["SystemCallFilter"]
    assert int(allowed["TasksMax"][0]) >= 128


def test_a_reload_is_the_signal_that_the_service_listens_to():
    # By the shell's own kill: the program of that name is not everywhere.
    assert settings()["ExecReload"] == ['/bin/sh -c "kill -HUP ${MAINPID}"']


def test_the_live_page_is_installed_with_the_service():
    extras = re.search(r"(?m)^extras=(\S+)", INSTALLER.read_text())
    assert extras is not None
    with (ROOT / "pyproject.toml").open("rb") as project:
        assert set(extras[1].split(",")) <= set(tomllib.load(project)["project"]["optional-dependencies"])
    quicker = re.search(r"(?m)^quicker=(\S+)", INSTALLER.read_text())
    assert quicker is not None
    fetching = (ROOT / "scripts" / "vm" / "wheels.py").read_text()
    carried = re.search(r"(?m)^EXTRAS: Final = \((.*)\)$", fetching)
    assert carried is not None
    assert carried[1].replace('"', "").split(", ") == [*extras[1].split(","), quicker[1]]
    assert f'OPTIONAL_EXTRAS: Final = frozenset({{"{quicker[1]}"}})' in fetching
    assert f"'.[{extras[1]},{quicker[1]}]'" in (ROOT / "docs" / "install.md").read_text()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--nonsense"], "unknown option --nonsense"),
        (["--keep-config"], "goes with --uninstall"),
        (["--wheels"], "--wheels needs a folder"),
        (["--wheels", "/nowhere"], "/nowhere is not a folder"),
    ],
)
def test_the_installer_refuses_wrong_words_in_one_line_before_it_does_anything(words, said):
    done = subprocess.run([str(INSTALLER), *words], capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert said in done.stderr
    assert done.stderr.count("\n") == 1
    assert done.stdout == ""


def test_what_the_page_saves_and_a_ground_station_sets_goes_with_the_state_folder():
    (start,) = settings()["ExecStart"]
    (folder,) = settings()["StateDirectory"]
    installer = INSTALLER.read_text()
    assert f"/var/lib/{folder}" in settings()["WorkingDirectory"]
    (removal,) = re.findall(
        r"(?m)^    rm -rf .*$", installer.partition("remove_everything() {")[2].partition("\n}\n")[0]
    )
    assert "/var/lib/$name" in removal.split()
    assert "-c /etc/void-companion/config.toml" in start  # config.page.toml is named after it


@pytest.mark.parametrize("is_there", [True, False])
def test_where_there_is_no_wheel_of_the_quicker_event_loop_it_is_installed_without(tmp_path, is_there):
    (step,) = re.findall(r"(?ms)^if ! why=.*?^fi$", INSTALLER.read_text())
    pip = tmp_path / "pip"
    pip.write_text(
        f'#!/bin/sh\necho "$@" >>{tmp_path}/asked\n'
        + (
            ""
            if is_there
            else 'echo "ERROR: one" >&2; echo "ERROR: No matching distribution found" >&2; exit 1\n'
        )
    )
    pip.chmod(0o755)
    before = (
        f"set -euo pipefail\nname=void-companion quicker=fast pip=({pip}) source=(--find-links {tmp_path})\n"
        'say() { echo "install: $*"; }\n'
    )
    done = subprocess.run(["/bin/bash", "-c", before + step], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "asked").read_text() == (
        f"install --find-links {tmp_path} --only-binary=:all: void-companion[fast]\n"
    )
    if is_there:
        assert done.stdout == ""
    else:
        first, second = done.stdout.splitlines()
        assert first.startswith("install: without the extra fast: there is no wheel of it for this machine.")
        assert second.endswith("(pip: ERROR: No matching distribution found)")
