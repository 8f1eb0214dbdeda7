"""``companion tune``: a search for settings against known truth or simulated flights, and whether its gain holds on what it has not seen."""
