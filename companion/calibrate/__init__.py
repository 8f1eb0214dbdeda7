"""Calibration of a camera with a board: views, solution, judgement, camera file, picture of the coverage."""
