"""A pipeline whose installation is incomplete."""

import not_installed

echo = not_installed.echo
