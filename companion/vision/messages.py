"""Messages between the service and the worker."""
