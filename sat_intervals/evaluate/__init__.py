"""Evaluate intervals against truth: figures of merit and the paper's tables."""
