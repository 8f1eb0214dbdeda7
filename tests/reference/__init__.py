"""A literal transcription of the paper: the oracle of the detector's tests."""
