"""Video4Linux 2: what a camera's driver offers, its controls, and its pictures straight from the driver's buffers."""
