"""``companion doctor``: listens to everything that a flight needs and says what to do about what is missing.

``findings`` holds what was observed, ``listen`` observes it, ``checks`` judges it (pure), ``report`` writes it down.
"""
