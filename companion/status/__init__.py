"""What the service tells other programs on its computer: a unix socket for ``companion status``, metrics for Prometheus."""
