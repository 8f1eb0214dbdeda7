"""The worker process and its contract."""
