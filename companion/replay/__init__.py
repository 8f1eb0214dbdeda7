"""Replay: what a recording was given, through the present code, and whether it decides the same."""
