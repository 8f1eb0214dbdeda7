"""A child process for tests: writes lines, or stays until it is killed."""

import socket
import sys
import time

from companion.children.parent import die_with_parent


def main() -> None:
    """Do what the first packet says."""
    parent_pid, socket_fd = (int(argument) for argument in sys.argv[1:3])
    die_with_parent(parent_pid)
    with socket.socket(fileno=socket_fd) as connection:
        wish = connection.recv(100)
        if wish == b"stay":
            time.sleep(600.0)
        sys.stdout.write("x" * 3000 + "\n")
        for number in range(int(wish.split()[0])):
            sys.stdout.write(f"line {number}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
