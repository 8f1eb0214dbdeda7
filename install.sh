#!/usr/bin/env bash
# Installs void-companion as a system service, upgrades it, or removes it. See docs/install.md.
#
#   sudo ./install.sh                 install from this checkout; run again to upgrade (the configuration stays)
#   sudo ./install.sh --wheels DIR    the same without a network: our wheel and its dependencies are taken from DIR
#   sudo ./install.sh --enable        and start it now and with the machine
#   sudo ./install.sh --uninstall     remove everything; with --keep-config, all but /etc/void-companion
set -euo pipefail

here="$(cd "$(dirname "$0")" && pwd)"
name=void-companion
prefix=/opt/$name
settings=/etc/$name
unit=/etc/systemd/system/$name.service
back_off=/etc/systemd/system/$name.service.d/back-off.conf
rules=/etc/udev/rules.d/70-$name.rules
sysusers=/etc/sysusers.d/$name.conf
command_link=/usr/local/bin/companion
extras=web # small, and the live page is then switched on by the configuration alone
quicker=fast # an event loop that takes less of a core; without it the service is the same
back_off_since=254 # the first systemd with RestartSteps=

fail() {
    echo "error: $*" >&2
    exit 1
}

say() { echo "install: $*"; }

systemd_runs() { [ -d /run/systemd/system ]; }

# Cameras and serial ports that are there get the names that the rules of now give them. Containers have no udev of their own.
rename_devices() {
    [ -S /run/udev/control ] || return 0
    udevadm control --reload
    udevadm trigger --action=change --subsystem-match=video4linux --subsystem-match=tty
}

usage() { sed -n '2,7s/^# \{0,1\}//p' "$0"; }

wheels=""
enable=no
uninstall=no
keep_config=no
while [ $# -gt 0 ]; do
    case "$1" in
        --wheels)
            [ $# -ge 2 ] || fail "--wheels needs a folder"
            [ -d "$2" ] || fail "--wheels: $2 is not a folder"
            wheels="$(cd "$2" && pwd -P)" # find does not enter a link that it is given
            shift
            ;;
        --enable) enable=yes ;;
        --uninstall) uninstall=yes ;;
        --keep-config) keep_config=yes ;;
        -h | --help)
            usage
            exit 0
            ;;
        *) fail "unknown option $1; --help lists them" ;;
    esac
    shift
done
if [ "$uninstall" = no ] && [ "$keep_config" = yes ]; then
    fail "--keep-config goes with --uninstall; an upgrade always keeps the configuration"
fi
[ "$(id -u)" = 0 ] || fail "this needs root: sudo $0"
[ "$(uname -s)" = Linux ] || fail "this is $(uname -s); the service is for Linux with systemd"

remove_everything() {
    if systemd_runs; then
        systemctl disable --now --quiet $name.service 2>/dev/null || true # not there is as good as stopped
    fi
    rm -f "$unit" "$rules" "$sysusers" "/etc/systemd/system/multi-user.target.wants/$name.service"
    rm -rf "/etc/systemd/system/$name.service.d" "$prefix" "$prefix.old" /var/lib/$name /var/log/$name /run/$name
    if [ "$(readlink "$command_link" 2>/dev/null || true)" = "$prefix/bin/companion" ]; then
        rm -f "$command_link"
    fi
    [ "$keep_config" = yes ] || rm -rf "$settings"
    if [ -d /etc/sysusers.d ]; then rmdir --ignore-fail-on-non-empty /etc/sysusers.d; fi
    if getent passwd $name >/dev/null; then userdel $name; fi
    if getent group $name >/dev/null; then groupdel $name; fi
    if systemd_runs; then
        systemctl daemon-reload
        systemctl reset-failed --quiet $name.service 2>/dev/null || true # systemd has forgotten it already
        rename_devices
    fi
}

if [ "$uninstall" = yes ]; then
    remove_everything
    say "removed$([ "$keep_config" = no ] || echo "; $settings is kept")"
    exit 0
fi

# ---------------------------------------------------------------- what is needed

for needed in systemctl systemd-sysusers udevadm; do
    command -v $needed >/dev/null || fail "$needed is not there: this needs systemd and udev (Debian: apt-get install systemd udev)"
done
python=""
for candidate in python3 python3.13 python3.12 python3.11; do
    if command -v "$candidate" >/dev/null &&
        "$candidate" -c 'import sys; sys.exit(not ((3, 11) <= sys.version_info[:2] <= (3, 13)))' 2>/dev/null; then
        python="$(command -v "$candidate")"
        break
    fi
done
[ -n "$python" ] || fail "no Python 3.11, 3.12 or 3.13 found (Debian 12: apt-get install python3 python3-venv)"
"$python" -c 'import ensurepip, venv' 2>/dev/null ||
    fail "$python cannot make virtual environments (Debian: apt-get install python3-venv)"
for file in void-companion.service back-off.conf void-companion.sysusers void-companion.rules; do
    [ -f "$here/systemd/$file" ] || fail "$here/systemd/$file is missing: run this from a whole checkout"
