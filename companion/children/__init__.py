"""Processes that the service starts beside itself: how they are started, spoken to, read and ended."""
