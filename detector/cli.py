"""Command line of the detector."""