done
if [ -n "$wheels" ]; then
    ls "$wheels"/void_companion-*.whl >/dev/null 2>&1 || fail "no void_companion-*.whl in $wheels"
elif [ ! -f "$here/pyproject.toml" ]; then
    fail "$here is no checkout: give a folder of wheels with --wheels DIR"
fi

# ---------------------------------------------------------------- the program

# An upgrade is done in place, on a copy by hard links: pip replaces files and never writes into them, so the copy stays
# what it was, and comes back when anything fails.
rm -rf "$prefix.old"
upgrade=no
if [ -x "$prefix/bin/python" ]; then
    upgrade=yes
    cp -al "$prefix" "$prefix.old"
fi
# shellcheck disable=SC2317,SC2329 # called by the trap
bring_back() {
    rm -rf "$prefix"
    if [ $upgrade = yes ]; then
        mv "$prefix.old" "$prefix"
        echo "error: the upgrade failed; the version from before is in place" >&2
    else
        echo "error: the installation failed; nothing of it is left in $prefix" >&2
    fi
}
trap bring_back EXIT
version_of() { "$1" -c 'import sys; print(sys.version)' 2>/dev/null || echo none; }
if [ $upgrade = no ] || [ "$(version_of "$prefix/bin/python")" != "$(version_of "$python")" ]; then
    say "a virtual environment in $prefix ($("$python" --version))"
    rm -rf "$prefix"
    "$python" -m venv "$prefix"
fi
say "the program and what it needs"
pip=("$prefix/bin/python" -m pip --quiet --disable-pip-version-check --no-cache-dir)
if [ -n "$wheels" ]; then
    newest="$(find "$wheels" -name 'void_companion-*.whl' | sort -V | tail -n 1)"
    source=(--no-index --find-links "$wheels")
    "${pip[@]}" install "${source[@]}" "$newest[$extras]"
    # Same version, other build: pip would leave the old one.
    "${pip[@]}" install --no-index --no-deps --force-reinstall "$newest"
else
    source=()
    "${pip[@]}" install "$here[$extras]"
    "${pip[@]}" install --no-deps --force-reinstall "$here"
fi
# Of what is installed by now: nothing of ours is fetched or built again. Only wheels: a board has no compiler, or takes minutes.
if ! why="$("${pip[@]}" install "${source[@]}" --only-binary=:all: "${name}[$quicker]" 2>&1)"; then
    say "without the extra $quicker: there is no wheel of it for this machine. All works; passing messages on takes more of a core"
    say "      (pip: $(echo "$why" | sed -n '$p'))"
fi
"$prefix/bin/companion" --help >/dev/null
share="$prefix/share/$name"
rm -rf "$share"
install -d "$share"
for file in README.md SAFETY.md LICENSE; do
    if [ -f "$here/$file" ]; then install -m 0644 "$here/$file" "$share/"; fi
done
trap - EXIT
rm -rf "$prefix.old"
install -d "$(dirname "$command_link")"
if [ ! -e "$command_link" ] || [ "$(readlink "$command_link" || true)" = "$prefix/bin/companion" ]; then
    ln -sfn "$prefix/bin/companion" "$command_link"
else
    say "$command_link is somebody else's and is left alone; the command is $prefix/bin/companion"
fi

# ---------------------------------------------------------------- user, configuration, unit, names of devices

install -D -m 0644 "$here/systemd/void-companion.sysusers" "$sysusers"
systemd-sysusers "$sysusers"
install -d -m 0750 -o root -g $name "$settings"
default="$(mktemp)"
trap 'rm -f "$default"' EXIT
"$prefix/bin/companion" config --default >"$default"
install -m 0640 -o root -g $name "$default" "$settings/config.default.toml"
fresh_config=no
if [ ! -e "$settings/config.toml" ]; then
    fresh_config=yes
    install -m 0640 -o root -g $name "$default" "$settings/config.toml"
fi
install -D -m 0644 "$here/systemd/void-companion.service" "$unit"
version="$(systemctl --version | sed -n '1s/^systemd \([0-9]*\).*/\1/p')"
if [ "${version:-0}" -ge $back_off_since ]; then
    install -D -m 0644 "$here/systemd/back-off.conf" "$back_off"
else
    rm -f "$back_off"
fi
install -D -m 0644 "$here/systemd/void-companion.rules" "$rules"
if systemd_runs; then
    systemctl daemon-reload
    rename_devices
fi
if [ $enable = yes ]; then
    systemctl enable --quiet $name.service
    if systemd_runs; then systemctl restart $name.service; fi
elif systemd_runs; then
    systemctl try-restart $name.service # one that runs goes on with the new version
fi

say "$("$prefix/bin/python" -c 'from importlib.metadata import version; print("void-companion", version("void-companion"))') is in $prefix"
if [ $fresh_config = yes ]; then
    say "next: name the camera and the links in $settings/config.toml (companion cameras lists cameras), then"
    say "      systemctl enable --now $name"
else
    say "$settings/config.toml is as it was; new keys are described in $settings/config.default.toml"
fi
