"""Framing, codec, links, proxy and our own identity on MAVLink."""
