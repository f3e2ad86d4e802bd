"""Intervals against truth: figures of merit, the paper's tables."""
