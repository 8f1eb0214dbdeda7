"""What the computer says of itself, from files of our own and of this machine."""

from __future__ import annotations

from pathlib import Path

from pymavlink.dialects.v20 import common as mavlink

from companion.host_status import Host, busy_and_all, disk_mib, memory_mib, temperature_deg_c
from companion.mavlink.plots import computer_status, debug_vect, named_values


def machine(root: Path, *, stat: str = "cpu  10 0 10 70 10 0 0 0 0 0\n", zones: tuple[str, ...] = ()) -> Path:
    (root / "proc").mkdir(parents=True, exist_ok=True)
    (root / "proc/stat").write_text(stat)
    (root / "proc/uptime").write_text("123.45 200.0\n")
    (root / "proc/meminfo").write_text("MemTotal:  2048000 kB\nMemFree: 5 kB\nMemAvailable: 1024000 kB\n")
    for number, temperature in enumerate(zones):
        zone = root / f"sys/class/thermal/thermal_zone{number}"
        zone.mkdir(parents=True, exist_ok=True)
        (zone / "temp").write_text(temperature)
    return root


def test_a_machine_is_read(tmp_path):
    host = Host(tmp_path, root=machine(tmp_path, zones=("45200\n", "61800\n", "-274000\n", "garbage", "")))
    assert host.look().cpu_load is None
    machine(tmp_path, stat="cpu  40 0 40 100 20 0 0 0 0 0\n")
    status = host.look()
    assert status.cpu_load == 0.6
    assert (status.uptime_s, status.cpu_temperature_deg_c) == (123.45, 61.8)
    assert (status.memory_used_mib, status.memory_total_mib) == (1000, 2000)
    assert status.disk_total_mib > status.disk_used_mib > 0


def test_what_a_machine_does_not_tell_is_none(tmp_path):
    status = Host(tmp_path / "gone", root=tmp_path).look()
    assert {status.uptime_s, status.cpu_load, status.cpu_temperature_deg_c} == {None}
    assert {status.memory_used_mib, status.memory_total_mib, status.disk_used_mib, status.disk_total_mib} == {
        None
    }
    assert busy_and_all("intr 5") is None
    assert memory_mib("MemTotal: x kB") == (None, None)
    assert temperature_deg_c(tmp_path) is None
    assert disk_mib(tmp_path / "gone") == (None, None)
    unknown = sent(computer_status(status, 5_000_000))
    assert (unknown.cpu_combined[0], unknown.temperature_core[0], unknown.ram_total) == (255, 127, 0xFFFFFFFF)


def test_this_machine_can_be_read():
    status = Host(Path()).look()
    assert status.memory_total_mib > 0
    assert status.uptime_s > 0


def sent(message):
    link = mavlink.MAVLink(None, srcSystem=1, srcComponent=191)
    return mavlink.MAVLink(None).decode(bytearray(message.pack(link)))


def test_it_reaches_the_ground_station(tmp_path):
    host = Host(tmp_path, root=machine(tmp_path, zones=("61800\n",)))
    host.look()
    machine(tmp_path, stat="cpu  40 0 40 100 20 0 0 0 0 0\n")
    status = sent(computer_status(host.look(), 7_000_000))
    assert (status.time_usec, status.uptime, status.cpu_combined[0]) == (7000, 123450, 60)
    assert (status.temperature_core[0], status.temperature_board) == (62, 127)
    assert (status.ram_usage, status.ram_total) == (1000, 2000)


def test_plots_leave_out_what_is_not_known():
    found = [
        sent(m) for m in named_values({"a": 1.5, "b": None, "c": float("nan"), "void_state": 2.0}, 3_000_000)
    ]
    assert [(m.name, m.value, m.time_boot_ms) for m in found] == [("a", 1.5, 3), ("void_state", 2.0, 3)]
    vector = sent(debug_vect("void_sent", (1.0, -2.0, 0.5), 4_000))
    assert (vector.name, vector.x, vector.y, vector.z, vector.time_usec) == ("void_sent", 1.0, -2.0, 0.5, 4)
