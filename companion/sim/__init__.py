"""Fake autopilot, vehicle, planner and camera world: part of the product."""
