"""The live page: a sink of the I/O process that serves what the flight publishes, settings, and recordings."""
