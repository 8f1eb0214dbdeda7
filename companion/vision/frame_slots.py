"""Shared-memory frame slots."""
