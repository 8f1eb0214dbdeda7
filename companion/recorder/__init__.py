"""The recorder: flights as MCAP files and tlogs, written in the I/O process."""
