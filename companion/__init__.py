"""The companion-computer service: frames in, MAVLink setpoints rewritten on their way."""
