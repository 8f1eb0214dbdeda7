"""Command line of the companion service."""
