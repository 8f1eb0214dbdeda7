"""The installed service under a real systemd: start, watchdog, crash, crash loop, unplugged camera, reboot, removal."""

from __future__ import annotations

import json
import os
import pwd
import signal
import time
import urllib.request
from pathlib import Path

import vivid
from programs import COMPANION, run
from report import CheckFailedError, check, require

_INSTALLER = Path(__file__).parent / "install" / "install.sh"
_WHEELS = "/mnt/wheels"
_UNIT = "void-companion.service"
_CONFIG = Path("/etc/void-companion/config.toml")
_START_S = 400.0
_LOOP_STARTS = 3

_SETTINGS = """\
[source]
url = "v4l2:/dev/void-companion/camera"
pixel_format = "GREY"
width_px = 320
height_px = 180
rate_hz = 10
timeout_s = 5.0
[link]
planner = "udpin:127.0.0.1:14560"
autopilot = "udpin:127.0.0.1:14570"
[detector]
start_timeout_s = 300.0
deadline_s = 60.0
[log]
status_interval_s = 5.0
[reload]
watch_s = 0  # only when asked: so that it is known what a reload came from
[recorder]
start = "always"
frames_hz = 2
keep_free_mib = 100
[web]
enabled = true
port = 8080
"""
_DROP_IN = """\
# The processor is emulated: a start takes half a minute here, and what shares the host can stop everything for seconds.
[Service]
TimeoutStartSec=300s
TimeoutStopSec=60s
WatchdogSec=20s
"""


def before_reboot() -> bool:
    """Install and try the service; return whether it is worth to reboot."""
    if not check("service: install.sh", _install):
        return False
    check("service: names by udev", _names)
    if not check("service: start, READY=1", _start):
        return False
    check("service: camera and worker within its confinement", _works)
    check("service: status in systemctl and at its socket", _status)
    check("service: recorder and live page within its confinement", _io)
    check("service: camera unbound and bound again", _unplugged)
    check("service: watchdog ends a service that hangs", _watchdog)
    check("service: started again after a crash", _crash)
    check("service: systemctl reload and SIGHUP", _reload)
    check("service: reload of a broken file", _broken_reload)
    check("service: crash loop is never given up", _crash_loop)
    check("service: upgrade keeps configuration and runs on", _upgrade)
    return check("service: stop", _stop)


def after_reboot() -> None:
    """Look at what came up by itself, then remove it."""
    check("service: up by itself after a reboot", _came_up)
    check("service: --uninstall leaves nothing", _uninstall)


def prepare_reboot() -> None:
    """Let the test camera be there at the next boot as a real one would be."""
    Path("/etc/modules-load.d/vivid.conf").write_text("vivid\n")
    Path("/etc/modprobe.d/vivid.conf").write_text(f"options vivid {' '.join(vivid.OPTIONS)}\n")


# ---------------------------------------------------------------- the checks


def _install() -> str:
    run(str(_INSTALLER), "--wheels", _WHEELS, limit_s=1800)
    account = pwd.getpwnam("void-companion")
    _CONFIG.write_text(_SETTINGS)
    folder = Path(f"/etc/systemd/system/{_UNIT}.d")
    folder.mkdir(exist_ok=True)
    (folder / "emulated.conf").write_text(_DROP_IN)
    run("systemctl", "daemon-reload")
    run("systemd-analyze", "verify", "--man=no", f"/etc/systemd/system/{_UNIT}", limit_s=300)
    return f"user {account.pw_name} ({account.pw_uid}), unit verified"


def _names() -> str:
    link = Path("/dev/void-companion/camera")
    run("udevadm", "settle")
    vivid.until(link.exists, 30.0, f"{link}")
    require(link.resolve() == vivid.node(), f"{link} is {link.resolve()}, the camera is {vivid.node()}")
    return f"{link} -> {link.resolve()}"


def _start() -> str:
    started_s = time.monotonic()
    run("systemctl", "enable", "--now", _UNIT, limit_s=_START_S)
    took_s = time.monotonic() - started_s
    pid = _pid()
    user = pwd.getpwuid(Path(f"/proc/{pid}").stat().st_uid).pw_name
    require(user == "void-companion", f"it runs as {user}")
    require(_shown("ActiveState") == "active", f"it is {_shown('ActiveState')}")
    return f"process {pid} of {user}, READY=1 {took_s:.1f} s after the start"


