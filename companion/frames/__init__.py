"""Frame sources: recordings and raw frames over a socket, newest frame first."""
