"""Worlds to fly in, as data: models, files, the built-in ones, random ones, and what their shapes mean for a vehicle."""