def _works() -> str:
    since_s = time.monotonic()
    _wait_for_event("camera_opened", _START_S)
    _wait_for_event("worker_ready", _START_S)
    vivid.until(lambda: _last_event("status").get("frames_hz", 0.0) > 0, 120.0, "frames in the status line")
    status = _last_event("status")
    return (
        f"{status['frames_hz']} frames/s, worker {status['worker']}, after {time.monotonic() - since_s:.0f} s"
    )


def _status() -> str:
    text = _shown("StatusText")
    require("frames" in text and ":" in text, f"StatusText is {text!r}")
    answered = json.loads(run(COMPANION, "status", "--json", limit_s=120))
    require(bool(answered), "companion status says nothing")
    return text


def _io() -> str:
    _wait_for_event("recording_started", _START_S)
    recording = Path(str(_last_event("recording_started")["file"]))
    require(recording.is_relative_to("/var/log/void-companion"), f"it records to {recording}")
    begun_bytes = recording.stat().st_size
    vivid.until(lambda: recording.stat().st_size > begun_bytes, 120.0, "more in the recording")
    _wait_for_event("web_serving", _START_S)
    with urllib.request.urlopen("http://127.0.0.1:8080/", timeout=120) as page:
        require(page.status == 200, f"the page answers {page.status}")
        page_bytes = len(page.read())
    require(not _events("io_died"), f"the I/O process died: {_last_event('io_died')}")
    return f"{recording} grows; the page answers with {page_bytes} bytes"


def _unplugged() -> str:
    pid, lost, opened = _pid(), len(_events("camera_lost")), len(_events("camera_opened"))
    vivid.unbind()
    lost_s = vivid.until(lambda: len(_events("camera_lost")) > lost, 90.0, "camera_lost in the journal")
    vivid.bind()
    back_s = vivid.until(
        lambda: len(_events("camera_opened")) > opened, 120.0, "camera_opened in the journal"
    )
    require(_pid() == pid, "the service was started anew")
    return f"noticed after {lost_s:.1f} s, open again {back_s:.1f} s after it came back, same process"


def _watchdog() -> str:
    pid, counted = _pid(), _restarts()
    os.kill(pid, signal.SIGSTOP)
    took_s = _another_process(pid)
    require("Watchdog timeout" in _journal(), "systemd does not speak of a watchdog in the journal")
    require(_restarts() > counted, "NRestarts has not grown")
    return f"another process {took_s:.1f} s after SIGSTOP (WatchdogSec is 20 s here)"


def _crash() -> str:
    pid = _pid()
    os.kill(pid, signal.SIGKILL)
    took_s = _another_process(pid)
    return f"active again {took_s:.1f} s after kill -9"


def _reload() -> str:
    pid = _pid()
    took_s = []
    for asks, setpoints in (
        (lambda: run("systemctl", "reload", _UNIT, limit_s=120), "true"),
        (lambda: os.kill(pid, signal.SIGHUP), "false"),
    ):
        counted = len(_events("config_reloaded"))
        _CONFIG.write_text(_SETTINGS.replace("[log]\n", f"[log]\nsetpoints = {setpoints}\n"))
        asks()
        took_s.append(
            vivid.until(
                lambda counted=counted: len(_events("config_reloaded")) > counted, 120.0, "config_reloaded"
            )
        )
        changed = _last_event("config_reloaded")["changed"]
        require(list(changed) == ["log.setpoints"], f"changed: {changed}")
    require(_pid() == pid, "the service was started anew")
    return f"a changed setting taken after {took_s[0]:.1f} s and {took_s[1]:.1f} s, same process"


def _broken_reload() -> str:
    pid, counted = _pid(), len(_events("config_rejected"))
    _CONFIG.write_text("this is no TOML\n")
    run("systemctl", "reload", _UNIT, limit_s=120)
    vivid.until(lambda: len(_events("config_rejected")) > counted, 120.0, "config_rejected")
    _CONFIG.write_text(_SETTINGS)
    require(_pid() == pid and _shown("ActiveState") == "active", "the service did not go on")
    return f"refused ({_last_event('config_rejected')['error']}), the service goes on"


