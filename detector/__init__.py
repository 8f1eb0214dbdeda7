"""Void detection from two frames of one camera: arrays in, frozen dataclasses out."""
