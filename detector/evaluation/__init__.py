"""Judging the detector on images with known truth: sets, methods, verdicts, figures and their comparison. See docs/evaluation.md."""
