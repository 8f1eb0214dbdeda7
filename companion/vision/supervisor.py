"""Worker supervision."""
