"""Void detection from parallax: rotation taken out, ranges by sample, a map of where the vehicle fits."""
