"""The settings that a ground station sees and may change: a fixed table of names, and what a change of one means (pure).

All go over the wire as MAV_PARAM_TYPE_REAL32, whole numbers and choices too: the two ways in which autopilots put an
integer into PARAM_VALUE's float then cannot be confused. https://mavlink.io/en/services/parameter.html#parameter-encoding
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Any, Final, get_args

from companion.config import Config
from companion.config_file import config_of, merged
from companion.config_overlay import Value
from companion.errors import ConfigError

LONGEST_NAME: Final = 16
_FLOAT: Final = struct.Struct("<f")
_FLOAT_DIGITS: Final = range(6, 10)


@dataclass(frozen=True, slots=True)
class Setting:
    """One setting by its name on the wire.

    Attributes
    ----------
    name
        As ground stations show it, at most 16 characters.
    key
        Dotted key of the configuration.
    live
        Whether a change acts at once; else it is kept and acts after a restart.
    """

    name: str
    key: str
    live: bool = True


SETTINGS: Final = (
    Setting("VOID_AGREE_DEG", "guidance.agree_deg"),
    Setting("VOID_AGREE_HYST", "guidance.agree_hysteresis_deg"),
    Setting("VOID_ALIGN_DEG", "guidance.align_deg"),
    Setting("VOID_ARRIVE_M", "guidance.arrive_radius_m"),
    Setting("VOID_BAD_HOLD", "guidance.bad_reports_to_hold"),
    Setting("VOID_BOOT_PROBE", "guidance.bootstrap_probe"),
    Setting("VOID_CAM_LAT_MS", "source.latency_ms", live=False),
    Setting("VOID_CAM_MIN_HZ", "source.min_rate_hz"),
    Setting("VOID_CAM_PITCH", "camera.mount_pitch_deg", live=False),
    Setting("VOID_CAM_ROLL", "camera.mount_roll_deg", live=False),
    Setting("VOID_CAM_YAW", "camera.mount_yaw_deg", live=False),
    Setting("VOID_COMMIT_M", "guidance.commit_distance_m"),
    Setting("VOID_DET_AGE", "guidance.detection_max_age_s"),
    Setting("VOID_DET_AGE_HOV", "guidance.detection_max_age_hover_s"),
    Setting("VOID_ENG_BY", "engagement.by", live=False),
    Setting("VOID_EPISODE_M", "guidance.episode_distance_m"),
    Setting("VOID_GIVE_UP", "guidance.give_up"),
    Setting("VOID_GIVE_UP_S", "guidance.give_up_s"),
    Setting("VOID_HOLD_PROBE", "guidance.hold_probe_s"),
    Setting("VOID_MARGIN_M", "guidance.step_margin_m"),
    Setting("VOID_MAX_STEP_M", "guidance.max_step_m"),
    Setting("VOID_PLOT_HZ", "ground_station.plot_rate_hz"),
    Setting("VOID_POSE_AGE", "guidance.pose_max_age_s"),
    Setting("VOID_PROBE_M", "guidance.probe_step_m"),
    Setting("VOID_RC_CHAN", "engagement.rc_channel", live=False),
    Setting("VOID_REDET_DEG", "guidance.redetect_yaw_deg"),
    Setting("VOID_REDET_M", "guidance.redetect_distance_m"),
    Setting("VOID_TURN_DEG", "guidance.turn_step_deg"),
    Setting("VOID_UNPROTECT", "guidance.allow_unprotected"),
    Setting("VOID_VELOCITY", "guidance.velocity"),
    Setting("VOID_VEL_HORIZ", "guidance.velocity_horizon_s"),
    Setting("VOID_VIEW_DEG", "guidance.view_deg"),
    Setting("VOID_WALL_K", "guidance.wall_k"),
    Setting("VOID_WALL_LIM_M", "guidance.wall_limit_m"),
    Setting("VOID_WALL_MAR_M", "guidance.wall_margin_m"),
    Setting("VOID_WALL_N", "guidance.wall_n"),
    Setting("VOID_YAW_DEG_S", "guidance.yaw_rate_deg_s"),
)
"""In the order of their indices, which is alphabetical, as ground stations expect it."""


def number_of(config: Config, setting: Setting) -> float:
    """Return a setting's value as a number: a choice by its place from 0, false and true as 0 and 1."""
    value = value_of(config, setting)
    if isinstance(value, str):
        return float(choices(setting).index(value))
    return float(value)


def value_of(config: Config, setting: Setting) -> Value:
    """Return a setting's value as the configuration has it."""
    section, _, key = setting.key.partition(".")
    value: Value = getattr(getattr(config, section), key)
    return value


def choices(setting: Setting) -> tuple[str, ...]:
    """Return the words that a setting chooses from, in the order of their numbers; none for a number."""
    section, _, key = setting.key.partition(".")
    field = type(getattr(Config(), section)).model_fields[key]
    return tuple(word for word in get_args(field.annotation) if isinstance(word, str))


def changed(config: Config, setting: Setting, number: float) -> Config:
    """Return the configuration with one setting changed, checked as strictly as the file is.

    Parameters
    ----------
    config
        The present one.
    setting
        Which.
    number
        As PARAM_SET carries it.

    Raises
    ------
    companion.errors.ConfigError
        When the value is not allowed; one line that names it and what is.
    """
    section, _, key = setting.key.partition(".")
    value = _value(setting, number, value_of(config, setting))
    table: dict[str, Any] = config.model_dump(exclude_unset=True)
    return config_of(merged(table, {section: {key: value}}), name=setting.name)


def _value(setting: Setting, number: float, like: Value) -> Value:
    if not math.isfinite(number):
        raise ConfigError(f"{setting.name}: not a finite number")
    if isinstance(like, float):
        return from_float32(number)
    if number != round(number):
        raise ConfigError(f"{setting.name}: found {number:g}; allowed: a whole number")
    whole = round(number)
    if isinstance(like, bool):
        if whole not in (0, 1):
            raise ConfigError(f"{setting.name}: found {whole}; allowed: 0 or 1")
        return bool(whole)
    if isinstance(like, str):
        words = choices(setting)
        if not 0 <= whole < len(words):
            meaning = ", ".join(f"{place} {word}" for place, word in enumerate(words))
            raise ConfigError(f"{setting.name}: found {whole}; allowed: {meaning}")
        return words[whole]
    return whole


def from_float32(number: float) -> float:
    """Return the shortest decimal number that has the same 32-bit float: 0.8, not 0.800000011920929."""
    packed = _FLOAT.pack(number)
    for digits in _FLOAT_DIGITS:
        short = float(f"{number:.{digits}g}")
        if _FLOAT.pack(short) == packed:
            return short
    return number
