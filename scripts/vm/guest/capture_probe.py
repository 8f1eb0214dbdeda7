"""Captures through the wheel's own camera source, and says as JSON what came. Runs in the wheel's environment.

Usage: capture_probe.py '{"node": ..., "format": ..., "frames": N or "seconds": S, ...}'
"""

from __future__ import annotations

import asyncio
import json
import sys
import time

import numpy as np

from companion.clock import RealClock
from companion.config import Config, LogConfig
from companion.frames.open import open_source
from companion.log import open_log


async def capture(asked: dict, log) -> dict:
    clock = RealClock()
    config = Config.model_validate(
        {
            "source": {
                "url": f"v4l2:{asked['node']}",
                "pixel_format": asked["format"],
                "width_px": asked["width_px"],
                "height_px": asked["height_px"],
                "rate_hz": asked["rate_hz"],
                "controls": asked.get("controls", ""),
                "timeout_s": 5.0,
            }
        }
    )
    times_ns, arrivals_ns, numbers, kinds = [], [], [], set()
    source = open_source(config.source, clock=clock, log=log)
    async with asyncio.timeout(asked["limit_s"]), source:
        started_s = None
        async for frame in source.frames():
            arrivals_ns.append(clock.now_ns())
            times_ns.append(frame.time_ns)
            numbers.append(frame.seq)
            kinds.add(frame.time_of)
            lower = frame.image[frame.image.shape[0] // 2 :].astype(float)  # below vivid's text
            upper_half, lower_half = np.array_split(lower, 2)
            size_px = [frame.image.shape[1], frame.image.shape[0]]
            started_s = started_s or time.monotonic()
            if "seconds" in asked:
                if time.monotonic() - started_s >= asked["seconds"]:
                    break
            elif len(numbers) >= asked["frames"]:
                break
    times = np.array(times_ns)
    ages_ms = (np.array(arrivals_ns) - times) / 1e6
    per_frame_ms = np.diff(times) / np.maximum(np.diff(numbers), 1) / 1e6
    span_s = float(times[-1] - times[0]) / 1e9
    return {
        "frames": len(numbers),
        "numbered": numbers[-1] - numbers[0],
        "span_s": span_s,
        "rate_hz": (len(numbers) - 1) / span_s if span_s else 0.0,
        "driver_rate_hz": asked["rate_hz"],
        "size_px": size_px,
        "contrast": float(np.ptp(lower.mean(axis=0))),
        "skew": float(np.abs(upper_half.mean(axis=0) - lower_half.mean(axis=0)).mean()),
        "of_exposure": kinds == {"exposure"},
        "backward": int((np.diff(times) <= 0).sum()),
        "least_age_ms": float(ages_ms.min()),
        "age_ms": np.percentile(ages_ms, [5, 50, 95]).tolist(),
        "interval_ms": np.percentile(per_frame_ms, [5, 50, 95]).tolist() if len(numbers) > 1 else [0.0] * 3,
    }


def main() -> int:
    with open_log(LogConfig(format="json")) as log:
        try:
            found = asyncio.run(capture(json.loads(sys.argv[1]), log))
        except TimeoutError:
            code = 3
        else:
            code = 0
    if code == 0:
        print(json.dumps(found))
    return code


if __name__ == "__main__":
    sys.exit(main())
