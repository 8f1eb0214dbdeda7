"""``scripts/vm-test``: the wheel on a real kernel, with a real V4L2 driver, under a real systemd."""
