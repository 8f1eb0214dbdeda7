"""The optional I/O process: recorder and live page beside the flight, fed by a queue that never makes the flight wait."""