def _crash_loop() -> str:
    _CONFIG.write_text("this is no TOML\n")
    scheduled = _journal().count("Scheduled restart job")
    run("systemctl", "restart", "--no-block", _UNIT)
    vivid.until(
        lambda: _journal().count("Scheduled restart job") >= scheduled + _LOOP_STARTS,
        _START_S,
        f"{_LOOP_STARTS} starts with a broken configuration",
    )
    state = _shown("ActiveState")
    require(state != "failed", "systemd has given up")
    _CONFIG.write_text(_SETTINGS)
    took_s = vivid.until(
        lambda: _shown("ActiveState") == "active", _START_S, "active with a sound configuration"
    )
    return f"{_LOOP_STARTS} failed starts, still {state}; active by itself {took_s:.1f} s after the file was repaired"


def _upgrade() -> str:
    pid = _pid()
    run(str(_INSTALLER), "--wheels", _WHEELS, limit_s=1800)
    require(_CONFIG.read_text() == _SETTINGS, "the configuration was changed")
    require(_shown("ActiveState") == "active", f"it is {_shown('ActiveState')}")
    require(_pid() != pid, "the old version still runs")
    return "configuration as it was; the service runs the new version"


def _stop() -> str:
    started_s = time.monotonic()
    run("systemctl", "stop", _UNIT, limit_s=120)
    took_s = time.monotonic() - started_s
    result = _shown("Result")
    require(result == "success", f"Result={result}")
    left = run("ps", "-u", "void-companion", "-o", "pid=", codes=(0, 1)).split()
    require(not left, f"processes left: {left}")
    return f"after {took_s:.1f} s, Result=success, no process left"


def _came_up() -> str:
    took_s = vivid.until(lambda: _shown("ActiveState") == "active", _START_S, "active")
    vivid.until(lambda: bool(_events("camera_opened")), _START_S, "camera_opened in the journal")
    return f"active {took_s:.1f} s after multi-user.target, with the camera"


def _uninstall() -> str:
    run(str(_INSTALLER), "--uninstall", limit_s=300)
    roots = ["/etc", "/opt", "/usr/local", "/var/lib", "/var/log", "/run", "/dev"]
    run("udevadm", "settle")
    words = ["find", *roots, "-xdev", "-iname", "*void*companion*"]
    # udev keeps a lock for every link that it ever made, until the next boot; the link itself would be in /dev.
    left = [path for path in run(*words).splitlines() if not path.startswith("/run/udev/links/")]
    require(not left, f"left: {left}")
    try:
        pwd.getpwnam("void-companion")
    except KeyError:
        return "no file, no user, no unit"
    raise CheckFailedError("the user is left")


# ---------------------------------------------------------------- asking systemd


def _shown(name: str) -> str:
    return run("systemctl", "show", "-P", name, _UNIT).strip()


def _pid() -> int:
    pid = int(_shown("MainPID"))
    require(pid > 0, "the service has no process")
    return pid


def _restarts() -> int:
    return int(_shown("NRestarts"))


def _another_process(old_pid: int) -> float:
    def replaced() -> bool:
        return _shown("ActiveState") == "active" and int(_shown("MainPID")) not in (0, old_pid)

    return vivid.until(replaced, _START_S, "another process that is ready")


def _journal() -> str:
    return run("journalctl", "-b", "-u", _UNIT, "-o", "cat", limit_s=60)


def _events(name: str) -> list[dict[str, object]]:
    """Return the service's events of one name in the journal of this boot, oldest first."""
    found = []
    for line in _journal().splitlines():
        if f'"{name}"' in line and line.startswith("{"):
            event = json.loads(line)
            if event.get("event") == name:
                found.append(event)
    return found


def _last_event(name: str) -> dict[str, object]:
    return (_events(name) or [{}])[-1]


def _wait_for_event(name: str, limit_s: float) -> None:
    vivid.until(lambda: bool(_events(name)), limit_s, f"{name} in the journal")
